"""The compiled gradient of MAPPO's losses does what torch's operations do."""

import math
from itertools import product

import pytest
import torch

from esp_cli.algorithms.closed_form import Weights, policy_gradient
from esp_cli.symmetry import transform_set
from tests.algorithms.test_closed_form import SPACES
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler


def rows(num_seeds, count, transforms, spread=1.0):
    """Return logits and what was done, of rows of two agents."""
    torch.manual_seed(0)
    shape = (num_seeds, count, 1, 2)
    logits = spread * torch.randn(num_seeds, (1 + transforms) * count, 2, 1, 4)
    old = torch.randn(shape) * 0.3 + math.log(1 / 4)
    return logits, torch.randint(4, shape), old, torch.randn(shape)


@needs_compiler
@pytest.mark.parametrize("count", [1, 9, 700])
@pytest.mark.parametrize(("transforms", "augments"), [("none", True), ("c4", True), ("rot90", False)])
def test_it_is_the_gradient_by_torch(count, transforms, augments):
    moves = [] if transforms == "none" else transform_set(transforms, SPACES).each()
    logits, *made = rows(3, count, len(moves), spread=3.0)
    for stop_gradient, gap in product(("none", "original", "transformed"), (0.0, 2.0)):
        weights = Weights(0.2, 0.05, 10.0, 1.0, gap, 0.0, augments, stop_gradient)
        ours, theirs = (policy_gradient(logits, moves, *made, weights, compiled=c) for c in (True, False))
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6 / count)
        assert not torch.equal(ours, theirs), "negative control: two ways to compute it"


@needs_compiler
def test_certain_policies_and_numbers_that_are_none():
    logits, action, old, advantage = rows(1, 20, 0)
    logits[0, 0] = torch.tensor([80.0, -80.0, 0.0, 0.0])
    logits[0, 1, 0, 0, 0] = math.nan
    weights = Weights(0.2, 0.05, 10.0, 1.0, 0.0, 0.0, True, "none")
    ours, theirs = (policy_gradient(logits, [], action, old, advantage, weights, compiled=c) for c in (True, False))
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6, equal_nan=True)
    assert ours[0, 1, 0].isnan().all()
    assert ours[0, 2:].isfinite().all()


@needs_compiler
def test_a_seed_alone_and_any_number_of_threads_give_the_same_bits():
    moves = transform_set("c4", SPACES).each()
    logits, *made = rows(3, 300, len(moves))
    weights = Weights(0.2, 0.05, 10.0, 1.0, 1.0, 0.0, True, "none")

    def found(seeds):
        given = (x[seeds] for x in made)
        return [policy_gradient(logits[seeds], moves, *given, weights, compiled=True)]

    assert_same_bits_alone_and_for_any_threads(found, 3)
