"""Compiled choices say what torch's operations say, and give the same slopes."""

import pytest
import torch

from esp_cli.algorithms.objectives import surrogate_slope
from esp_cli.networks.contract import WithVJP
from esp_cli.networks.kernels.choices import Clipped, CompiledChoices, Slope
from esp_cli.networks.policies import CategoricalPolicies, CompiledCategoricalPolicies
from esp_cli.symmetry import transform_set
from esp_cli.symmetry.frame import Frame
from tests.algorithms.test_objectives import SPACES
from tests.networks.kernels.compiler import assert_same_bits_alone_and_for_any_threads, needs_compiler

pytestmark = needs_compiler
COPIES, HERE = slice(1, None), slice(0, 1)


def both(names, rows_innermost, rows=9):
    """Return policies of three seeds, two agents and four moves, by torch and by the kernel."""
    frame = Frame([transform_set(name, SPACES).each()[0] for name in names])
    outputs = 3 * torch.randn(3, (1 + len(names)) * rows, 2, 2, 4)
    if rows_innermost:
        flat = outputs.flatten(1, -2).transpose(1, 2).contiguous().transpose(1, 2)
        outputs = flat.unflatten(1, outputs.shape[1:-1])
    returned = WithVJP(outputs, lambda slope: [slope], [])
    return CategoricalPolicies(returned, frame), CompiledCategoricalPolicies(returned, frame.orders(4))


@pytest.mark.parametrize("names", [(), ("rot90",), ("rot90", "flip-x")])
@pytest.mark.parametrize("rows_innermost", [False, True])
@pytest.mark.parametrize("by_row", [False, True])
def test_what_is_stated_and_its_slopes_equal_those_of_torch(names, rows_innermost, by_row):
    torch.manual_seed(0)
    eager, _ = policies = both(names, rows_innermost)
    action = torch.randint(4, (3, 9, 2, 2))
    weight = torch.rand(3, 1, 36) if by_row else 0.3
    for learned in {1, 1 + len(names)}:
        by_log_prob, stated = torch.randn(3, learned, 36), []
        for own in policies:
            numbers = [own.log_prob(action, learned), own.entropy(learned), own.divergence(COPIES, HERE)]
            slope = own.add_slope(None, action, by_log_prob.clone(), weight)
            for _ in range(2 if names else 0):  # the second time the kernel is called once more
                slope = own.add_divergence_slope(slope, weight)
            stated.append([*numbers, own.back(slope)[0][1]])
        for theirs, ours in zip(*stated, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    other = eager.back(eager.add_slope(None, action, by_log_prob, 9.0))[0][1]
    assert not torch.allclose(stated[1][-1], other)  # negative control


@pytest.mark.parametrize("by_row", [False, True])
def test_a_clipped_objective_has_the_slope_of_torch(by_row):
    torch.manual_seed(0)
    eager, compiled = both(("rot90",), False)
    action, old = torch.randint(4, (3, 9, 2, 2)), -torch.rand(3, 1, 36)
    advantage, weight = torch.randn(3, 1, 36), torch.rand(3, 1, 36) if by_row else 0.3
    slope = surrogate_slope(eager.log_prob(action, 2) - old, advantage, 0.2)
    assert 0 < (slope == 0).float().mean() < 1, "some are clipped"
    theirs = eager.back(eager.add_slope(None, action, slope * weight, 0.1 * weight))[0][1]
    asked = Clipped(action, 2, old, advantage, 0.2, weight, 0.1 * weight)
    torch.testing.assert_close(
        compiled.back(compiled.add_clipped_slope(None, asked))[0][1], theirs, rtol=1e-4, atol=1e-5
    )


def test_a_quarter_turn_of_four_moves_by_hand():
    odds = torch.tensor([[[1.0, 2.0, 3.0, 4.0], [4.0, 1.0, 2.0, 3.0]]])  # the copy says of each turned move the same
    orders = torch.tensor([[[0, 1, 2, 3], [1, 2, 3, 0]]])
    choices = CompiledChoices(odds.log(), orders)
    torch.testing.assert_close(choices.numbers.probs[0, :, :, 0].T, torch.tensor([[0.1, 0.2, 0.3, 0.4]] * 2))
    assert choices.numbers.gaps[0, :, 0].tolist() == pytest.approx([0.0, 0.0], abs=1e-6)
    slope = Slope(chosen=(torch.tensor([2]), torch.tensor([[[1.0], [0.0]]]), 0.0))
    # log p_2 falls with the odds of every other move as these are likely: -p_a, and 1 - p_2 by its own
    assert choices.back(slope)[0].tolist() == [pytest.approx([-0.1, -0.2, 0.7, -0.4], abs=1e-6), [0.0] * 4]


def test_results_are_the_same_bits_for_a_seed_and_for_any_number_of_threads():
    torch.manual_seed(0)
    outputs, orders = torch.randn(3, 2 * 500, 4), torch.tensor([[[0, 1, 2, 3], [1, 2, 3, 0]]]).expand(3, -1, -1)
    by_log_prob, action = torch.randn(3, 2, 500), torch.randint(4, (3, 500))

    def results(seeds):
        choices = CompiledChoices(outputs[seeds].contiguous(), orders[seeds])
        slope = Slope(chosen=(action[seeds], by_log_prob[seeds], 0.1), gaps=0.2)
        return [*choices.numbers, choices.back(slope)]

    assert_same_bits_alone_and_for_any_threads(results, 3)
