"""What a check says of one element and one field: it holds, it is broken by so much, or it is not covered."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from esp_cli.checking.shifting import Shift
from esp_cli.symmetry import Element

Watch = Callable[[int, int, str], object]
"""Takes how many of how many are done, and of what: "steps" while states or transitions are collected, "elements"."""
Outcome = Literal["holds", "broken", "not covered"]
RANK: dict[Outcome, int] = {"holds": 0, "not covered": 1, "broken": 2}  # of several outcomes the highest counts
SIGNIFICANT = 6.0  # standard errors of a gap that is a breaking: of thousands of comparisons some reach 4
NEGLIGIBLE = 1e-3  # gap against the field's spread below which a difference is rounding
ENDS = frozenset({"end", "alive"})  # fields: of the episode, of agents
LATE = "not tried, as the time was over"
LEVEL = 0.05  # probability with which an element that is off by the tolerance may be said to hold, at most
Named = TypeVar("Named", bound=Element | Shift)


class Late(BaseException):  # what is left is not covered, which is no error of the task
    """The time for a check is over."""


def stop_at(until: float) -> None:
    """Raise `Late` once `time.monotonic` is beyond `until`."""
    if time.monotonic() > until:
        raise Late


@dataclass(frozen=True)
class FieldVerdict:
    """What was found of one field under one element."""

    field: str  # with the space before it: "obs.velocity", "state.position", "reward", "end"
    outcome: Outcome  # "not covered" where the data could not have shown a breaking
    gap: float  # how far it is from transforming as it says, in standard deviations of the field
    error: float  # standard error of the gap
    p_value: float = 1.0  # how likely a gap this small is, if the field is off by the tolerance or more
    share: float = math.nan  # of the states, those that differ; NaN where chance decides what follows


@dataclass(frozen=True)
class ElementVerdict:
    """What was found of one element."""

    element: str  # its name, as `--transforms` takes it
    declared: bool  # whether the task's declared symmetry holds it
    fields: tuple[FieldVerdict, ...]
    reason: str = ""  # why the whole element is not covered, if so

    @property
    def worst(self) -> FieldVerdict | None:
        """The field that decides: broken by most, else not covered, else the one that is surest to hold last."""
        return max(
            self.fields, key=lambda f: (RANK[f.outcome], f.gap if f.outcome == "broken" else f.p_value), default=None
        )

    @property
    def outcome(self) -> Outcome:
        """Broken if any field is; it holds only if every field does."""
        return self.worst.outcome if self.worst else "not covered"

    @property
    def p_value(self) -> float:
        """How likely gaps this small are, if some field is off by the tolerance or more; 1 unless every field holds."""
        return self.worst.p_value if self.worst and self.outcome == "holds" else 1.0


def concluded(
    field: str, gap: float, error: float, broken: bool, p_value: float, share: float = math.nan
) -> FieldVerdict:
    """Return a verdict: a field holds only where a gap of the tolerance would have been seen."""
    outcome: Outcome = "broken" if broken else "holds" if p_value <= LEVEL else "not covered"
    return FieldVerdict(field, outcome, gap, error, 1.0 if broken else p_value, share)


def may_come(field: str, ends: bool, pays: bool, forbids: bool) -> bool:
    """Return whether a field that never changed may do so elsewhere.

    An end may; so may a mask, unless it forbids some action, and a reward, unless it pays and play ends.
    """
    return field in ENDS or (field == "action mask" and not forbids) or (field == "reward" and not (ends and pays))


def verdicts_of(
    elements: Sequence[Named],
    judge: Callable[[Named], ElementVerdict],
    is_declared: Callable[[Named], bool],
    watch: Watch = lambda *_: None,
    until: float = math.inf,
    spare: float = math.inf,
) -> list[ElementVerdict]:
    """Judge elements, declared ones first, and tell how many of how many are done.

    At `until` of `time.monotonic` the rest is not tried and so not covered, at `spare` what nobody declared.
    """
    found = dict[Named, ElementVerdict]()
    for done, element in enumerate(sorted(elements, key=lambda one: not is_declared(one)), 1):
        try:
            stop_at(until if is_declared(element) else min(until, spare))
            found[element] = judge(element)
        except Late:
            found[element] = ElementVerdict(element.name, is_declared(element), (), LATE)
        watch(done, len(elements), "elements")
    return [found[element] for element in elements]
