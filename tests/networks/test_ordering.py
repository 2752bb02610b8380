"""Perceptrons that read like things in the order of their distance."""

import pytest
import torch

from esp_cli.export.program import program_of
from esp_cli.networks.build import build_network
from esp_cli.networks.contract import IoSpec
from esp_cli.networks.ordering import NearestFirst, items_of
from esp_cli.networks.plain import GruConfig, MlpConfig
from esp_cli.training.build import build_learner, generators
from esp_cli.training.config import resolve_config
from esp_envs import Discrete, Field, Items, Kind, Spaces, UserError, layout
from tests.networks.kernels.compiler import needs_compiler

POINTS = Discrete(Kind.VECTOR, ((1.0, 0.0), (-1.0, 0.0)), ("right", "left"))


def spaces(*observation):
    seen = layout(*observation)
    return Spaces(num_agents=3, observation=seen, state=seen, action=POINTS, symmetry="d1")


def ordered(spec, reads="own", config=None, further=0):
    io = IoSpec(spec, reads, None if reads == "own" else 1)
    config = config or MlpConfig(order="nearest", hidden=(8,))
    return build_network(generators((0, 1), "x"), io.layout.width + further, 2, config, 1.0, io)


MARKS = Field("landmarks", Kind.VECTOR, 3, family="landmarks")
OTHERS = (Field("near", Kind.VECTOR, 2, items=Items.OTHERS), Field("fuel", Kind.SCALAR, 2, items=Items.OTHERS))


def test_things_are_sorted_by_hand_and_joined_numbers_go_along():
    network = ordered(spaces(MARKS, *OTHERS))
    row = torch.tensor([3.0, 4, 0, 1, 0, -2, 5, 0, -1, 0, 10, 20])
    # landmarks at distances 5, 1, 2; the others at 5 and 1 have 10 and 20 of fuel; what stands behind stays
    expected = [0, 1, 0, -2, 3, 4, -1, 0, 5, 0, 20, 10, 99]
    assert network.sorted(torch.cat([row, torch.tensor([99.0])])).tolist() == expected


def test_items_of_records_begin_at_columns_of_their_own():
    pair = Field("pair", Kind.RECORD, 2, parts=(Field("at", Kind.VECTOR), Field("fuel", Kind.SCALAR)))
    columns = [(field.name, column) for field, column in items_of([pair, Field("time", Kind.SCALAR)])]
    assert columns == [("at", 0), ("fuel", 2), ("at", 3), ("fuel", 5), ("time", 6)]


def test_places_are_near_by_the_own_place():
    own, points = (
        Field("position", Kind.VECTOR, is_point=True),
        Field("spots", Kind.VECTOR, 2, family="s", is_point=True),
    )
    row = torch.tensor([9.0, 9, 0, 0, 8, 9])
    assert ordered(spaces(own, points)).sorted(row).tolist() == [9, 9, 8, 9, 0, 0]


@pytest.mark.parametrize("reads", ["own", "observations"])
@pytest.mark.parametrize("config", [MlpConfig, GruConfig])
def test_no_order_of_things_matters_and_without_it_it_does(reads, config):
    spec = spaces(MARKS, *OTHERS)
    x = torch.randn(2, 4, 5, 12 * (3 if reads == "observations" else 1), generator=torch.Generator().manual_seed(0))
    y = x.clone()
    y[..., :6] = x[..., :6].unflatten(-1, (3, 2)).roll(1, -2).flatten(-2)
    for order in ("nearest", "given"):
        network = ordered(spec, reads, config(order=order, hidden=(8,)))
        assert torch.equal(network.unroll(x), network.unroll(y)) == (order == "nearest")


def test_quarter_turns_keep_the_order_and_gradients_are_those_of_autograd():
    network = ordered(spaces(MARKS, *OTHERS))
    assert isinstance(network, NearestFirst)
    x = torch.randn(2, 4, 5, 3, 12, generator=torch.Generator().manual_seed(0))
    turned = x.clone()
    turned[..., :10] = torch.stack([-x[..., 1:10:2], x[..., 0:10:2]], -1).flatten(-2)
    back = network.sorted(turned)[..., :10].unflatten(-1, (-1, 2)).flip(-1) * torch.tensor([1.0, -1.0])
    assert torch.equal(back.flatten(-2), network.sorted(x)[..., :10])
    plain = network.unroll_agents(x)
    given = network.with_vjp(x, plain.shape)
    slope = torch.randn(plain.shape, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(given.tensor, plain)
    wanted = torch.autograd.grad(plain, [*network.parameters()], slope)
    for ours, theirs in zip(given.vjp(slope), wanted, strict=True):
        torch.testing.assert_close(ours, theirs)


@needs_compiler
@pytest.mark.parametrize("reads", ["own", "observations"])
def test_kernels_sort_alike(reads):
    own, spots = Field("position", Kind.VECTOR, is_point=True), Field("s", Kind.VECTOR, 2, family="s", is_point=True)
    spec = spaces(MARKS, own, spots, *OTHERS)
    further = 0 if reads == "observations" else 2
    x = torch.randn(2, 4, 90, 18 * (3 if reads == "observations" else 1) + further).mul(4).round() / 4  # with ties
    fast = ordered(spec, reads, MlpConfig(order="nearest", hidden=(8,), compiled=True), further)
    assert fast.compiled
    assert torch.equal(fast.sorted(x), ordered(spec, reads, further=further).sorted(x))


def test_it_is_not_exported():
    sorting = {"network.name": "mlp", "network.order": "nearest"}
    learner = build_learner(resolve_config("navigation", "mappo", overrides=sorting))
    with pytest.raises(UserError, match="order=nearest"):
        program_of(learner.policy)


def test_what_has_no_sets_is_refused():
    with pytest.raises(UserError, match="shows none with a place"):
        ordered(spaces(Field("goal", Kind.VECTOR)))
