"""The nearest name to one that nobody knows."""

from __future__ import annotations

import pytest

from esp_cli.files.formatting import did_you_mean, nearest

NAMES = ("learning_rate", "clip_epsilon", "gamma", "num_envs")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("learing_rate", "learning_rate"),
        ("lr", "learning_rate"),
        ("clip", "clip_epsilon"),
        ("gama", "gamma"),
        ("colour", None),
        ("", None),
        ("x", None),
    ],
)
def test_a_typing_error_an_abbreviation_and_a_part_find_their_name(text: str, name: str | None) -> None:
    assert nearest(text, NAMES) == name
    assert did_you_mean(text, NAMES) == (f"; did you mean '{name}'?" if name else "")
