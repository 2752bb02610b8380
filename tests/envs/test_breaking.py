"""Settings that break a task's symmetry: what they do, which group is left, and that 0 changes nothing."""

import math

import pytest
import torch

from esp_cli.checking import check_symmetry
from esp_cli.symmetry import Group
from esp_cli.symmetry.admission import admitted_elements
from esp_envs import Environment, Step, make
from esp_envs.mpe.navigation import NavigationSettings
from esp_envs.settings import Breaks
from esp_envs.spec import Spaces

SMALL = {"horizon": 40, "num_agents": 4, "num_obstacles": 2}
BROKEN = [
    ("navigation", {"wind": 0.3}, "flip-x*agents"),
    ("navigation", {"wind": 0.3, "actions": "continuous"}, "flip-x*agents"),
    ("navigation", {"mud": 0.5}, "flip-x*agents"),
    ("navigation", {"action_turn_rad": 0.5}, "c4*agents"),
    ("navigation", {"action_turn_rad": 0.5, "actions": "continuous"}, "c4*agents"),
    ("navigation", {"reward_offset": 0.3}, "flip-x*agents"),
    ("navigation", {"reward_offset": 0.3, "convention": "pettingzoo"}, "flip-x*agents"),
    ("navigation", {"action_turn_rad": 0.5, "reward_offset": 0.3}, "c1*agents"),
    ("predator-prey", {"wind": 0.3}, "flip-x*agents"),
    ("predator-prey", {"action_turn_rad": 0.5, "prey": "still"}, "c4*agents"),
    ("predator-prey", {"reward_offset": 0.1, "prey": "still"}, "flip-x*agents"),
    ("predator-prey", {"mud": 0.5, "prey": "still"}, "flip-x*agents"),
    ("formation", {"slope": 0.3}, "flip-x*agents"),
    ("wildlife", {"wind": 0.8, "width": 5, "height": 5, "horizon": 30}, "flip-x*agents"),
]


def carried(spec: Spaces) -> set[str]:
    """Return the elements that a prior with d4*agents may draw."""
    elements = admitted_elements("d4*agents", spec)
    return {element.name for element in (elements.generators() if isinstance(elements, Group) else elements)}


@pytest.mark.slow
@pytest.mark.parametrize(("task", "settings", "left"), BROKEN, ids=str)
def test_the_check_finds_the_group_that_is_declared_to_be_left(task: str, settings, left: str) -> None:
    settings = settings | (SMALL if task == "formation" else {})
    spec = make(task, 1, [0], settings).spec
    swap = "agents-" + "-".join(map(str, [1, 0, *range(2, spec.num_agents)]))
    report = check_symmetry(lambda n, seeds: make(task, n, seeds, settings), f"d4,{swap}")
    continuous = settings.get("actions") == "continuous"
    assert spec.symmetry == (left.replace("d4", "o2").replace("c4", "so2") if continuous else left)
    assert report.holds, "what is declared to be left holds"
    assert report.found == left.replace("*agents", f" and {swap}"), "and nothing more does"
    assert {"rot90", swap} <= carried(spec), "a prior may use the whole group all the same"


def test_what_several_breakings_leave() -> None:
    def left_of(whole: str, *names: str) -> str:
        return NavigationSettings(**dict.fromkeys(names, 0.5)).left_of(whole)

    assert left_of("d4*agents") == "d4*agents"
    assert left_of("o2*agents", "wind", "mud") == "flip-x*agents"
    assert left_of("d4*agents*landmarks-3", "wind", "action_turn_rad") == "c1*agents*landmarks-3"
    settings = make("navigation", 1, [0], {"wind": 1, "action_turn_rad": 0.5, "actions": "continuous"}).settings
    assert settings.broken() == {"wind": Breaks("flip-x"), "action_turn_rad": Breaks("so2")}, (
        "those that are 0 break nothing"
    )
    assert settings.broken_in_words() == ", wind 1, action_turn_rad 0.5"
    found = {moves: make("wildlife", 1, [0], {"wind": 0.5, "poacher_moves": moves}) for moves in (0.0, 0.5)}
    assert [env.spec.symmetry for env in found.values()] == ["d4*agents", "flip-x*agents"]
    assert [env.settings.without_effect() for env in found.values()] == [{"wind"}, set()], "a poacher at rest"


