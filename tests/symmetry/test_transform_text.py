"""What a user may write, and what one sentence she gets for the rest."""

import pytest

from esp_cli.symmetry import FiniteGroup, Group, mirror, parse, parse_elements, parse_group
from esp_cli.symmetry.admission import scene_of
from esp_envs.errors import UserError


def names(text: str, num_agents: int = 3) -> list[str]:
    elements = parse_elements(text, num_agents)
    assert isinstance(elements, tuple)
    return [e.name for e in elements]


def test_lists_keep_their_order_and_drop_doubles_and_the_identity() -> None:
    assert names("flip-x, rot90,ROT90,identity") == ["flip-x", "rot90"]
    assert names("c4,rot90,flip-y") == ["rot90", "rot180", "rot270", "flip-y"]


def test_groups() -> None:
    assert len(names("d4")) == 7
    assert names("c2") == ["rot180"]
    assert names("agents", 2) == ["agents-1-0"]
    assert len(names("d4*agents")) == 8 * 6 - 1
    assert names("rot450") == ["rot90"]


def test_products_compose_with_the_right_factor_first() -> None:
    assert names("rot90*flip-x") == ["flip-diagonal"]
    assert names("rot90*agents-1-0-2") == ["rot90*agents-1-0-2"]


@pytest.mark.parametrize("group", ["c4", "d4", "c7", "d8", "agents", "d2*agents"])
def test_every_name_reads_back(group: str) -> None:
    for name in names(group):
        assert names(name) == [name]


@pytest.mark.parametrize("text", ["so2", "o2", "so2*agents", "o2*agents"])
def test_continuous_groups_are_sampled(text: str) -> None:
    group = parse_elements(text, 3)
    assert isinstance(group, Group)
    assert group.name == text


def test_large_products_are_sampled() -> None:
    group = parse_elements("d4*agents", 8)
    assert isinstance(group, Group)
    assert group.name == "d4*agents"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rot", "unknown transform 'rot'; write for example"),
        ("rot90,spin", "unknown transform 'spin' in 'rot90,spin'"),
        ("", "unknown transform ''"),
        ("rot90,", "unknown transform '' in 'rot90,'"),
        ("rot1/0", "unknown transform 'rot1/0'"),
        ("rot" + "9" * 5000, "unknown transform 'rot999"),
        ("flip1/" + "9" * 5000, "unknown transform 'flip1/999"),
        ("c0", "'c0' is out of range"),
        ("c999", "'c999' is out of range"),
        ("identity", "only the identity"),
        ("rot360", "only the identity"),
        ("so2,rot90", "list a group that is sampled"),
        ("flip-x*so2", "multiplies a sampled group"),
        ("agents-0-1", "not an order of 3 agents"),
        ("agents-0-0-1", "not an order of 3 agents"),
        ("agents*agents", "not a direct product"),
        ("marks-3*marks-3", "not a direct product"),
        ("marks-1-2-3", "'marks-1-2-3' is not an order of 3 marks; write each place once, as in marks-1-2-0"),
        ("marks-7", "unknown transform 'marks-7'"),
        ("rto-90", "unknown transform 'rto-90'"),
        ("d100*d100", "40000 products"),
    ],
)
def test_refusals(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$") as caught:
        parse_elements(text, 3)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "order", "same_as"),
    [
        ("rot90", 4, "c4"),  # an element stands for the group that it generates
        ("agents*d4", 48, "d4*agents"),
        ("d4*d4", 8, "d4"),
        ("d4*agents*agents", 48, "d4*agents"),
        ("rot90,flip-x", 8, "d4"),
        ("flip-y*agents", 12, None),
        ("flip-x*agents-2-1-0", 2, None),
        ("flip-x*hips-3-2-1-0", 2, None),
        ("flip-x*hips-3-2-1-0*agents", 12, None),
        ("flip-x*hips-3-2-1-0,flip-y*hips-1-0-3-2", 4, None),
        ("rot90*hips-1-2-3-0", 4, None),
        ("rot90*marks-1-2-0", 12, None),
        ("c4*rot90*hips-1-2-3-0", 16, None),
        ("so2*hips-1-0", None, "so2*hips-2"),
        ("identity", 1, "c1"),
    ],
)
def test_a_declared_symmetry_is_the_group_that_it_generates(text: str, order: int | None, same_as: str | None) -> None:
    group = parse_group(text, 3)
    if order is not None:
        assert isinstance(group, FiniteGroup)
        assert group.order == order
        assert same_as is None or group.elements == parse_group(same_as, 3).elements
        assert {g @ h for g in group.elements for h in group.elements} == set(group.elements)
    assert all(g in group for g in parse_group(same_as or text, 3).generators())


def test_coupled_generators_hold_together_alone() -> None:
    coupled = parse_group("flip-x*hips-3-2-1-0,flip-y*hips-1-0-3-2", 1)
    assert [e.name for e in coupled.elements] == [
        "identity",
        "flip-y*hips-1-0-3-2",
        "rot180*hips-2-3-0-1",
        "flip-x*hips-3-2-1-0",
    ]
    assert mirror() not in coupled
    assert mirror() @ parse_elements("hips-1-0-3-2", 1)[0] not in coupled, "the other order"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("foo", "unknown transform 'foo'"),
        ("d4*", "unknown transform '' in 'd4*'"),
        ("rot0.1*hips-1-0", "'rot0.1*hips-1-0' has more than 1024 elements"),
        ("d360,rot0.45", "'d360,rot0.45' has more than 1024 elements"),
        ("o2,rot90*hips-1-0", "'o2,rot90*hips-1-0' generates no group that can be listed"),
        ("flip-x*agents-1-0", "'agents-1-0' is not an order of 3 agents"),
        ("marks-1-0,marks-1-2-0", "things cannot be composed; give both one length"),
    ],
)
def test_what_generates_no_group(text: str, message: str) -> None:
    with pytest.raises(UserError, match=r"^[^\n]+$") as caught:
        parse_group(text, 3)
    assert message in str(caught.value)


def test_factors_of_a_product_may_stand_in_any_order_behind_the_plane() -> None:
    names = {group: {e.name for e in parse_elements(group, 2)} for group in ("d4*cars-2*agents", "d4*agents*cars-2")}
    assert len(set(map(frozenset, names.values()))) == 1
    assert parse_group("d4*marks-3*agents*Cars-2", 2).name == "d4*agents*Cars-2*marks-3"


@pytest.mark.parametrize(
    ("symmetry", "scene"),
    [
        ("D4 * agents*Marks-3*cars-2", "d4"),
        ("agents*marks-3", ""),
        ("c1*agents", "c1"),
        ("flip-x*Marks-1-0*agents", "flip-x*Marks-1-0"),
        ("flip-x*marks-1-0,flip-y*agents", "flip-x*marks-1-0,flip-y*agents"),
    ],
)
def test_what_a_symmetry_does_to_the_scene(symmetry: str, scene: str) -> None:
    assert scene_of(symmetry, 3) == scene


def test_a_reader_of_ones_own_comes_before_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parse, "READERS", [*parse.READERS, lambda word, _: mirror() if word == "hex-6" else None])
    assert parse_elements("hex-6", 1) == (mirror(),)
