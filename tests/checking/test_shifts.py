"""Shifts of every place: tried where a task declares them, or where asked."""

import pytest
import torch

from esp_cli.checking import check_symmetry
from esp_cli.checking.shifting import Shift, leaves
from esp_envs import Discrete, Field, Kind, Spaces, UserError, layout, make


def worlds(**settings):
    return lambda num_envs, seeds: make("navigation", num_envs, seeds, settings)


def test_places_alone_are_shifted_by_hand():
    body = Field("body", Kind.RECORD, 2, parts=(Field("v", Kind.VECTOR), Field("at", Kind.VECTOR, is_point=True)))
    seen = layout(Field("speed", Kind.VECTOR), Field("place", Kind.VECTOR, is_point=True), body)
    moves = Discrete(Kind.VECTOR, ((1.0, 0.0), (-1.0, 0.0)), ("right", "left"))
    spec = Spaces(num_agents=1, observation=seen, state=seen, action=moves, symmetry="d1")
    shifted = Shift(spec).obs(torch.zeros(12)).tolist()
    assert shifted == pytest.approx([0, 0, 1.2361, -0.7639] * 3)


def test_a_row_is_taken_apart_by_hand():
    parts = (Field("place", Kind.VECTOR), Field("size", Kind.SCALAR, 2))
    fields = (Field("speed", Kind.SCALAR), Field("things", Kind.RECORD, 2, parts=parts), Field("goal", Kind.VECTOR))
    found = [(field.name, where.start, where.stop) for field, where in leaves(fields)]
    things = [("place", 1, 3), ("size", 3, 5), ("place", 5, 7), ("size", 7, 9)]
    assert found == [("speed", 0, 1), *things, ("goal", 9, 11)]


def test_a_declared_shift_is_tried_unasked_and_holds():
    report = check_symmetry(worlds())
    shift = report.elements[-1]
    assert (shift.element, shift.declared, shift.outcome) == ("shift", True, "holds")
    assert report.holds
    assert report.found.startswith("d4")
    assert all(verdict.element != "shift" for verdict in check_symmetry(worlds(), "rot90").elements)


def test_where_absolute_place_matters_a_shift_is_broken():
    # mud slows agents on one side of the square
    (shift,) = check_symmetry(worlds(mud=0.5), "shift").elements
    assert (shift.declared, shift.outcome) == (False, "broken")
    assert "obs.velocity" in [field.field for field in shift.fields if field.outcome == "broken"]


def test_transitions_do_not_cover_it_and_without_places_it_is_refused():
    (shift,) = check_symmetry(worlds(), "shift", from_transitions=True).elements
    assert (shift.outcome, shift.reason) == ("not covered", "shifts are tried where a task can be set to a state")
    seen = layout(Field("goal", Kind.VECTOR))
    moves = Discrete(Kind.VECTOR, ((1.0, 0.0), (-1.0, 0.0)), ("right", "left"))
    with pytest.raises(UserError, match="no field of its state is a place"):
        Shift(Spaces(num_agents=1, observation=seen, state=seen, action=moves, symmetry="d1"))
