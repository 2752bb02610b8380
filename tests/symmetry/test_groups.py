"""Group axioms, over a registry of groups."""

import math

import numpy as np
import pytest
import torch

from esp_cli.symmetry import (
    Element,
    FiniteGroup,
    PlaneElement,
    agent_permutations,
    cyclic,
    dihedral,
    direct_product,
    item_orders,
    mirror,
    rotation,
)
from esp_cli.symmetry.groups import swap_and_round
from esp_cli.symmetry.plane import PlaneGroup

ORDERS = {
    "c1": (cyclic(1), 1),
    "c2": (cyclic(2), 2),
    "c4": (cyclic(4), 4),
    "c7": (cyclic(7), 7),
    "c8": (cyclic(8), 8),
    "d1": (dihedral(1), 2),
    "d2": (dihedral(2), 4),
    "d4": (dihedral(4), 8),
    "d8": (dihedral(8), 16),
    "agents": (agent_permutations(3), 6),
    "d4*agents": (direct_product(dihedral(4), agent_permutations(3)), 48),
    "marks-3": (item_orders("marks", 3), 6),
    "c2*agents*marks-3": (direct_product(cyclic(2), agent_permutations(2), item_orders("marks", 3)), 24),
}


@pytest.fixture(params=ORDERS, ids=str)
def group(request: pytest.FixtureRequest) -> FiniteGroup:
    found = ORDERS[request.param][0]
    assert isinstance(found, FiniteGroup)
    return found


def test_group_axioms(group: FiniteGroup) -> None:
    everyone, p = np.arange(group.order), group.product
    assert group.order == ORDERS[group.name][1]
    assert group.elements[0] == Element()
    np.testing.assert_array_equal(np.sort(p, axis=0), np.tile(everyone[:, None], group.order))
    np.testing.assert_array_equal(np.sort(p, axis=1), np.tile(everyone, (group.order, 1)))
    np.testing.assert_array_equal(p[0], everyone)
    np.testing.assert_array_equal(p[:, 0], everyone)
    inverses = [group.elements.index(element.inverse()) for element in group.elements]
    np.testing.assert_array_equal(p[everyone, inverses], 0)
    np.testing.assert_array_equal(p[p], p[everyone[:, None, None], p[None]], "products associate")


def test_d4_by_hand() -> None:
    names = [e.name for e in dihedral(4).elements]
    assert names == ["identity", "rot90", "rot180", "rot270", "flip-x", "flip-diagonal", "flip-y", "flip-antidiagonal"]
    d4 = dihedral(4)
    row, column = names.index("rot90"), names.index("flip-x")
    assert names[d4.product[row, column]] == "flip-diagonal"
    assert names[d4.product[column, row]] == "flip-antidiagonal"


def test_generators_decide_the_group() -> None:
    assert FiniteGroup.generated_by("two mirrors", [mirror(0), mirror(45)]).elements == dihedral(4).elements
    assert FiniteGroup.generated_by("half turn", [rotation(180)]).order == 2


def test_one_agent_cannot_change_places() -> None:
    with pytest.raises(ValueError, match="two or more"):
        agent_permutations(1)


@pytest.mark.parametrize("count", range(2, 7))
def test_the_exchange_of_two_and_the_round_of_all_generate_every_order(count: int) -> None:
    two = [Element(permutation=places) for places in swap_and_round(count)]
    assert FiniteGroup.generated_by("orders", two).order == math.factorial(count)
    assert FiniteGroup.generated_by("exchange", two[:1]).order == 2, "the control"


def test_eight_agents_are_sampled_and_every_draw_is_an_order() -> None:
    group = agent_permutations(8)
    assert not isinstance(group, FiniteGroup)
    generator = torch.Generator().manual_seed(0)
    draws = [group.draw(generator) for _ in range(50)]
    assert len(set(draws)) > 40
    assert all(d in group for d in draws)
    assert Element(permutation=(1, 0)) not in group
    assert rotation(90) not in group


@pytest.mark.parametrize("plane", [PlaneGroup(mirrors=False), PlaneGroup(mirrors=True)], ids=["so2", "o2"])
def test_angles_are_drawn_uniformly(plane) -> None:
    generator = torch.Generator().manual_seed(1)
    draws = [plane.draw(generator) for _ in range(2000)]
    # The mean of cos and of sin of a uniform angle is 0 with a standard error of sqrt(1 / 2 / 2000) = 0.016.
    angles = np.array([float(PlaneElement.of(d).turn) * math.tau for d in draws])
    assert abs(np.cos(angles).mean()) < 0.05
    assert abs(np.sin(angles).mean()) < 0.05
    share = np.mean([PlaneElement.of(d).mirrored for d in draws])
    assert share == 0 if plane.name == "so2" else 0.45 < share < 0.55


def test_membership_of_continuous_groups() -> None:
    assert rotation("12.34") in PlaneGroup(mirrors=False)
    assert mirror(0) not in PlaneGroup(mirrors=False)
    assert mirror(0) in PlaneGroup(mirrors=True)
    assert Element(permutation=(1, 0)) not in PlaneGroup(mirrors=True)
    both = direct_product(PlaneGroup(mirrors=True), agent_permutations(2))
    assert both.name == "o2*agents"
    assert mirror(10) @ Element(permutation=(1, 0)) in both
    assert all(w in both for w in both.generators())
    assert "rot90" not in both
    with_items = direct_product(PlaneGroup(mirrors=True), agent_permutations(2), item_orders("marks", 3))
    swap = Element(items=(("marks", (1, 0, 2)),))
    assert mirror(10) @ Element(permutation=(1, 0)) @ swap in with_items
    assert swap not in both
    assert Element(items=(("marks", (1, 0)),)) not in with_items
    assert Element(items=(("cars", (1, 0, 2)),)) not in with_items
    assert with_items.draw(torch.Generator().manual_seed(0)) in with_items


def test_many_items_have_no_group_of_orders() -> None:
    with pytest.raises(ValueError, match="7 marks have no group of orders; 2 to 6 like items"):
        item_orders("marks", 7)
