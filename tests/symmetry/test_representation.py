"""L_g and K_g: by hand, as homomorphisms over random layouts, and against a world whose observations are computed."""

from dataclasses import replace

import numpy as np
import pytest

from esp_cli.symmetry import Element, PlaneElement, agent_permutations, dihedral, direct_product, mirror, rotation
from esp_cli.symmetry.representation import (
    action_map,
    field_operator,
    item_operator,
    joint_sources,
    layout_operator,
    rows_operator,
    state_operator,
)
from esp_envs.spec import Field, Items, Kind, Layout, Spaces, joint_layout, layout, others_of
from tests.symmetry.toy_actions import FOUR_DIRECTIONS, WHEEL_PAIRS

KINDS = [kind for kind in vars(Kind).values() if isinstance(kind, Kind)]
D4, D8 = dihedral(4), dihedral(8)
D4_AGENTS = direct_product(D4, agent_permutations(3))


def joint(row_layout: Layout, *elements: Element, num_agents: int = 3) -> np.ndarray:
    """Return L_g of all agents' rows, also where none moves."""
    stay = tuple(range(num_agents))
    places = np.array([e.permutation or stay for e in elements])
    rows = layout_operator(row_layout, elements).repeated(num_agents)
    return rows.ordered(joint_sources(row_layout, places)).matrix


def field_of(name: str, kind: Kind, count: int = 1, items: Items = Items.FIXED) -> Field:
    """Return a field of any kind; a picture has 3 x 3 pixels, a ring 8 rays, a record three parts."""
    parts = (Field("way", Kind.VECTOR), Field("spin", Kind.PSEUDOSCALAR), Field("seen", Kind.RING, 2, rays=8))
    shapes = {Kind.PICTURE: {"pixels": (3, 3)}, Kind.RING: {"rays": 8}, Kind.RECORD: {"parts": parts}}
    return Field(name, kind, count, items=items, **shapes.get(kind, {}))


def test_others_by_hand() -> None:
    assert others_of(3) == [[1, 2], [0, 2], [0, 1]]
    assert others_of(1) == [[]]


def test_all_kinds_are_tried() -> None:
    assert {kind.name for kind in KINDS} >= {"scalar", "pseudoscalar", "vector", "wheels", "picture", "ring", "record"}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_kinds_are_orthogonal_homomorphisms(kind: Kind) -> None:
    field = field_of("field", kind)
    group = D4 if kind == Kind.PICTURE else D8
    matrices = item_operator(field, group.elements).matrix
    assert matrices.shape == (group.order, field.width, field.width)
    np.testing.assert_allclose(matrices[:, None] @ matrices, matrices[group.product], atol=1e-15)
    identity = np.tile(np.eye(field.width), (group.order, 1, 1))
    np.testing.assert_allclose(matrices @ matrices.transpose(0, 2, 1), identity, atol=1e-15)


MARKED = layout(
    Field("velocity", Kind.VECTOR),
    Field("marks", Kind.VECTOR, 3),
    Field("cars", Kind.RECORD, 2, parts=(Field("place", Kind.VECTOR), Field("rate", Kind.PSEUDOSCALAR))),
)
ROUND = Element(items=(("marks", (1, 2, 0)), ("cars", (1, 0))))


def test_items_change_places_by_hand() -> None:
    # Mark 0 goes to place 1, 1 to 2, 2 to 0; the two cars change places, each with its rate.
    row = np.array([1, 2, 10, 11, 20, 21, 30, 31, 5, 6, 7, -5, -6, -7], dtype=float)
    moved, both = layout_operator(MARKED, [ROUND, mirror(0) @ ROUND]).matrix @ row
    np.testing.assert_array_equal(moved, [1, 2, 30, 31, 10, 11, 20, 21, -5, -6, -7, 5, 6, 7])
    np.testing.assert_array_equal(both, [1, -2, 30, -31, 10, -11, 20, -21, -5, 6, 7, 5, -6, -7])


@pytest.mark.parametrize("num_agents", [1, 2])
def test_orders_of_items_are_homomorphisms_and_signed_permutations(num_agents: int) -> None:
    swap = Element(items=(("marks", (1, 0, 2)),), permutation=(1, 0) if num_agents == 2 else None)
    elements = [swap, rotation(90) @ ROUND, swap @ rotation(90) @ ROUND]
    operator = rows_operator(MARKED, elements, num_agents)
    first, second, product = operator.matrix
    np.testing.assert_array_equal(first @ second, product)
    assert operator.terms == 1
    row = np.arange(1.0, operator.width + 1)
    np.testing.assert_array_equal(operator.push(row), operator.matrix @ row)


def test_a_state_of_all_rows_moves_the_items_of_each() -> None:
    observation = layout(Field("marks", Kind.SCALAR, 2))
    spaces = Spaces(
        num_agents=2,
        observation=observation,
        state=joint_layout(observation, 2),
        action=FOUR_DIRECTIONS,
        symmetry="c1*marks-2",
    )
    swap = Element(items=(("marks", (1, 0)),))
    np.testing.assert_array_equal(state_operator(spaces, [swap]).matrix[0] @ [1, 2, 3, 4], [2, 1, 4, 3])


def test_items_that_cannot_change_places_are_refused() -> None:
    with pytest.raises(ValueError, match="field 'marks' has 3 items, not 2"):
        layout_operator(MARKED, [Element(items=(("marks", (1, 0)),))])
    with pytest.raises(ValueError, match="items of field 'others' cannot be exchanged"):
        field_operator(field_of("others", Kind.SCALAR, 2, Items.OTHERS), [Element(items=(("others", (1, 0)),))])


