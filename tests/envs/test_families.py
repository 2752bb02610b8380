"""Layouts say which items are like things, and which vectors are places."""

import pytest
import torch

from esp_envs import Field, Items, Kind, UserError, layout, make


def test_fields_of_one_family_are_joined_and_the_rest_stands_for_itself():
    seen = layout(
        Field("speed", Kind.VECTOR),
        Field("food", Kind.VECTOR, 2, family="food"),
        Field("others", Kind.VECTOR, 3, items=Items.OTHERS),
        Field("ripe", Kind.SCALAR, 2, family="food"),
        Field("corners", Kind.VECTOR, 4),
        Field("load", Kind.SCALAR, 3, items=Items.OTHERS),
    )
    assert [part.field.name for part in seen.own] == ["speed", "corners"]
    assert [(f.name, f.count, f.width) for f in seen.families] == [("food", 2, 3), ("others", 3, 3)]
    # speed 0..1, food 2..5, others 6..11, ripe 12..13, corners 14..21, load 22..24
    assert [part.where for part in seen.families[0].parts] == [slice(2, 6), slice(12, 14)]
    assert [part.where for part in seen.families[1].parts] == [slice(6, 12), slice(22, 25)]


def test_a_family_of_unlike_counts_is_refused():
    seen = layout(Field("food", Kind.VECTOR, 2, family="food"), Field("ripe", Kind.SCALAR, 3, family="food"))
    with pytest.raises(UserError, match=r"'food' has 2 items and 'ripe' 3"):
        _ = seen.families


@pytest.mark.parametrize(
    ("field", "reason"),
    [
        ({"kind": Kind.PICTURE, "pixels": (3, 3), "family": "views"}, "channels of a picture are no like things"),
        ({"kind": Kind.SCALAR, "is_point": True}, "a scalar is no place"),
        ({"kind": Kind.VECTOR, "family": 3}, "family is 3; give a text"),
    ],
)
def test_what_is_no_family_and_no_place_is_refused(field, reason):
    with pytest.raises(UserError, match=reason):
        Field("seen", **field)


def _names(layout):
    return [part.field.name for part in layout.own], {f.name: f.count for f in layout.families}


def test_what_the_bundled_tasks_show():
    assert _names(make("navigation", 1, [0]).spec.observation) == (
        ["velocity", "position"],
        {"landmarks": 3, "others": 2},
    )
    assert _names(make("navigation", 1, [0]).spec.state) == ([], {"agents": 3, "landmarks": 3})
    own, families = _names(make("predator-prey", 1, [0]).spec.observation)
    assert own == ["velocity", "position"]
    assert families == {"obstacles": 2, "others": 2, "prey": 1}
    assert _names(make("predator-prey", 1, [0]).spec.state)[1] == {"predators": 3, "prey": 1, "obstacles": 2}


def _shifted(layout, row, way):
    """Return a row in which every place is shifted."""
    row = row.clone()
    for field, where in zip(layout.fields, layout.slices().values(), strict=True):
        if field.is_point:
            row[..., where] += way.repeat(field.count)
    return row


@pytest.mark.parametrize(("settings", "holds"), [({}, True), ({"mud": 0.5}, False)])
def test_navigation_stays_as_it_is_when_shifted_unless_half_of_it_is_mud(settings, holds):
    one, other = make("navigation", 8, [0], settings), make("navigation", 8, [0], settings)
    spec, way = one.spec, torch.tensor([0.5, -0.25])
    assert spec.shifts is holds
    state = one.reset().state
    # velocities first, so that mud has something to slow down
    state[..., :6] = torch.linspace(-1, 1, 6)
    one.set_state(state)
    other.set_state(_shifted(spec.state, state, way))
    action = one.random_action()
    here, there = one.step(action), other.step(action)
    gap = (_shifted(spec.observation, here.next.obs, way) - there.next.obs).abs().amax()
    assert bool(gap < 1e-5) is holds
    if holds:
        torch.testing.assert_close(here.reward, there.reward, atol=1e-4, rtol=0)
