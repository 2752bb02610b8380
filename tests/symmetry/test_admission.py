"""Which groups a task carries, and how the others are refused."""

from dataclasses import replace

import pytest

from esp_cli.symmetry import admit_declared, carried_groups, default_transforms, transform_set
from esp_cli.symmetry.admission import exchangeable
from esp_envs.spec import Discrete, Field, Items, Kind, Spaces, layout
from tests.symmetry.toy_actions import FORCE, WHEEL_PAIRS

UP_TO_D4 = ("c2", "d2", "c4", "d4")
ALL = (*UP_TO_D4, "c8", "d8", "so2", "o2")


def test_four_directions_carry_d4_whatever_the_dynamics_carry(make_spec) -> None:
    assert carried_groups(make_spec()) == (*UP_TO_D4, "agents")


def test_forces_and_wheels_carry_what_the_dynamics_carry(make_spec) -> None:
    assert carried_groups(make_spec(action=FORCE)) == (*ALL, "agents")
    assert carried_groups(make_spec(action=WHEEL_PAIRS)) == (*ALL, "agents")
    assert carried_groups(make_spec(action=FORCE, symmetry="so2*agents")) == ("c2", "c4", "c8", "so2", "agents")
    assert carried_groups(make_spec(action=FORCE, symmetry="d4*agents")) == (*UP_TO_D4, "agents")
    assert carried_groups(make_spec(action=FORCE, symmetry="agents")) == ("agents",)


def test_agents_need_company_and_a_state_that_names_them(make_spec) -> None:
    assert "agents" not in carried_groups(make_spec(1))
    nameless = replace(make_spec(), state=layout(Field("positions", Kind.VECTOR, 5)))
    assert "agents" not in carried_groups(nameless)
    assert "agents" in carried_groups(make_spec(joint_state=True))


def test_actions_that_cannot_follow_are_refused_in_one_sentence(make_spec) -> None:
    with pytest.raises(ValueError, match=r"^c8 cannot act on toy: ") as caught:
        transform_set("c8", make_spec())
    assert str(caught.value) == (
        "c8 cannot act on toy: action 'left' turned by 45 degrees is no action; "
        "use continuous actions or a group within d4"
    )


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        ("so2", {}, "action 'left' turned by 57.2958 degrees is no action; use continuous actions or a group within"),
        ("rot90,flip22.5", {}, "action 'left' mirrored by flip22.5 is no action"),
        ("c8", {"symmetry": "d4"}, "is no action; use continuous actions or a group within d4"),
        ("c8", {"action": FORCE, "symmetry": "d4"}, "rot45 is no symmetry of its dynamics and reward, which carry d4"),
        ("flip-x", {"action": FORCE, "symmetry": "so2"}, "flip-x is no symmetry .*; use a group within so2"),
        ("o2", {"action": FORCE, "symmetry": "d4"}, "rot57.296 is no symmetry"),
        ("rot90", {"symmetry": "c1*agents"}, "rot90 is no symmetry .* carry c1; use agents"),
        ("flip-x", {"symmetry": "flip-y"}, "flip-x is no symmetry .*, which carry flip-y; use a group within flip-y"),
        ("agents", {"symmetry": "d4"}, "declared symmetry, d4, does not say that agents may be exchanged; use a group"),
        ("d4*agents", {"symmetry": "d4"}, "does not say that agents may be exchanged; use a group within d4"),
        ("rot90,agents-1-0-2", {"symmetry": "o2"}, "does not say that agents may be exchanged"),
        (
            "landmarks-2",
            {},
            "symmetry, o2.agents, does not say that its landmarks may be exchanged; use a group within",
        ),
        ("landmarks-3", {"symmetry": "d4*landmarks-3"}, "field 'landmarks' has 2 items, not 3"),
        ("others-1-0", {}, "items of field 'others' cannot be exchanged: they are the agents'"),
        ("islands-1-0", {}, "toy has no field 'islands', but velocity"),
    ],
)
def test_refusals(make_spec, text, changes, message) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        transform_set(text, make_spec(**changes))
    assert "\n" not in str(caught.value)


def test_agents_are_refused_where_layouts_do_not_name_them(make_spec) -> None:
    nameless = replace(make_spec(), state=layout(Field("positions", Kind.VECTOR, 5)))
    with pytest.raises(
        ValueError, match="state does not say which numbers belong to which agent; use a group within d4"
    ):
        transform_set("d4*agents", nameless)
    with pytest.raises(ValueError, match="use --prior none"):
        transform_set("rot90", replace(nameless, symmetry="c1"))


def test_a_single_element_can_be_declared(make_spec) -> None:
    spec = make_spec(symmetry="flip-y*agents")
    assert carried_groups(spec) == ("flip-y", "agents")
    assert transform_set("flip-y*agents-1-0-2", spec).names == ("flip-y*agents-1-0-2",)


def test_declared_orders_of_items_are_carried(make_spec) -> None:
    spec = make_spec(symmetry="d4*agents*landmarks-2")
    assert carried_groups(spec) == (*UP_TO_D4, "agents", "landmarks-2")
    assert transform_set("d4*agents*landmarks-2", spec).size == 8 * 6 * 2 - 1
    assert transform_set("rot90*landmarks-1-0", spec).names == ("rot90*landmarks-1-0",)