def placed(task: str, positions: list[float], velocity: float = 0.0, **settings: object) -> Environment:
    """Return one world with its bodies at these places, all with the same velocity along both axes."""
    env = make(task, 1, [0], settings)
    env.reset()
    moving = torch.full((env.spec.state.width - len(positions),), velocity)
    env.set_state(torch.cat([moving, torch.tensor(positions)]).view(env.state_shape))
    return env


def idle(env: Environment, action: int = 0) -> Step:
    """Let every agent take one action, by default do nothing."""
    return env.step(torch.full(env.action_shape, action))


APART = [2.0, 0.0, 4.0, 0.0, -2.0, 0.0]
OTHERS = {"navigation": [9.0] * 6, "predator-prey": [0.0, 9.0, 9.0, 0.0, 0.0, -9.0]}
FORCES = [
    ("navigation", {"wind": 0.3}, [[0.15, 0.0]] * 3),  # 0.3 x 5 x 0.1 s
    ("predator-prey", {"wind": 10.0, "prey": "still"}, [[1.0, 0.0]] * 3),  # its greatest speed, not 10 x 3 x 0.1 s
    ("navigation", {"mud": 0.5}, [[0.375] * 2, [0.375] * 2, [0.75] * 2]),  # from a velocity of 1
]


@pytest.mark.parametrize(("task", "settings", "velocity"), FORCES, ids=str)
def test_what_pushes_and_brakes_agents_that_do_nothing(task: str, settings, velocity) -> None:
    env = placed(task, APART + OTHERS[task], float("mud" in settings), **settings)
    after = idle(env).next.state[0, 0, env.spec.state.slices()["velocity"]]
    assert after.view(3, 2) == pytest.approx(torch.tensor(velocity))


def test_a_turned_action_pushes_elsewhere_and_turned_actions_do_not_push_others() -> None:
    for actions in ("discrete", "continuous"):
        env = placed("navigation", [0.0, 0.0, 3.0, 3.0, *[6.0] * 8], action_turn_rad=math.pi / 6, actions=actions)
        right = torch.tensor([1.0, 0.0]).expand(1, 1, 3, 2)
        step = idle(env, 2) if actions == "discrete" else env.step(right)
        assert step.next.state[0, 0, :6].view(3, 2) == pytest.approx(torch.tensor([[0.5 * 3**0.5 / 2, 0.25]] * 3))
    places = torch.arange(8.0, 20.0).tolist()
    after, same = (
        idle(placed("predator-prey", places, prey="still", **turned), 2).next.state[0, 0]
        for turned in ({"action_turn_rad": 1.0}, {})
    )
    assert torch.equal(after[6:8], same[6:8]), "the prey's own force is not turned"
    assert not torch.equal(after[:6], same[:6])


HUNT = {"prey": "still", "num_predators": 2, "num_obstacles": 0}


def test_the_reward_counts_places_to_the_right() -> None:
    """One agent on its landmark, or 0.3 right of it: distances 0.3 and 0 where the reward is 0.3 off."""
    rewards = []
    for x in (0.0, 0.3):
        step = idle(placed("navigation", [x, 0.0, 0.0, 0.0], reward_offset=0.3, num_agents=1, num_landmarks=1))
        rewards.append(float(step.reward[0, 0, 0]) + 1)  # the collision with oneself
        assert float(step.metrics["coverage"]) == (x == 0.0), "metrics are of the real places"
    assert rewards == pytest.approx([-0.3, 0.0], abs=1e-6)
    step = idle(placed("predator-prey", [0.5, 0.0, -0.5, 0.0, 0.0, 0.0], reward_offset=0.5, **HUNT))
    assert step.reward[0, 0].tolist() == [10.0, 10.0], "for who is right of the prey, and not for who is left of it"
    assert float(step.metrics["touches"]) == 0, "nobody really touches it"


