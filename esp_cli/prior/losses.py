"""The symmetry consistency losses of the paper, Eq. 8 and 9, element by element."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor


def policy_consistency_loss(
    divergence: Callable[[Tensor, Tensor], Tensor], pulled_back: Tensor, original: Tensor, stop_gradient: str = "none"
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


def _stopped(transformed: Tensor, original: Tensor, stop_gradient: str) -> tuple[Tensor, Tensor]:
    if stop_gradient == "original":
        return transformed, original.detach()
    if stop_gradient == "transformed":
        return transformed.detach(), original
    return transformed, original