def test_what_is_discovered_may_order_items_that_are_not_declared(make_spec) -> None:
    assert transform_set("discovered:d4*landmarks-2", make_spec(symmetry="c1")).size == 15
    with pytest.raises(ValueError, match="toy has no field 'islands', but velocity, battery, "):
        transform_set("discovered:islands-1-0", make_spec(symmetry="c1"))


def test_a_state_without_the_items_is_refused(make_spec) -> None:
    spec = replace(make_spec(symmetry="d4*landmarks-2"), state=layout(Field("goals", Kind.VECTOR, 2)))
    with pytest.raises(ValueError, match="its state does not hold its landmarks"):
        transform_set("landmarks-1-0", spec)
    with pytest.raises(ValueError, match="its state does not hold its landmarks"):
        transform_set("discovered:landmarks-1-0", spec)


def test_fields_whose_items_may_change_places() -> None:
    """Two fields of all: the others are one item, too many, the agents', pictures, or have a name that is no word."""
    observation = layout(
        Field("Marks", Kind.VECTOR, 3),
        Field("cars_2", Kind.SCALAR, 2),
        Field("own", Kind.VECTOR),
        Field("crowd", Kind.SCALAR, 7),
        Field("others", Kind.SCALAR, 2, items=Items.OTHERS),
        Field("shades", Kind.PICTURE, 2, pixels=(3, 3)),
        *(Field(name, Kind.SCALAR, 2) for name in ("agents", "rot", "my marks", "cube.place", "marks-2")),
    )
    spaces = Spaces(num_agents=3, observation=observation, state=observation, action=FORCE, symmetry="c1")
    assert exchangeable(spaces) == {"Marks": 3, "cars_2": 2}
    assert transform_set("discovered:Marks-1-0-2", spaces).names == ("Marks-1-0-2",)


def test_a_ring_carries_the_turns_between_its_rays(make_spec) -> None:
    ring = layout(Field("lidar", Kind.RING, rays=6))
    spec = replace(make_spec(action=FORCE), observation=ring, state=ring)
    assert carried_groups(spec) == ("c2", "d2")
    assert transform_set("rot60,flip30", spec).size == 2
    with pytest.raises(
        ValueError, match=r"the rays of a ring of 6 do not come to lie on rays, as they do under d6, d3"
    ):
        transform_set("rot90", spec)


def test_a_picture_carries_what_moves_its_pixels_onto_pixels(make_spec) -> None:
    for pixels, groups in (((5, 5), UP_TO_D4), ((4, 6), ("c2", "d2"))):
        seen = layout(Field("camera", Kind.PICTURE, pixels=pixels))
        spec = replace(make_spec(action=FORCE), observation=seen, state=seen)
        assert carried_groups(spec) == groups
        with pytest.raises(ValueError, match=r"pixels of a picture of . x . do not come to lie .*; use a group within"):
            transform_set("o2", spec)


@pytest.mark.parametrize(
    ("symmetry", "action", "chosen"),
    [
        ("o2*agents", None, "d4"),
        ("c4", None, "c4"),
        ("c8", FORCE, "c8"),
        ("c8*agents", None, "c4"),  # four directions do not carry c8
        ("so2*agents", FORCE, "c4"),
        ("flip-y*agents", None, "flip-y"),
        ("c1*agents", None, "agents"),
        ("c1", None, "d4"),  # which is refused
    ],
)
def test_where_nobody_chooses_a_task_gets_what_it_declares(make_spec, symmetry: str, action, chosen: str) -> None:
    spec = make_spec(symmetry=symmetry, **({} if action is None else {"action": action}))
    assert default_transforms(spec) == chosen


def test_what_is_weighed_need_not_be_declared(make_spec) -> None:
    chosen = {"c1": "d4", "o2": "d4", "flip-x*agents": "d4", "agents": "d4,agents"}
    for symmetry, transforms in chosen.items():
        assert default_transforms(make_spec(symmetry=symmetry), weighed=True) == transforms
    assert default_transforms(make_spec(6, symmetry="agents"), weighed=True) == "d4", "719 orders are too many"
    skewed = Discrete(Kind.VECTOR, ((1.0, 0.0), (0.0, 1.0)), ("right", "up"))
    assert default_transforms(make_spec(action=skewed, symmetry="agents"), weighed=True) == "agents"


def test_a_symmetry_that_means_nothing_or_cannot_act_is_refused(make_spec) -> None:
    admit_declared(make_spec(symmetry="d4*agents"))
    admit_declared(make_spec(1, symmetry="c1*agents"))
    for word in ("foo", "any", "any-scene"):
        with pytest.raises(ValueError, match=f"unknown transform '{word}'"):
            admit_declared(make_spec(symmetry=word))
    with pytest.raises(ValueError, match="c8 cannot act on toy: action 'left' turned by 45 degrees"):
        admit_declared(make_spec(symmetry="c8"))
    with pytest.raises(ValueError, match="goals-3 cannot act on toy: toy has no field 'goals'"):
        admit_declared(replace(make_spec(symmetry="c4"), nearly="d4*goals-3"))