def test_the_prey_is_no_predator_beside_a_place_that_is_rewarded() -> None:
    """The place is 0.1 right of the prey, nearer than a touch; only predators count, and they are far away."""
    env = placed("predator-prey", [3.0, 3.0, -3.0, 3.0, 0.0, 0.0], reward_offset=0.1, **HUNT)
    assert idle(env).reward[0, 0].tolist() == [0.0, 0.0]


def test_predators_that_chase_run_at_the_place_that_is_rewarded() -> None:
    """The prey is half a length left of the origin: one predator is there already, the other comes from below."""
    env = placed("predator-prey", [0.0, 0.0, 0.0, -1.0, -0.5, 0.0], reward_offset=0.5, **HUNT)
    assert [env.spec.action.names[k] for k in env.heuristic().flatten()] == ["no-op", "up"]


def test_heuristics_know_where_forces_and_rewards_point() -> None:
    """The reference policies reach their goals with actions that are turned and landmarks that are off."""

    def missing(**settings: float) -> float:
        """Return what the last rewards lack to those of agents that touch nobody and cover all places."""
        env = make("navigation", 64, [0], {"actions": "continuous", **settings})
        env.reset()
        return -3 - float([env.step(env.heuristic()).reward for _ in range(25)][-1].mean())

    plain = missing()
    assert missing(action_turn_rad=1.5) == pytest.approx(plain, rel=0.02)
    assert missing(reward_offset=0.3) == pytest.approx(plain, rel=0.1)


def driven(heading: float, speed: float, **settings: object) -> float:
    """Return by how far a robot in the middle drives in one step, m."""
    env = make("formation", 1, [0], {"num_agents": 1, "num_obstacles": 0, **settings})
    state = torch.zeros(env.state_shape)
    names = env.spec.state.slices()
    state[..., names["heading"]] = torch.tensor([heading, 0.0])
    env.set_state(state)
    after = env.step(torch.full(env.action_shape, speed)).next.state
    return float(after[0, 0, names["position"]][0])


def test_a_slope_is_slow_upwards_and_fast_downwards_forwards_and_backwards() -> None:
    level = driven(1.0, 0.5)
    assert driven(1.0, 0.5, slope=0.2) == pytest.approx(0.8 * level, rel=0.02)
    assert driven(-1.0, 0.5, slope=0.2) == pytest.approx(-1.2 * level, rel=0.02)
    assert driven(-1.0, -0.5, slope=0.2) == pytest.approx(0.8 * level, rel=0.02)
    assert driven(1.0, -0.5, slope=0.2) == pytest.approx(-1.2 * level, rel=0.02)


def test_a_full_wind_carries_every_moving_poacher_to_the_right() -> None:
    def moves(**settings: object) -> torch.Tensor:
        env = make("wildlife", 16, [0], {"poacher_moves": 1.0, **settings})
        env.reset()
        return env.plan[..., 0, :]

    assert (moves(wind=1.0) == torch.tensor([1, 0])).all()
    share = (moves(wind=0.5) == torch.tensor([1, 0])).all(-1).float().mean()
    assert share == pytest.approx(0.5 + 0.5 / 4, abs=0.06)
    assert (moves() == torch.tensor([1, 0])).all(-1).float().mean() == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("task", ["navigation", "predator-prey", "formation", "wildlife"])
def test_breakings_are_off_by_default_and_named_in_the_convention_when_on(task: str) -> None:
    env = make(task, 1, [0])
    assert env.settings.broken() == {}
    name = next(iter(env.settings.breakable()))
    assert make(task, 1, [0], {name: 0.25}).spec.convention == f"{env.spec.convention}, {name} 0.25"
    with pytest.raises(ValueError, match=name):
        make(task, 1, [0], {name: -0.1})
