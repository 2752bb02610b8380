"""The symmetry consistency losses of the paper: S_pi (Eq. 8), and S_V (Eq. 9) or S_Q (supplement eq. 19).

Both are stated once, element by element. Learners average them with their slopes (`policy_gap`, `value_gap`); a foreign
training loop gives them to autograd.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from esp_cli.prior.frame import Values
from esp_cli.prior.loss import Equation, Stated
from esp_cli.prior.seed_batch import shares


def policy_consistency_loss(
    divergence: Callable[[Any, Any], Tensor], pulled_back: Any, original: Any, stop_gradient: str = "none"
) -> Tensor:
    """Return S_pi = KL[pi(K_g . | L_g s) || pi(. | s)] (Eq. 8).

    Args:
        divergence: KL of two distributions given by their outputs, as a policy head defines it.
        pulled_back: outputs of the policy at L_g s, pulled back by K_g: action a has the weight of K_g a.
        original: outputs of the policy at s.
        stop_gradient: "original" or "transformed" holds that side fixed, "none" lets both move.

    Shape:
        outputs [S, B, N, A] -> [S, B, N].
    """
    pulled_back, original = _stopped(pulled_back, original, stop_gradient)
    return divergence(pulled_back, original)


def value_consistency_loss(transformed: Tensor, original: Tensor, stop_gradient: str = "none") -> Tensor:
    """Return S_V = (V(s) - V(L_g s))^2 (Eq. 9) of values in the critic's own (normalised) units.

    Shape:
        [S, B, C] each -> [S, B, C].
    """
    transformed, original = _stopped(transformed, original, stop_gradient)
    return (original - transformed).square()


def _stopped(transformed: Any, original: Any, stop_gradient: str) -> tuple[Any, Any]:
    if stop_gradient == "original":
        return transformed, original.detach()
    if stop_gradient == "transformed":
        return transformed.detach(), original
    return transformed, original


def policy_gap(mask: Tensor | None, stop_gradient: str) -> Equation:
    """Return the mean of S_pi over copies and rows that count, as an equation on `networks.policies.Policies`.

    Args:
        mask: see `mean_per_seed`.
        stop_gradient: see `policy_consistency_loss`.
    """

    def equation(policies: Any, weight: float, slope: Any) -> Stated:
        gap = policy_consistency_loss(policies.divergence, slice(1, None), slice(0, 1))
        share = shares(mask, gap.shape)
        return Stated(gap, share, policies.add_divergence_slope(slope, weight * share, stop_gradient))

    return equation


def value_gap(mask: Tensor | None, stop_gradient: str) -> Equation:
    """Return the mean of S_V (S_Q) over copies and rows that count, as an equation on `prior.frame.Values`."""

    def equation(values: Values, weight: float, slope: Tensor | None) -> Stated:
        slope = torch.zeros_like(values.rows) if slope is None else slope
        here, copies = values.rows[:, :1], values.rows[:, 1:]
        gap = value_consistency_loss(copies, here)
        share = shares(mask, gap.shape)
        by_copies = (copies - here).mul_(2 * weight * share)
        if stop_gradient != "transformed":
            slope[:, 1:].add_(by_copies)
        if stop_gradient != "original":
            slope[:, :1].sub_(by_copies.sum(1, keepdim=True))
        return Stated(gap, share, slope)

    return equation
