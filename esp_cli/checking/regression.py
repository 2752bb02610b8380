"""Measure from anybody's transitions how far an element is from a symmetry: of any policy, without setting states.

A ridge regression of change and reward on what is seen and done is fitted twice on one half of the episodes: on the
transitions alone, and on them together with their transformed copies. If dynamics and reward are symmetric, the copies
are transitions like others, and the second fit predicts the other half as well as the first. The gap

    (error with copies - error without) / variance

is the share of the variance that a learner gets wrong by believing in the element. It is measured where the data
lies; what happens where only transformed states lie is not seen. Copies are also more rows: with n rows of F features
they save about F / 2n of what the fit leaves over, and hide breakings below that. So few rows say nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.checking.recorded import Transitions, outputs_of, turned
from esp_cli.checking.verdicts import ElementVerdict, FieldVerdict
from esp_cli.prior.regression import inputs_of, moments, ridge
from esp_cli.symmetry import Element, build_transform
from esp_envs.spec import Spaces

TOLERATED = 2e-3
"""Gap below which an element counts as a symmetry of transitions."""
MATERIAL = 2 * TOLERATED
"""Gap that matters: what is shown to lie below is accepted as found, what is shown to lie above is broken."""
_ROWS = 4
"""Rows for each feature, below which more rows improve a fit whether they are true or not."""
_STILL = 1e-10
"""Variance below which a field does not change, so that it says nothing."""


def check_by_regression(spaces: Spaces, data: Transitions, elements: Sequence[Element]) -> list[ElementVerdict]:
    """Judge elements from transitions; `gap` is a share of variance here, and `error` its standard error.

    Args:
        spaces: what the numbers are.
        data: anybody's transitions; each episode counts once.
        elements: to try.
    """
    half = len(data.obs) // 2
    first = data.episodes(slice(half))
    rows = _rows(spaces, data)
    for_each, for_all = _Plain(*rows, shared=False), _Plain(*rows, shared=True)
    verdicts = []
    for element in elements:
        plain = for_all if element.permutation is None else for_each
        if plain.reason:
            verdicts.append(ElementVerdict(element.name, False, (), plain.reason))
            continue
        gap = plain.worsening(*_rows(spaces, turned(first, build_transform([element], spaces))))
        verdicts.append(ElementVerdict(element.name, False, _fields(spaces, gap, rows[1])))
    return verdicts


def _fields(spaces: Spaces, gap: Tensor, outputs: Tensor) -> tuple[FieldVerdict, ...]:
    width = spaces.observation.width
    parts = {f"obs.{name}": where for name, where in spaces.observation.slices().items()}
    parts["reward"] = slice(width, width + 1)
    if outputs.shape[-1] > width + 1:
        parts["action mask"] = slice(width + 1, None)
    return tuple(_field(name, gap[:, where], outputs[..., where]) for name, where in parts.items())


def _rows(spaces: Spaces, data: Transitions) -> tuple[Tensor, Tensor]:
    """Return inputs [M, T, N, features] and outputs [M, T, N, D + 1], behind them any mask of actions.

    The inputs hold what the other agents see and do: else others that prefer a direction would look like a task that
    does.
    """
    return inputs_of(spaces, data.obs, data.action), outputs_of(data)


def _field(name: str, excess: Tensor, outputs: Tensor) -> FieldVerdict:
    """Judge one field by the excess of squared error [M, numbers] of each held-out episode."""
    variance = float(outputs.flatten(0, 2).double().var(0).sum())
    if variance < _STILL:
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    shares = excess.sum(1) / variance
    gap, error = float(shares.mean()), float(shares.std() / len(shares) ** 0.5)
    return FieldVerdict(name, "broken" if gap > TOLERATED else "holds", gap, error)


class _Plain:
    """The regressions of the first half of the episodes, and how well they predict the second.

    Attributes:
        reason: why they say nothing, if so.
    """

    def __init__(self, inputs: Tensor, outputs: Tensor, shared: bool) -> None:
        """Fit.

        Args:
            inputs: [M, T, A, features].
            outputs: [M, T, A, outputs].
            shared: one regression serves all agents; else each of the A agents has its own.
        """
        self._shared = shared
        half, (_, steps, agents, features) = len(inputs) // 2, inputs.shape
        each = steps * (agents if shared else 1)
        fewest = -(-_ROWS * features // each)
        self.reason = "" if half >= fewest else f"{len(inputs)} episodes are too few, record at least {2 * fewest}"
        inputs, outputs = self._arranged(inputs), self._arranged(outputs)
        self._held = inputs[half:], outputs[half:]
        self._own = moments(inputs[:half], outputs[:half])
        self._errors = self._error(*self._own)

    def worsening(self, inputs: Tensor, outputs: Tensor) -> Tensor:
        """Return by how much copies [M / 2, T, A, ...] worsen predictions of held-out episodes, [M / 2, outputs]."""
        gram, cross = moments(self._arranged(inputs), self._arranged(outputs))
        return self._error(self._own[0] + gram, self._own[1] + cross) - self._errors

    def _error(self, gram: Tensor, cross: Tensor) -> Tensor:
        predicted = torch.einsum("mtaf,afo->mtao", self._held[0], ridge(gram, cross))
        return (predicted - self._held[1]).double().square().mean((1, 2))

    def _arranged(self, part: Tensor) -> Tensor:
        return part.flatten(1, 2).unsqueeze(2) if self._shared else part
