"""What a check says of one element and one field: it holds, it is broken by so much, or it is not covered."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

Outcome = Literal["holds", "broken", "not covered"]
RANK: dict[Outcome, int] = {"not covered": 0, "holds": 1, "broken": 2}
"""The outcome of several verdicts is the one of the highest rank."""
SIGNIFICANT = 6.0
"""Standard errors that a gap must exceed: with thousands of comparisons, chance alone reaches 4."""
NEGLIGIBLE = 1e-3
"""Gap against the field's spread below which a difference is rounding."""


@dataclass(frozen=True)
class FieldVerdict:
    """What was found of one field under one element.

    Attributes:
        field: its name, with the space before it: "obs.velocity", "state.position", "reward", "end".
        outcome: whether it transforms as it says; "not covered" where the data cannot tell.
        gap: how far it is from that, in standard deviations of the field or, from transitions, as a share of variance.
        error: standard error of the gap.
    """

    field: str
    outcome: Outcome
    gap: float
    error: float


@dataclass(frozen=True)
class ElementVerdict:
    """What was found of one element.

    Attributes:
        element: its name, as `--transforms` takes it; of a map of numbers what each becomes.
        declared: whether the task's declared symmetry holds it.
        fields: one verdict for each field.
        reason: why the whole element is not covered, if so.
    """

    element: str
    declared: bool
    fields: tuple[FieldVerdict, ...]
    reason: str = ""

    @property
    def outcome(self) -> Outcome:
        """Broken if any field is; it holds if some field says so."""
        outcomes = (verdict.outcome for verdict in self.fields)
        return max(outcomes, key=RANK.__getitem__, default="not covered")


def judged(field: str, samples: Tensor, scale: float, moved: bool) -> FieldVerdict:
    """Judge a gap whose expectation is 0 under symmetry.

    Args:
        field: its name.
        samples: [M, tests] independent rows; each column is one test of the field.
        scale: spread of the field.
        moved: whether the element changes anything of the field, or of what it depends on, in these samples.
    """
    samples = samples.double()
    gaps = samples.mean(0).abs()
    errors = samples.std(0) / len(samples) ** 0.5
    broken = (gaps > SIGNIFICANT * errors) & (gaps > NEGLIGIBLE * scale)
    scores = torch.where(broken, gaps, 0.0) if bool(broken.any()) else gaps
    worst = int(scores.argmax())
    outcome: Outcome = "broken" if bool(broken.any()) else "holds" if moved else "not covered"
    return FieldVerdict(field, outcome, float(gaps[worst] / scale), float(errors[worst] / scale))
