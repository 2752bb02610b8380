"""Compiled choices say what torch's operations say, and give the same slopes."""

import pytest
import torch

from esp_cli.algorithms.objectives import surrogate_slope
from esp_cli.networks.contract import WithVJP
from esp_cli.networks.kernels.choices import Clipped, Slope
from esp_cli.networks.policies import CategoricalPolicies, CompiledCategoricalPolicies
from esp_cli.symmetry import transform_set
from esp_cli.symmetry.frame import Frame
from tests.algorithms.test_objectives import SPACES
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler

pytestmark = needs_compiler


def both(names, rows_innermost, rows=9):
    """Return policies of three seeds, two agents and four moves, by torch and by the kernel."""
    frame = Frame([transform_set(name, SPACES).each()[0] for name in names])
    outputs = 3 * torch.randn(3, (1 + len(names)) * rows, 2, 2, 4)
    if rows_innermost:
        flat = outputs.flatten(1, -2).transpose(1, 2).contiguous().transpose(1, 2)
        outputs = flat.unflatten(1, outputs.shape[1:-1])
    returned = WithVJP(outputs, lambda slope: [slope], [])
    return CategoricalPolicies(returned, frame), CompiledCategoricalPolicies(returned, frame, frame.orders(4))


@pytest.mark.parametrize("names", [(), ("rot90",), ("rot90", "flip-x")])
@pytest.mark.parametrize("rows_innermost", [False, True])
@pytest.mark.parametrize("by_row", [False, True])
def test_the_slope_of_a_clipped_objective_and_of_divergences_equals_that_of_torch(names, rows_innermost, by_row):
    torch.manual_seed(0)
    eager, compiled = both(names, rows_innermost)
    action, old = torch.randint(4, (3, 9, 2, 2)), -torch.rand(3, 1, 36)
    advantage, weight = torch.randn(3, 1, 36), torch.rand(3, 1, 36) if by_row else 0.3
    for learned in {1, 1 + len(names)}:
        by_log_prob = surrogate_slope(eager.log_prob(action, learned) - old, advantage, 0.2)
        assert 0 < (by_log_prob == 0).float().mean() < 1, "some are clipped"
        theirs = eager.add_slope(None, action, by_log_prob * weight, 0.1 * weight)
        ours = compiled.add_clipped_slope(None, Clipped(action, learned, old, advantage, 0.2, weight, 0.1 * weight))
        for _ in range(2 if names else 0):
            theirs, ours = eager.add_divergence_slope(theirs, weight), compiled.add_divergence_slope(ours, weight)
        (_, expected), (_, found) = eager.back(theirs)[0], compiled.back(ours)[0]
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
        other = eager.back(eager.add_slope(None, action, by_log_prob, 9.0))[0][1]
        assert not torch.allclose(found, other), "negative control"


def test_a_quarter_turn_of_four_moves_by_hand():
    odds = torch.tensor([[[1.0, 2.0, 3.0, 4.0], [4.0, 1.0, 2.0, 3.0]]])  # the copy says of each turned move the same
    orders = torch.tensor([[[0, 1, 2, 3], [1, 2, 3, 0]]])
    clipped = Clipped(torch.tensor([2]), 1, torch.tensor([[[0.3]]]).log(), torch.ones(1, 1, 1), 0.2, 1.0, 0.0)
    # log p_2 falls with the odds of every other move as these are likely: -p_a, and 1 - p_2 by its own
    slope = Slope(clipped).back(odds.log(), orders)
    assert slope[0].tolist() == [pytest.approx([-0.1, -0.2, 0.7, -0.4], abs=1e-6), [0.0] * 4]


def test_results_are_the_same_bits_for_a_seed_and_for_any_number_of_threads():
    torch.manual_seed(0)
    outputs, orders = torch.randn(3, 2 * 500, 4), torch.tensor([[[0, 1, 2, 3], [1, 2, 3, 0]]]).expand(3, -1, -1)
    old, advantage, action = -torch.rand(3, 2, 500), torch.randn(3, 1, 500), torch.randint(4, (3, 500))

    def results(seeds):
        here = outputs[seeds].contiguous(), orders[seeds].contiguous()
        slope = Slope(Clipped(action[seeds], 2, old[seeds], advantage[seeds], 0.2, 1.0, 0.1), gaps=0.2)
        return [slope.back(*here)]

    assert_same_bits_alone_and_for_any_threads(results, 3)
