"""Values of joint actions in which one agent's part is exchanged: the same as asking for each of them."""

import pytest
import torch

from esp_cli.networks.joint_q import _one_by_one, counterfactual_values, in_circular_order
from esp_cli.networks.layers import SeedMLP
from tests.networks.gradients import assert_same_gradients


def perceptron(sizes, **choice):
    return SeedMLP([torch.Generator().manual_seed(seed) for seed in (0, 1)], sizes, "relu", 1.0, **choice)


def drawn(num_items=3, num_others=2, width=4, rows=11):
    generator = torch.Generator().manual_seed(5)
    shapes = ((2, rows, 6), (2, rows, num_items, width), (2, rows, num_items, num_others, width))
    return [torch.randn(shape, generator=generator) for shape in shapes]


def test_a_circle_ends_with_each_item_in_turn():
    items = torch.tensor([[1.0, 10.0], [2.0, 20.0], [3.0, 30.0]])
    rows = [[2, 20, 3, 30, 1, 10], [3, 30, 1, 10, 2, 20], [1, 10, 2, 20, 3, 30]]
    torch.testing.assert_close(in_circular_order(items), torch.tensor(rows).float())


def test_by_hand():
    """Two items of one number, 1 and 2, weighed by 3 and 5, become 10 or 30 and 20 or 40, beside 7 weighed by 1."""
    network = perceptron((3, 1))
    network.layers[0].weight.data[:] = torch.tensor([1.0, 3.0, 5.0]).view(1, 3, 1)
    rows = torch.full((2, 1, 1), 7.0)
    items = torch.tensor([1.0, 2.0]).view(1, 1, 2, 1).expand(2, -1, -1, -1)
    others = torch.tensor([[10.0, 30.0], [20.0, 40.0]]).view(1, 1, 2, 2, 1).expand(2, -1, -1, -1, -1)
    out = counterfactual_values(network, rows, items, others)
    expected = torch.tensor([[7.0 + 30 + 10, 7.0 + 90 + 10], [7.0 + 3 + 100, 7.0 + 3 + 200]])
    torch.testing.assert_close(out.squeeze(-1), expected.expand(2, 1, 2, 2))


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("sizes", [(18, 2), (18, 16, 1), (18, 16, 8, 3)])
def test_values_and_gradients_are_those_of_every_row_asked_for_by_itself(sizes, activation):
    network = perceptron(sizes).requires_grad_(False)
    network.activation = activation
    rows, items, others = drawn()
    others.requires_grad_()
    weight = torch.randn(2, 11, 3, 2, sizes[-1])
    ours, theirs = (ask(network, rows, items, others) for ask in (counterfactual_values, _one_by_one))
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)
    assert_same_gradients(ours, theirs, weight, [others])
    assert not torch.allclose(ours[:, :, 0], ours[:, :, 1]), "every item is another exchange"


def test_bfloat16_products_stay_near_float32():
    rows, items, others = drawn()
    exact = counterfactual_values(perceptron((18, 16, 8, 1)), rows, items, others)
    rounded = counterfactual_values(perceptron((18, 16, 8, 1), precision=torch.bfloat16), rows, items, others)
    assert rounded.dtype == torch.float32
    torch.testing.assert_close(rounded, exact, rtol=0.05, atol=0.05)
    assert not torch.equal(rounded, exact)


def test_a_normalised_input_is_built_anew_for_every_exchange():
    network = perceptron((18, 16, 1), layer_norm=True)
    rows, items, others = drawn()
    exchanged = items.clone()
    exchanged[:, :, 1] = others[:, :, 1, 0]
    expected = network(torch.cat([rows, exchanged.flatten(2)], -1))
    torch.testing.assert_close(counterfactual_values(network, rows, items, others)[:, :, 1, 0], expected)
