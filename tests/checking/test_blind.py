"""A search that is told nothing of the numbers finds the whole group, and no more."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sympy.combinatorics import Permutation, PermutationGroup

from esp_cli.checking import Transitions, blind, collect
from esp_cli.checking.blind import discover_blindly, search
from esp_cli.checking.numbers import NumberMap
from esp_envs import make
from esp_envs.mpe.task import FORCE
from esp_envs.spec import Field, Kind, Spaces, discrete_moves, layout
from tests.cli.running import refused

MOVES = torch.tensor([[0.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blind, "_HIDDEN", 64)
    monkeypatch.setattr(blind, "_ROUNDS", 4)
    monkeypatch.setattr(blind, "_UPDATES", 100)


def scene(wind: float = 0.0, forces: bool = False, shift: float = 0.0, prefers: float = 0.0) -> Transitions:
    """Return steps of a point (numbers 0, 1) that is to reach a goal (2, 3); number 4 never changes.

    Args:
        wind: pushes the point along number 1.
        forces: two numbers act instead of five moves.
        shift: of the middle of the plane, in number 0 and 2.
        prefers: of the reward, along number 0.
    """
    g = torch.Generator().manual_seed(0)
    point, goal = torch.randn(2, 8192, 1, 1, 2, generator=g)
    action = torch.randn(8192, 1, 1, 2, generator=g) if forces else torch.randint(5, (8192, 1, 1), generator=g)
    push = action if action.is_floating_point() else MOVES[action]
    reached = point + 0.5 * push + torch.tensor([0.0, wind])
    reward = -(reached - goal).norm(dim=-1) + prefers * point[..., 0]
    middle, still = torch.tensor([shift, 0.0]), torch.full_like(point[..., :1], 3.0)
    obs, next_obs = (torch.cat([part + middle, goal + middle, still], -1) for part in (point, reached))
    return Transitions(obs, action, reward, next_obs)


def group_of(data: Transitions, actions: int | None) -> tuple[list[str], int]:
    """Return the names of the maps that hold, and the order of the group of those that are permutations."""
    tried, is_complete = search(data, actions)
    assert is_complete
    held = [one for one, verdict in tried if verdict.outcome == "holds"]
    points = [Permutation(found) for one in held if (found := blind._points(one.matrix))]
    return [one.name for one in held], PermutationGroup(points or [Permutation(1)]).order()


@pytest.mark.parametrize(
    ("settings", "order", "generators"),
    [
        ({}, 8, {"1>-1 3>-3, does 3>4 4>3", "0>-0 2>-2, does 1>2 2>1", "0>1 1>0 2>3 3>2, does 1>3 2>4 3>1 4>2"}),
        ({"wind": 0.3}, 2, {"0>-0 2>-2, does 1>2 2>1"}),
        ({"prefers": 0.3}, 2, {"1>-1 3>-3, does 3>4 4>3"}),
        ({"wind": 0.3, "prefers": 0.3}, 1, set()),
        ({"shift": 2.0}, 8, None),
    ],
)
def test_the_whole_group_is_found_and_no_more(settings, order: int, generators: set[str] | None) -> None:
    names, found = group_of(scene(**settings), 5)
    assert found == order
    assert generators is None or set(names) == generators


def test_forces_turn_by_any_angle() -> None:
    names, order = group_of(scene(forces=True), None)
    assert order == 8
    assert "57 degrees in (0,1) (2,3) (5,6)" in names
    names, order = group_of(scene(forces=True, wind=0.3), None)
    assert (order, [name for name in names if "degrees" in name]) == (2, [])


def test_a_map_turns_transitions_about_its_centre() -> None:
    """0 -> 2 - 0 about 1, 1 -> -1; moves 1 and 2 change places: (3, 4) becomes (-1, -4)."""
    matrix = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0, 1.0]))
    matrix[3:, 3:] = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
    one = NumberMap("", matrix, 2, torch.tensor([1.0, 0.0]))
    row = torch.tensor([[[[3.0, 4.0]]]])
    image = one.image(Transitions(row, torch.tensor([[[1]]]), torch.tensor([[[5.0]]]), row + 1))
    assert image.obs.flatten().tolist() == [-1.0, -4.0]
    assert image.next_obs.flatten().tolist() == [-2.0, -5.0]
    assert (image.action.item(), image.reward.item()) == (2, 5.0)


@pytest.mark.parametrize(
    ("settings", "group", "transforms"),
    [
        ({}, "d4 among 8 maps of numbers", "d4"),
        ({"wind": 0.3}, "flip-y among 2 maps of numbers", "flip-y"),
        ({"forces": True}, "o2 among 8 maps of numbers", "o2"),
        ({"forces": True, "wind": 0.3}, "flip-y among 2 maps of numbers", "flip-y"),
        ({"wind": 0.3, "prefers": 0.3}, "c1 among 1 maps of numbers", ""),
    ],
)
def test_what_is_found_gets_a_name_where_there_is_one(settings, group: str, transforms: str) -> None:
    row = layout(Field("point", Kind.VECTOR), Field("goal", Kind.VECTOR), Field("mark", Kind.SCALAR))
    moves = FORCE if settings.get("forces") else discrete_moves(("stay", "left", "right", "down", "up"))
    spaces = Spaces(num_agents=1, observation=row, state=row, action=moves, symmetry="c1")
    found = discover_blindly("scene", spaces, scene(**settings))
    assert (found.group, found.transforms) == (group, transforms and f"discovered:{transforms}")
    nameless = discover_blindly("scene", None, scene(**settings))
    assert (f"{group.split(' among ', maxsplit=1)[0]} among {nameless.group}", nameless.transforms) == (group, "")


def test_a_point_on_a_rail_has_mirrors_alone() -> None:
    """Its other coordinate never changes, so that no turn of the vector can be a map of what does."""
    data = scene()
    obs, next_obs = (part[..., :4] * torch.tensor([1.0, 0.0, 1.0, 0.0]) for part in (data.obs, data.next_obs))
    reward = -(next_obs[..., 0] - next_obs[..., 2]).abs()
    row = layout(Field("point", Kind.VECTOR), Field("goal", Kind.VECTOR))
    moves = discrete_moves(("stay", "left", "right", "down", "up"))
    spaces = Spaces(num_agents=1, observation=row, state=row, action=moves, symmetry="c1")
    found = discover_blindly("rail", spaces, replace(data, obs=obs, next_obs=next_obs, reward=reward))
    assert found.transforms == "discovered:d2"


def test_agents_whose_winds_oppose_each_other_have_no_mirror_together() -> None:
    here, there = scene(wind=0.3), scene(wind=-0.3)
    names = ("obs", "action", "reward", "next_obs")
    both = Transitions(*(torch.cat([getattr(data, name) for data in (here, there)], 2) for name in names))
    assert group_of(both, 5)[1] == 2


@pytest.mark.slow
def test_navigation_is_found_with_its_exchanges_of_landmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight elements of d4, six orders of the landmarks, two of the other agents."""
    monkeypatch.setattr(blind, "_HIDDEN", 256)
    monkeypatch.setattr(blind, "_ROUNDS", 12)
    monkeypatch.setattr(blind, "_UPDATES", 500)
    torch.manual_seed(0)
    env = make("navigation", 512, [0])
    found = discover_blindly("navigation", env.spec, collect(env, 32_768, 2))
    assert found.group == "d4*landmarks-3 among 96 maps of numbers"
    assert found.transforms == "discovered:d4*landmarks-3"


def test_what_it_cannot_look_at_is_refused() -> None:
    assert "searches up to 64 numbers" in refused("discover", "wildlife", "--blind")
    assert "leave --transforms out" in refused("discover", "navigation", "--blind", "--transforms", "d4")
    env = make("navigation", 64, [0])
    masked = replace(collect(env, 64, 1), action_mask=torch.ones(64, 1, 3, 5, dtype=torch.bool))
    with pytest.raises(ValueError, match="masks of actions"):
        discover_blindly("masked", env.spec, masked)
