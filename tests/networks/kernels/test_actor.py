"""The compiled draws and gradient of MADDPG's actor do what torch's operations do."""

import math
from itertools import product

import pytest
import torch

from esp_cli.algorithms.closed_actor import ActorWeights, actor_gradient, draw
from esp_cli.symmetry import transform_set
from tests.algorithms.test_closed_form import SPACES
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler


def rows(num_seeds, count, num_parts, num_learned):
    """Return logits of two agents, noise, the gradient by what is drawn, and the share of each row."""
    torch.manual_seed(0)
    logits, noise = 3 * torch.randn(num_seeds, 4, 2, num_parts, count), torch.rand(num_seeds, count, 1, 2, 4)
    by_action = torch.randn(num_seeds, num_learned * count, 2, 4) / count
    return logits, noise, by_action, torch.rand(num_seeds, count) / count


@needs_compiler
@pytest.mark.parametrize("count", [1, 9, 700])
@pytest.mark.parametrize(("transforms", "num_learned"), [("none", 1), ("c4", 4), ("c4", 2), ("rot90", 1)])
def test_draws_and_gradients_equal_those_of_torch(count, transforms, num_learned):
    moves = [] if transforms == "none" else transform_set(transforms, SPACES).each()
    logits, noise, by_action, share = rows(3, count, 1 + len(moves), num_learned)
    compiled, eager = (draw(logits, num_learned, noise, c) for c in (True, False))
    torch.testing.assert_close(compiled.hard, eager.hard)
    torch.testing.assert_close(compiled.soft, eager.soft)
    for stop_gradient, gap in product(("none", "original", "transformed"), (0.0, 2.0)):
        weights = ActorWeights(0.1, gap, stop_gradient)
        ours = actor_gradient(logits, compiled, by_action, share, moves, weights, compiled=True)
        theirs = actor_gradient(logits, eager, by_action, share, moves, weights)
        for a, b in zip(ours, theirs, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6 / count)
        assert not torch.equal(ours[0], theirs[0]), "negative control: two ways to compute it"


@needs_compiler
def test_noise_at_its_ends_and_equal_numbers():
    noise = torch.tensor([0.0, 1.0 - 2.0**-24, 0.5]).view(1, 1, 1, 1, 3)
    drawn, eager = (draw(torch.zeros(1, 3, 1, 1, 1), 1, noise, c) for c in (True, False))
    torch.testing.assert_close(drawn.soft, eager.soft, rtol=1e-5, atol=0)
    assert drawn.hard.flatten().tolist() == [0.0, 1.0, 0.0]
    even = draw(torch.tensor([1.0, 1.0, 0.0]).view(1, 3, 1, 1, 1), 1, torch.full((1, 1, 1, 1, 3), 0.5), compiled=True)
    assert even.hard.flatten().tolist() == [0.5, 0.5, 0.0]


@needs_compiler
def test_two_actions_by_hand():
    """p = (3/4, 1/4) and its copy, turned, (1/4, 3/4): KL = ln 3 / 2; soft (3/4, 1/4), as both get equal noise."""
    (swap,) = transform_set("rot180", SPACES).each()
    right = torch.tensor([math.log(3.0), 0.0, 0.0, 0.0])  # in the copy, what is left in the original
    logits = torch.stack([right, right], -1).view(1, 4, 1, 2, 1)
    noise, share = torch.full((1, 1, 1, 1, 4), 0.5), torch.ones(1, 1)
    drawn = draw(logits, 1, noise, compiled=True)
    assert drawn.soft[0, :, 0, 0, 0].tolist() == pytest.approx([1 / 2, 1 / 6, 1 / 6, 1 / 6], abs=1e-5)
    by_action = torch.tensor([6.0, 0.0, 0.0, 0.0]).view(1, 1, 1, 4)
    made = (by_action, share, [swap], ActorWeights(0.0, 1.0, "none"))
    gradient, entropy = actor_gradient(logits, drawn, *made, compiled=True)
    # by the value: soft (6 - 3, 0 - 3, ...); by the KL from the original: p - moved copy
    own = [1.5 + 1 / 3, -0.5, -0.5 - 1 / 3, -0.5]
    assert gradient[0, :, 0, 0, 0].tolist() == pytest.approx(own, abs=1e-5)
    # from the copy, in the original's order (1, 1, 3, 1) / 6: copy times (its log ratio (-ln 3, 0, ln 3, 0) less KL)
    gap = math.log(3.0) / 3
    copy = [(math.log(3.0) - gap) / 2, -gap / 6, (-math.log(3.0) - gap) / 6, -gap / 6]
    assert gradient[0, :, 0, 1, 0].tolist() == pytest.approx(copy, abs=1e-5)
    assert entropy.item() == pytest.approx(math.log(2) / 2 + math.log(6) / 2, abs=1e-5)


@needs_compiler
def test_a_seed_alone_and_any_number_of_threads_give_the_same_bits():
    moves = transform_set("c4", SPACES).each()
    logits, noise, by_action, share = rows(3, 300, 1 + len(moves), 1 + len(moves))

    def found(seeds):
        drawn = draw(logits[seeds], 1 + len(moves), noise[seeds], compiled=True)
        made = (by_action[seeds], share[seeds], moves, ActorWeights(0.1, 1.0, "none"))
        return [drawn.hard, *actor_gradient(logits[seeds], drawn, *made, compiled=True)]

    assert_same_bits_alone_and_for_any_threads(found, 3)
