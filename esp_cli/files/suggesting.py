"""Suggestions for unknown names: the nearest name that exists."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(text: str, known: Iterable[str]) -> str | None:
    """Return the known name that a mistyped or abbreviated name is likely to mean; None where none is near.

    "learing_rate" and "lr" -> "learning_rate"; "clip" -> "clip_epsilon".
    """
    names = sorted(set(known))
    close = get_close_matches(text, names, n=1)
    if close or not text:
        return close[0] if close else None
    short = [name for name in names if text == "".join(word[0] for word in name.split("_") if word)]
    part = [name for name in names if text in name.split("_")]
    return next(iter(short + part), None)


def did_you_mean(text: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'NAME'?", or nothing where no known name is near."""
    name = nearest(text, known)
    return f"; did you mean '{name}'?" if name else ""
