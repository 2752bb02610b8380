"""Rings of rays, records of several numbers, and actions that share a meaning."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from esp_cli.symmetry import PlaneElement, build_transform, mirror, parse_elements, rotation
from esp_cli.symmetry.representation import action_map, rows_operator
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete, Field, Items, Kind, layout
from tests.symmetry.toy_actions import FORCE

RING = layout(Field("lidar", Kind.RING, rays=12))
SEEN = (Field("way", Kind.VECTOR), Field("on_goal", Kind.SCALAR), Field("spin", Kind.PSEUDOSCALAR))


def lidar(points: list[tuple[float, float]]) -> torch.Tensor:
    """What 12 rays see of small bodies: how well a ray points at one, by plain geometry."""
    angles = [2 * math.pi * k / 12 for k in range(12)]
    rays = [max(x * math.cos(a) + y * math.sin(a) for x, y in points) for a in angles]
    return torch.tensor(rays, dtype=torch.float32)


@pytest.mark.parametrize("element", [rotation(30), rotation(90), rotation(210), mirror(0), mirror(15), mirror(90)])
def test_a_ring_shows_what_the_rays_would_see_of_the_turned_scene(make_spec, element) -> None:
    spec = replace(make_spec(action=FORCE), observation=RING, state=RING)
    points = [(1.0, 0.2), (-0.3, 0.7)]
    turned = [tuple(PlaneElement.of(element).matrix @ np.array(point)) for point in points]
    seen = build_transform([element], spec).obs(lidar(points).view(1, 1, 12))
    torch.testing.assert_close(seen.flatten(), lidar(turned), atol=1e-6, rtol=0)
    assert not torch.allclose(lidar(points), lidar(turned), atol=0.05), "the scene itself must look different"


def test_a_ray_between_rays_is_refused() -> None:
    with pytest.raises(ValueError, match="as they do under d12, d3, d4, d6"):
        rows_operator(RING, [rotation(45)], 1)


def test_a_record_transforms_part_by_part() -> None:
    record = layout(Field("food", Kind.RECORD, 2, parts=SEEN))
    assert record.width == 8
    apart = layout(*(replace(part, name=f"{part.name}{i}") for i in range(2) for part in SEEN))
    for element in (rotation(90), rotation(33), mirror(10)):
        whole, parts = (rows_operator(each, [element], 1).matrix for each in (record, apart))
        np.testing.assert_array_equal(whole, parts)


def test_a_records_items_follow_the_agents() -> None:
    record = layout(Field("others", Kind.RECORD, 2, parts=SEEN, items=Items.OTHERS))
    split = layout(*(replace(part, count=2, items=Items.OTHERS) for part in SEEN))
    # from item after item to field after field
    order = [0, 1, 4, 5, 2, 6, 3, 7]
    rows = torch.randn(3, 8, dtype=torch.float64)
    for element in parse_elements("agents-2-0-1,rot90*agents-1-0-2,flip22.5*agents-0-2-1", 3):
        ours = torch.as_tensor(rows_operator(record, [element], 3).matrix[0]) @ rows.flatten()
        theirs = torch.as_tensor(rows_operator(split, [element], 3).matrix[0]) @ rows[:, order].flatten()
        torch.testing.assert_close(ours.view(3, 8)[:, order], theirs.view(3, 8))


def test_records_and_rings_stand_beside_pictures() -> None:
    mixed = layout(
        Field("picture", Kind.PICTURE, pixels=(3, 3)),
        Field("lidar", Kind.RING, rays=8),
        Field("others", Kind.RECORD, 2, parts=SEEN, items=Items.OTHERS),
    )
    elements = parse_elements("rot90*agents-2-0-1,flip-x", 3)
    operator = rows_operator(mixed, elements, 3)
    row = np.random.default_rng(0).normal(size=mixed.width * 3)
    assert operator.terms == 1
    np.testing.assert_array_equal(operator.push(row), operator.matrix @ row)


def test_the_pixels_of_a_picture_hold_directions() -> None:
    """A quarter turn brings what is on the right to the top, and turns the way and the ray that stand there."""
    way = Field("way", Kind.VECTOR), Field("facing", Kind.RING, rays=4)
    cells = layout(Field("cells", Kind.PICTURE, pixels=(3, 3), parts=way))
    assert (cells.width, cells.fields[0].described) == (
        54,
        "picture of 3 x 3 of way (vector x 1), facing (ring of 4 rays x 1) x 1",
    )
    before, after = np.zeros((3, 3, 6)), np.zeros((3, 3, 6))
    before[1, 2] = [1, 2, 1, 0, 0, 0]
    after[0, 1] = [-2, 1, 0, 1, 0, 0]
    turned = rows_operator(cells, [rotation(90)], 1).push(before.ravel())
    np.testing.assert_array_equal(turned[0], after.ravel())


def test_items_that_are_sorted_are_sorted_anew(make_spec) -> None:
    """By y from the top, then by x: of (-1, 1), (2, 1), (0, 0) a quarter turn makes (-1, -1), (-1, 2), (0, 0)."""
    marks = Field(
        "marks", Kind.RECORD, 3, parts=(Field("at", Kind.VECTOR), Field("name", Kind.SCALAR)), sorted_by=(-2, 1)
    )
    spec = replace(make_spec(action=FORCE), observation=layout(marks), state=layout(marks), num_agents=1)
    seen = torch.tensor([-1.0, 1, 7, 2, 1, 8, 0, 0, 9])
    transform = build_transform([rotation(90)], spec)
    expected = [-1, 2, 8, 0, 0, 9, -1, -1, 7]
    assert transform.obs(seen.view(1, 1, 1, 9)).flatten().tolist() == expected
    assert transform.state(seen.view(1, 1, 9)).flatten().tolist() == expected
    unsorted = replace(spec, observation=layout(replace(marks, sorted_by=())))
    assert build_transform([rotation(90)], unsorted).obs(seen.view(1, 1, 1, 9)).flatten().tolist() != expected


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"kind": Kind.VECTOR, "sorted_by": (3,)}, r"sorted_by is \(3,\); give which numbers"),
        ({"kind": Kind.VECTOR, "sorted_by": (1,), "items": Items.AGENTS}, "of items that are no agents"),
        ({"kind": Kind.RING}, "a ring, and nothing else, says how many rays"),
        ({"kind": Kind.VECTOR, "rays": 4}, "a ring, and nothing else"),
        ({"kind": Kind.VECTOR, "rays": -1}, "a ring, and nothing else"),
        ({"kind": Kind.PICTURE, "pixels": (0, 4)}, r"pixels are \(0, 4\); give at least one row"),
        ({"kind": Kind.PICTURE}, "a picture, and nothing else"),
        ({"kind": Kind.VECTOR, "pixels": (2, 2)}, "a picture, and nothing else"),
        ({"kind": Kind.RECORD}, "a record, and nothing else but a picture, says"),
        ({"kind": Kind.SCALAR, "parts": SEEN}, "a record, and nothing else"),
        ({"kind": Kind.RECORD, "parts": (Field("x", Kind.SCALAR, items=Items.OTHERS),)}, "count over no agents"),
    ],
)
def test_fields_that_contradict_themselves_are_refused(changes, sentence) -> None:
    with pytest.raises(ValueError, match=sentence):
        Field("odd", **changes)


STAY = (0.0, 0.0)
WALK_OR_PUSH = Discrete(
    Kind.VECTOR,
    (STAY, RIGHT, UP, LEFT, DOWN, STAY, UP, RIGHT, DOWN, LEFT),
    ("stay", "walk-e", "walk-n", "walk-w", "walk-s", "load", "push-n", "push-e", "push-s", "push-w"),
)


def test_actions_of_one_meaning_keep_their_order() -> None:
    (table,) = action_map(WALK_OR_PUSH, [rotation(90)])
    become = {WALK_OR_PUSH.names[j]: WALK_OR_PUSH.names[k] for j, k in enumerate(table)}
    assert become["stay"] == "stay"
    assert become["load"] == "load"
    assert become["walk-e"] == "walk-n"
    assert become["push-e"] == "push-n"
    assert become["push-n"] == "push-w"
    for element in (rotation(90), rotation(180), mirror(0), mirror(45)):
        assert sorted(action_map(WALK_OR_PUSH, [element])[0]) == list(range(10))


def test_an_action_that_is_single_in_one_direction_is_refused() -> None:
    lopsided = Discrete(Kind.VECTOR, (RIGHT, UP, LEFT, DOWN, RIGHT), ("e", "n", "w", "s", "push-e"))
    with pytest.raises(ValueError, match="action 'push-e' turned by 90 degrees is no action"):
        action_map(lopsided, [rotation(90)])


def test_two_actions_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="a name of its own"):
        Discrete(Kind.VECTOR, (UP, DOWN), ("go", "go"))
