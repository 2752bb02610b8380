"""Comparing the gradients of two ways to compute the same."""

from collections.abc import Sequence

import torch
from torch import Tensor


def assert_same_gradients(
    ours: Tensor,
    theirs: Tensor,
    weight: Tensor,
    inputs: Sequence[Tensor],
    rtol: float | None = 1e-4,
    atol: float | None = 1e-5,
) -> None:
    """Compare the gradients of the weighted sums of two equal outputs with respect to what both come from.

    Without tolerances those of the data type are taken.
    """
    found, expected = (torch.autograd.grad((outputs * weight).sum(), inputs) for outputs in (ours, theirs))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=atol)