def test_others_are_reordered_by_hand() -> None:
    # Row i: own number, then those of the others in index order. Agents 0, 1, 2 hold the numbers 10, 11, 12.
    row_layout = layout(Field("own", Kind.SCALAR), Field("others", Kind.SCALAR, 2, items=Items.OTHERS))
    rows = np.array([[10, 11, 12], [11, 10, 12], [12, 10, 11]], dtype=float)
    # Agent 0 goes to place 1, 1 to 2, 2 to 0: the places now hold 12, 10, 11.
    matrix = joint(row_layout, Element(permutation=(1, 2, 0)))[0]
    np.testing.assert_array_equal((matrix @ rows.ravel()).reshape(3, 3), [[12, 10, 11], [10, 12, 11], [11, 12, 10]])


def observe(positions: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """Compute rows [N, D] of `WORLD` from positions [N, 2] and a landmark [2]."""
    rows = []
    for i, own in enumerate(positions):
        others = np.delete(positions, i, axis=0) - own
        distances = np.linalg.norm(positions - own, axis=1)
        rows.append(np.concatenate([landmark - own, others.ravel(), distances]))
    return np.array(rows)


WORLD = layout(
    Field("landmark", Kind.VECTOR),
    Field("others", Kind.VECTOR, 2, items=Items.OTHERS),
    Field("distances", Kind.SCALAR, 3, items=Items.AGENTS),
)


def test_transforming_rows_equals_observing_the_transformed_world() -> None:
    rng = np.random.default_rng(0)
    positions, landmark = rng.normal(size=(3, 2)), rng.normal(size=2)
    matrices = joint(WORLD, *D4_AGENTS.elements)
    for element, matrix in zip(D4_AGENTS.elements, matrices, strict=True):
        moved = np.empty_like(positions)
        for i in range(3):
            place = i if element.permutation is None else element.permutation[i]
            moved[place] = PlaneElement.of(element).matrix @ positions[i]
        expected = observe(moved, PlaneElement.of(element).matrix @ landmark)
        np.testing.assert_allclose((matrix @ observe(positions, landmark).ravel()).reshape(3, -1), expected, atol=1e-15)


def random_layout(rng: np.random.Generator, num_agents: int):
    counts = {Items.FIXED: None, Items.OTHERS: num_agents - 1, Items.AGENTS: num_agents}
    fields = []
    for i in range(rng.integers(1, 7)):
        items = list(Items)[rng.integers(3)]
        count = counts[items] or int(rng.integers(1, 4))
        fields.append(field_of(f"f{i}", KINDS[rng.integers(len(KINDS))], count, items))
    return layout(*fields)


@pytest.mark.parametrize("seed", range(20))
def test_joint_matrices_are_homomorphisms_over_random_layouts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    row_layout = random_layout(rng, 3)
    g = rng.integers(D4_AGENTS.order, size=40)
    h = rng.integers(D4_AGENTS.order, size=40)
    matrices = joint(row_layout, *D4_AGENTS.elements)
    # Signed permutation matrices: products are exact.
    np.testing.assert_array_equal(matrices[g] @ matrices[h], matrices[D4_AGENTS.product[g, h]])
    inverses = joint(row_layout, *(element.inverse() for element in D4_AGENTS.elements))
    np.testing.assert_array_equal(inverses, matrices.transpose(0, 2, 1))
    np.testing.assert_array_equal(np.abs(matrices).sum(axis=2), 1)


def test_states_are_homomorphisms_and_a_joint_state_moves_like_the_rows(make_spec) -> None:
    own = state_operator(make_spec(), D4_AGENTS.elements).matrix
    np.testing.assert_array_equal(own[:, None] @ own, own[D4_AGENTS.product])
    spec = make_spec(joint_state=True)
    expected = joint(spec.observation, *D4_AGENTS.elements)
    np.testing.assert_array_equal(state_operator(spec, D4_AGENTS.elements).matrix, expected)


def test_a_state_by_hand(make_spec) -> None:
    # positions of agents 0, 1, 2; two landmarks; turning rates of agents 0, 1, 2.
    state = np.array([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0.1, 0.2, 0.3])
    element = mirror(0) @ Element(permutation=(1, 2, 0))
    got = state_operator(make_spec(), [element]).matrix[0] @ state
    np.testing.assert_array_equal(got, [5, -6, 1, -2, 3, -4, 7, -8, 9, -10, -0.3, -0.1, -0.2])


def test_actions_by_hand() -> None:
    stay, left, right, down, up = range(5)
    turned, mirrored = action_map(FOUR_DIRECTIONS, [rotation(90), mirror(0)])
    assert turned.tolist() == [stay, down, up, right, left]
    assert mirrored.tolist() == [stay, left, right, up, down]


def test_wheel_pairs_ignore_turns_and_swap_in_a_mirror() -> None:
    turned, mirrored = action_map(WHEEL_PAIRS, [rotation("33.3"), mirror("12.5")])
    assert turned.tolist() == [0, 1, 2, 3]
    assert mirrored.tolist() == [0, 1, 3, 2]


def test_items_that_cannot_follow_are_refused(make_spec) -> None:
    swap = Element(permutation=(1, 0, 2))
    with pytest.raises(ValueError, match="field 'others' has 4 items for 2 other agents"):
        joint(layout(Field("others", Kind.VECTOR, 4, items=Items.OTHERS)), swap)
    with pytest.raises(ValueError, match="field 'tags' has 2 items for 3 agents"):
        joint(layout(Field("tags", Kind.SCALAR, 2, items=Items.AGENTS)), swap)
    odd = replace(make_spec(), state=layout(Field("others", Kind.VECTOR, 2, items=Items.OTHERS)))
    with pytest.raises(ValueError, match="a state has no observer"):
        state_operator(odd, [swap])
