"""What stands around the data, and what is wrong in it: autocast, other types, inf and NaN."""

import pytest
import torch
from torch import Tensor

from esp_cli import Continuous, Field, Items, Kind, layout
from esp_cli.symmetry import Element, build_transform, mirror, rotation
from esp_cli.symmetry.maps import Dense, Gather, map_of
from esp_cli.symmetry.representation import rows_operator
from esp_envs.spec import Spaces, joint_layout

SEEN = layout(
    Field("velocity", Kind.VECTOR),
    Field("lidar", Kind.RING, rays=8),
    Field("battery", Kind.SCALAR),
    Field("others", Kind.VECTOR, 2, items=Items.OTHERS),
)
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
SPACES = Spaces(num_agents=3, observation=SEEN, state=joint_layout(SEEN, 3), action=FORCE, symmetry="c1")
CYCLE = Element(permutation=(1, 2, 0))
ELEMENTS = {"exact": [rotation(90) @ CYCLE, mirror(0)], "dense": [rotation(45) @ CYCLE, rotation(90)]}
CALLS = {
    "obs": (lambda g, x: g.obs(x), SEEN.width),
    "state": (lambda g, x: g.state(x.flatten(-2)), SEEN.width),
    "action": (lambda g, x: g.action(x), 2),
    "pull_back": (lambda g, x: g.pull_back(x), 2),
    "pull_back_variance": (lambda g, x: g.pull_back_variance(x.square()), 2),
    "per_agent": (lambda g, x: g.per_agent(x[..., 0]), 2),
}
"""What a transform does to numbers, and how wide the rows are that it is given."""
BAD = {"inf": torch.inf, "-inf": -torch.inf, "nan": torch.nan}


def rows(*shape: int, scale: float = 30.0) -> Tensor:
    return scale * torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.mark.parametrize("around", [torch.bfloat16, torch.float16], ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16], ids=str)
@pytest.mark.parametrize("kind", ELEMENTS)
@pytest.mark.parametrize("name", CALLS)
def test_autocast_changes_no_number(name, kind, dtype, around) -> None:
    call, width = CALLS[name]
    g, x = build_transform(ELEMENTS[kind], SPACES), rows(2, 5, 3, width).to(dtype)
    expected = call(g, x)
    with torch.autocast("cpu", dtype=around):
        cast = call(g, x)
    assert cast.dtype == expected.dtype == dtype
    assert torch.equal(cast, expected)
    assert not torch.equal(expected, call(build_transform([Element()] * 2, SPACES), x)), "the control: they move it"


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
@pytest.mark.parametrize("kind", ELEMENTS)
@pytest.mark.parametrize("number", [0, 1, 4, 10, 13], ids=["velocity x", "velocity y", "ray", "battery", "other"])
def test_a_bad_number_stays_where_its_image_is(number, kind, bad) -> None:
    """A quarter turn brings each number to one place, a turn by 45 degrees those of a vector to two."""
    x = rows(1, 5, 3, SEEN.width).float()
    sick = x.clone()
    sick[0, 2, 1, number] = bad
    g = build_transform(ELEMENTS[kind][:1], SPACES)
    basis = torch.zeros_like(x)
    basis[0, 2, 1, number] = 1
    image, moved = g.obs(basis), g.obs(sick)
    expected = torch.where(image != 0, image * bad, g.obs(x))
    torch.testing.assert_close(moved, expected, rtol=0, atol=0, equal_nan=True)
    assert (~moved.isfinite()).sum() == (2 if kind == "dense" and number in (0, 1, 13) else 1)


def test_each_way_through_a_map_keeps_bad_numbers_apart() -> None:
    operator = rows_operator(SEEN, ELEMENTS["exact"], 3)
    dense, gather = map_of(operator), map_of(operator, "meta")
    assert isinstance(dense, Dense)
    assert isinstance(gather, Gather), "where a product would have to ask whether all is finite"
    x = rows(2, 4, dense.width).float()
    x[0, 0, 0], x[0, 0, 5], x[1, 2, 7] = torch.inf, -torch.inf, torch.nan
    for move in (dense.push, dense.pull, dense.squared.pull):
        assert (~move(x).isfinite()).sum() == 3
    assert torch.equal(dense.pull(dense.push(x)).isfinite(), x.isfinite())
    product = torch.bmm(x, dense.matrix)
    assert (~product.isfinite()).sum() == 3 * dense.width - dense.width, "the control: all of two rows"


def test_an_inf_less_an_inf_is_none() -> None:
    x = torch.zeros(1, 1, 3, SEEN.width)
    x[0, 0, 0, :2] = torch.inf
    turned = build_transform([rotation(45)], SPACES).obs(x)[0, 0]
    assert turned[0, 0].isnan()
    assert turned[0, 1] == torch.inf
    assert (turned.flatten()[2:] == 0).all()


def test_the_way_without_a_question_equals_the_other(monkeypatch) -> None:
    """A GPU, or compiled code, is not asked whether all numbers are finite."""
    g = build_transform(ELEMENTS["dense"][:1], SPACES)
    x = rows(1, 4, 3, SEEN.width).float()
    sick = x.clone()
    sick[0, 1, 2, 3:5] = torch.nan
    asked = [g.obs(x), g.obs(sick)]
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    for here, there in zip(asked, [g.obs(x), g.obs(sick)], strict=True):
        torch.testing.assert_close(here, there, rtol=0, atol=0, equal_nan=True)


def test_a_bad_number_leaves_gradients_of_the_others_finite() -> None:
    x = rows(1, 4, 3, SEEN.width).float().requires_grad_()
    moved = build_transform(ELEMENTS["dense"][:1], SPACES).obs(x.masked_fill(x == x[0, 0, 0, 0], torch.inf))
    moved[moved.isfinite()].square().sum().backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()
