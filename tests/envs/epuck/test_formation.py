"""Formation change: rewards, metrics, observations and starts by hand, and the anchors of its numbers."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from esp_envs import make
from esp_envs.epuck import formation_rules as rules
from esp_envs.epuck import formation_spec
from esp_envs.epuck.formation import Formation
from esp_envs.epuck.formation_spec import FormationSettings
from esp_envs.epuck.robot import BODY_RADIUS_M, MAX_SPEED_M_S, MAX_SPIN_RAD_S, Arena
from tests.envs.playing import episode_return

PERIOD_S = 0.1


def world(positions: list[tuple[float, float]], goals: list[tuple[float, float]], **settings: object) -> Formation:
    """Put robots at rest, heading along x, into one world without noise at the start; pillars stay on their ring."""
    env = make("formation", 1, [0], {"num_agents": len(positions), "num_obstacles": 0, **settings})
    assert isinstance(env, Formation)
    pillars = torch.from_numpy(env.arena.pillars()).flatten()
    heading = [(1.0, 0.0)] * len(positions)
    rest = torch.zeros(3 * len(positions))
    parts = [torch.tensor(heading).flatten(), torch.tensor(positions).flatten(), rest, torch.tensor(goals).flatten()]
    env.set_state(torch.cat([*parts, pillars.float()]).view(1, 1, -1))
    return env


def wheels(*pairs: tuple[float, float]) -> Tensor:
    return torch.tensor(pairs).view(1, 1, -1, 2)


def test_eight_robots_stand_on_corners_and_edge_midpoints() -> None:
    arena = Arena(2.0, 8, 2, 0.05)
    assert arena.reach_m == pytest.approx(0.95)
    corners_and_midpoints = {(x, y) for x in (-0.95, 0.0, 0.95) for y in (-0.95, 0.0, 0.95)} - {(0.0, 0.0)}
    assert {tuple(post) for post in arena.posts().tolist()} == corners_and_midpoints
    # two pillars on the diagonal, 0.4 m from the middle
    half = 0.4 * math.sqrt(0.5)
    assert arena.pillars().tolist() == [pytest.approx([half, half]), pytest.approx([-half, -half])]


@pytest.mark.parametrize("robots", range(1, 17))
def test_any_number_of_robots_starts_on_the_edge_and_its_goals_are_antipodal(robots: int) -> None:
    env = make("formation", 3, [0], {"num_agents": robots, "start_noise_m": 0.0})
    state, where = env.reset().state, env.spec.state.slices()
    position = state[..., where["position"]].unflatten(-1, (-1, 2))
    torch.testing.assert_close(position.abs().amax(-1), torch.full(position.shape[:-1], 0.95))
    torch.testing.assert_close(state[..., where["goals"]], -state[..., where["position"]])


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"num_agents": 16, "arena_m": 0.5}, "16 robots do not fit around an arena"),
        ({"num_agents": 1, "num_obstacles": 0, "arena_m": 0.01}, "a robot does not fit into an arena of 0.01 m"),
        ({"num_obstacles": 8, "obstacle_radius_m": 0.3}, "8 pillars of radius .* overlap"),
        ({"obstacle_radius_m": 0.9}, "pillars of radius 0.9 m reach the posts"),
        ({"control_period_s": 0.055}, "control period of .* is not a multiple"),
    ],
)
def test_what_does_not_fit_is_refused(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make("formation", 1, [0], settings)


def test_progress_is_paid_by_the_metre() -> None:
    env = world([(-0.5, 0.0), (-0.5, 0.8)], [(0.5, 0.0), (0.5, 0.8)])
    env.step(wheels((1, 1), (0, 0)))  # reaches its speed
    step = env.step(wheels((1, 1), (0, 0)))
    # one period at full speed, straight at the goal: 100 per metre; the other rests; no body within 0.5 m
    torch.testing.assert_close(
        step.reward[0, 0], torch.tensor([100 * MAX_SPEED_M_S * PERIOD_S, 0.0]), atol=3e-3, rtol=0
    )
    assert step.metrics["path_length_m"].item() == pytest.approx(MAX_SPEED_M_S * PERIOD_S / 2, rel=1e-3)


PLACES = [(0.0, 0.0), (0.3, 0.0), (0.0, 0.4), (-0.9, -0.9)]
"""Distances of centres: 0.3, 0.4 and 0.5 between the first three; the fourth is alone."""


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, [-0.35, -0.35, -0.35, 0.0]),
        ({"penalty_radius_m": 0.45}, [-0.35, -0.35, -0.35, 0.0]),
        ({"convention": "tight"}, [0.0, 0.0, 0.0, 0.0]),
        ({"penalty_radius_m": 0.35, "collision_penalty": 2.0}, [-2.0, -2.0, 0.0, 0.0]),
        ({"convention": "tight", "penalty_radius_m": 0.35}, [-1.0, -1.0, 0.0, 0.0]),
        ({"collision_penalty": 0.0}, [0.0, 0.0, 0.0, 0.0]),
    ],
    ids=str,
)
def test_penalty_by_hand(settings: dict[str, object], expected: list[float]) -> None:
    env = world(PLACES, PLACES, **settings)
    step = env.step(torch.zeros(1, 1, 4, 2))
    torch.testing.assert_close(step.reward[0, 0], torch.tensor(expected), atol=1e-5, rtol=0)


def test_a_pillar_is_a_body_for_the_penalty() -> None:
    near = 0.4 * math.sqrt(0.5)
    env = world([(near, near - 0.14), (near, near - 0.6)], [(0.0, 0.0)] * 2, convention="tight", num_obstacles=2)
    step = env.step(torch.zeros(1, 1, 2, 2))
    torch.testing.assert_close(step.reward[0, 0], torch.tensor([-1.0, 0.0]), atol=1e-5, rtol=0)


def test_observation_by_hand() -> None:
    env = world([(0.1, 0.2), (0.4, 0.2), (0.1, 0.3)], [(0.9, 0.0), (0.0, 0.0), (0.0, 0.0)], num_obstacles=2)
    pillar = 0.4 * math.sqrt(0.5)
    obs = env.set_state(env.step(torch.zeros(1, 1, 3, 2)).next.state).obs[0, 0, 0]
    expected = [1, 0, pillar - 0.1, pillar - 0.2, 0.8, -0.2, 0.0, 0.1]
    torch.testing.assert_close(obs, torch.tensor(expected), atol=1e-5, rtol=0)
    two = world([(0.1, 0.2), (0.4, 0.2), (0.1, 0.3)], [(0.9, 0.0)] * 3, neighbours=2)
    obs = two.step(torch.zeros(1, 1, 3, 2)).next.obs[0, 0, 0]
    # no pillars: heading, goal, then the nearest robot first
    torch.testing.assert_close(obs, torch.tensor([1, 0, 0.8, -0.2, 0.0, 0.1, 0.3, 0.0]), atol=1e-5, rtol=0)


def test_nearness_by_hand() -> None:
    # touching bodies have length 1; a gap of 0.2 m has 1/e; the direction stays
    seen = rules.nearness(np.array([[0.074, 0.0], [0.0, -0.274]]), 2 * BODY_RADIUS_M)
    np.testing.assert_allclose(seen, [[1.0, 0.0], [0.0, -math.exp(-1)]], atol=1e-9)
    env = world([(0.0, 0.0), (0.0, 0.274)], [(0.9, 0.0)] * 2, sight="nearness")
    obs = env.step(torch.zeros(1, 1, 2, 2)).next.obs[0, 0, 0]
    torch.testing.assert_close(obs, torch.tensor([1, 0, 0.9, 0.0, 0.0, math.exp(-1)]), atol=1e-5, rtol=0)


def test_a_goal_in_its_unit_by_hand() -> None:
    env = world([(0.0, 0.0), (0.5, 0.0)], [(0.3, -0.4), (0.53, 0.04)], goal_sight_m=0.2)
    goal = env.spec.observation.slices()["goal"]
    obs = env._seen().obs[0, 0]
    assert obs[0, goal].tolist() == pytest.approx([0.6, -0.8]), "half a metre away: its direction"
    assert obs[1, goal].tolist() == pytest.approx([0.15, 0.2]), "5 cm away: a quarter of 0.2 m"
    rest = [k for k in range(env.spec.observation.width) if k not in range(*goal.indices(100))]
    plain = world([(0.0, 0.0), (0.5, 0.0)], [(0.3, -0.4), (0.53, 0.04)])._seen().obs[0, 0]
    assert torch.equal(obs[:, rest], plain[:, rest])
    assert plain[0, goal].tolist() == pytest.approx([0.3, -0.4])


def test_arrival_counts_once_and_time_runs_until_then() -> None:
    env = world([(0.06, 0.0), (0.5, 0.5)], [(0.12, 0.0), (-0.5, -0.5)], horizon=8)
    steps = [env.step(wheels((1, 1), (0, 0))) for _ in range(8)]
    arrived = [step.metrics["arrival_rate"].item() for step in steps]
    # 6 cm away and 5 cm is near enough: reached in the first step or two, and never counted again
    assert sum(arrived) == pytest.approx(0.5)
    first = arrived.index(0.5)
    assert first <= 1
    seconds = sum(step.metrics["time_to_arrival_s"].item() for step in steps)
    assert seconds == pytest.approx((first * PERIOD_S + 8 * PERIOD_S) / 2)
    distances = [step.metrics["final_distance_m"].item() for step in steps]
    assert distances[:-1] == [0.0] * 7
    assert steps[-1].final is not None
    where = env.spec.state.slices()
    final = steps[-1].final.state[0, 0]
    gaps = (final[where["position"]] - final[where["goals"]]).view(2, 2).norm(dim=-1)
    assert distances[-1] == pytest.approx(gaps.mean().item(), abs=1e-5)


def test_a_robot_that_passes_its_goal_has_arrived_once_and_for_all() -> None:
    env = world([(0.0, 0.0)], [(0.0, 0.0)])
    start = env._seen().state
    # 8 steps of 1.256 cm lead beyond the 5 cm, and 8 back again
    steps = [env.step(wheels((speed, speed))) for speed in (1, -1) for _ in range(8)]
    away = [step.next.state[0, 0, env.spec.state.slices()["position"]].norm().item() for step in steps]
    assert away[-1] < 0.05 < max(away)
    assert [step.metrics["arrival_rate"].item() for step in steps] == [1.0] + [0.0] * 15
    assert [step.metrics["time_to_arrival_s"].item() for step in steps] == [0.0] * 16
    env.set_state(start)
    assert env.step(wheels((0, 0))).metrics["arrival_rate"].item() == 1.0, "and anew in the next episode"


def test_bodies_that_touch_from_the_start_do_not_collide() -> None:
    touching = 2 * BODY_RADIUS_M
    for apart, collisions in ((touching, 0), (touching + 0.002, 1)):
        env = world([(0.0, 0.0), (apart, 0.0)], [(0.5, 0.0), (-0.5, 0.0)])
        counts = [env.step(wheels((1, 1), (0, 0))).metrics["collisions"].item() for _ in range(3)]
        assert sum(counts) == collisions


def test_a_collision_with_a_pillar_counts_once_and_is_no_risk() -> None:
    pillar = 0.4 * math.sqrt(0.5)
    env = world([(pillar - 0.05 - BODY_RADIUS_M - 0.02, pillar)], [(-0.5, 0.0)], num_obstacles=2)
    steps = [env.step(wheels((1, 1))) for _ in range(6)]
    assert sum(step.metrics["collisions"].item() for step in steps) == 1
    assert [step.metrics["risky_rate"].item() for step in steps] == [0.0] * 6, "risks are of two robots"


def moved_furniture() -> Formation:
    """Two robots that touch, whose goals are not opposite and whose pillars have left their ring."""
    env = world([(-BODY_RADIUS_M, 0.0), (BODY_RADIUS_M, 0.0)], [(0.5, 0.1), (-0.5, 0.2)], num_obstacles=2)
    state = env._seen().state
    state[..., env.spec.state.slices()["obstacles"]] = torch.tensor([0.3, 0.3, -0.3, 0.2])
    env.set_state(state)
    return env


def test_a_saved_world_keeps_its_goals_pillars_and_contacts() -> None:
    env = moved_furniture()
    other = world([(-0.5, 0.0), (0.5, 0.0)], [(0.0, 0.0)] * 2, num_obstacles=2)
    assert not torch.equal(other._seen().obs, env._seen().obs)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other._seen().obs, env._seen().obs)
    assert torch.equal(other._seen().state, env._seen().state)
    assert other.step(torch.zeros(1, 1, 2, 2)).metrics["collisions"].item() == 0, "they touched before"


def test_a_reset_brings_goals_and_pillars_back() -> None:
    env = moved_furniture()
    state, where = env.reset().state[0, 0], env.spec.state.slices()
    expected = {"goals": -env.arena.posts(), "obstacles": env.arena.pillars()}
    for name, places in expected.items():
        torch.testing.assert_close(state[where[name]], torch.from_numpy(places).flatten().float())


def test_a_collision_counts_when_bodies_come_to_touch() -> None:
    env = world([(-0.06, 0.0), (0.06, 0.0)], [(0.5, 0.0), (-0.5, 0.0)])
    steps = [env.step(wheels((1, 1), (0, 0))) for _ in range(10)]
    # 4.6 cm of air at 1.26 cm a step: touching from the fourth step on, counted once while they press
    counts = [step.metrics["collisions"].item() for step in steps]
    assert sum(counts) == 1
    assert counts.index(1) == 3
    apart = [step.metrics["risky_rate"].item() for step in steps]
    assert apart == [1.0] * 10  # below 5 cm of air from the start
    back = [env.step(wheels((-1, -1), (0, 0))) for _ in range(3)]
    again = [env.step(wheels((1, 1), (0, 0))) for _ in range(6)]
    assert sum(step.metrics["collisions"].item() for step in back) == 0
    assert sum(step.metrics["collisions"].item() for step in again) == 1


def test_a_gap_of_five_centimetres_is_not_risky() -> None:
    for gap, risky in ((0.0495, 1.0), (0.0505, 0.0)):
        env = world([(0.0, 0.0), (2 * BODY_RADIUS_M + gap, 0.0)], [(0.0, 0.0)] * 2)
        assert env.step(torch.zeros(1, 1, 2, 2)).metrics["risky_rate"].item() == risky


def test_discrete_pairs_are_the_continuous_ones() -> None:
    discrete = world([(0.0, 0.0)], [(0.5, 0.5)], actions="discrete")
    continuous = world([(0.0, 0.0)], [(0.5, 0.5)])
    for index, (left, right) in enumerate(formation_spec.WHEEL_PAIRS.points):
        state = discrete.step(torch.tensor([[[index]]])).next.state
        torch.testing.assert_close(state, continuous.step(wheels((left, right))).next.state)
    assert len(formation_spec.WHEEL_PAIRS.points) == 121


def test_a_delayed_action_acts_later() -> None:
    env, prompt = world([(0.0, 0.0)], [(0.5, 0.0)], action_delay=2), world([(0.0, 0.0)], [(0.5, 0.0)])
    orders = [wheels((1, 1)), wheels((0.2, 0.6)), wheels((-1, 0.3)), wheels((0, 0)), wheels((0, 0))]
    late = [env.step(order).next.state for order in orders]
    for order in [wheels((0, 0)), wheels((0, 0)), *orders[:3]]:
        expected = prompt.step(order).next.state
    torch.testing.assert_close(late[-1], expected)
    assert late[1].equal(late[0]), "nothing moves while the first order waits"
    assert not late[2].equal(late[1])


@pytest.mark.parametrize(
    ("settings", "differs"),
    [
        ({}, set()),
        ({"sensor_noise_m": 0.02}, {"obstacle", "goal", "robots"}),
        ({"heading_noise_rad": 0.1}, {"heading"}),
    ],
    ids=["none", "places", "headings"],
)
def test_sensor_noise_disturbs_what_is_seen_and_nothing_else(settings: dict[str, object], differs: set[str]) -> None:
    env, clean = make("formation", 40, [0], settings), make("formation", 40, [0])
    seen, true = env.reset(), clean.reset()
    assert torch.equal(seen.state, true.state)
    for name, where in env.spec.observation.slices().items():
        noise = (seen.obs - true.obs)[..., where]
        if name in differs:
            # 640 numbers: their deviation is known to 3 %, so 15 % is five times that
            assert noise.std().item() == pytest.approx(settings.get("sensor_noise_m", 0.1 / math.sqrt(2)), rel=0.15)
        else:
            assert noise.abs().max() == 0


def test_robots_that_differ_drive_differently_and_a_state_makes_them_alike_again() -> None:
    env = make("formation", 20, [0], {"wheel_mismatch": 0.1, "mass_spread": 0.3, "friction_spread": 0.3})
    state = env.reset().state
    forward = torch.ones(1, 20, 8, 2)
    env.step(forward)
    where = env.spec.state.slices()
    spin = env.step(forward).next.state[..., where["spin"]]
    # each wheel's factor deviates by 0.1: the spin by 0.1 sqrt(2) 0.1256 / 0.052 = 0.34 rad/s
    assert spin.std().item() == pytest.approx(0.1 * math.sqrt(2) * MAX_SPEED_M_S / 0.052, rel=0.3)
    env.set_state(state)
    assert env.step(forward).next.state[..., where["spin"]].abs().max() < 1e-6


def test_masses_and_grip_spread_evenly_around_a_robots_own_and_a_state_brings_these_back() -> None:
    env = make("formation", 40, [0], {"mass_spread": 0.3, "friction_spread": 0.6})
    state, drawn = env.reset().state, env.state_dict()
    for name, spread in (("mass", 0.3), ("friction", 0.6)):
        values = drawn[f"physics.{name}"]
        assert values.shape == (40, 8)
        assert bool(((values - 1).abs() <= spread).all())
        # 320 uniform numbers: their deviation of spread / sqrt(3) is known to 2.5 %
        assert values.std().item() == pytest.approx(spread / math.sqrt(3), rel=0.1)
    pairs = torch.stack([drawn[f"physics.{name}"].flatten() for name in ("mass", "friction")])
    # 320 independent pairs: their correlation is 0 with a standard error of 0.056
    assert abs(torch.corrcoef(pairs)[0, 1].item()) < 0.25
    env.set_state(state)
    for name in ("mass", "friction"):
        assert bool((env.state_dict()[f"physics.{name}"] == 1).all())
        assert bool((env.state_dict()[name] == 1).all()), "runs that were begun before have it under this name"


def test_steering_by_hand() -> None:
    turn = MAX_SPIN_RAD_S * PERIOD_S
    heading = np.zeros((1, 4))
    angles = np.array([[0.0, turn / 2, -turn / 2, 3.0]])
    driven = rules.towards(np.stack([np.cos(angles), np.sin(angles)], -1), heading, PERIOD_S)[0]
    part = math.cos(turn / 2) * 0.5
    expected = [[1.0, 1.0], [part - 0.5, part + 0.5], [part + 0.5, part - 0.5], [-1.0, 1.0]]
    np.testing.assert_allclose(driven, expected, atol=1e-9)
    assert not rules.towards(np.zeros((1, 4, 2)), heading, PERIOD_S).any(), "rests at its goal"
    near = np.array([[0.5], [0.2], [0.09]]) * [[[MAX_SPEED_M_S * PERIOD_S, 0.0]]]  # shares of a period's way
    driven = rules.towards(near, np.zeros((1, 3)), PERIOD_S)[0]
    np.testing.assert_allclose(driven, [[0.5, 0.5], [0.2, 0.2], [0.0, 0.0]], atol=1e-9)


def test_heuristics_know_the_control_period() -> None:
    # half of what a robot can turn in 0.2 s: half of full speed for the turn, and half of what is left ahead
    angle = MAX_SPIN_RAD_S * 0.2 / 2
    env = world([(0.0, 0.0)], [(math.cos(angle), math.sin(angle))], control_period_s=0.2)
    part = math.cos(angle) * 0.5
    assert env.heuristic("straight").flatten().tolist() == pytest.approx([part - 0.5, part + 0.5], abs=1e-6)


def test_the_way_round_a_pillar_begins_at_its_rim() -> None:
    pillar = 0.4 * math.sqrt(0.5)
    away = 0.2 + 0.1 + BODY_RADIUS_M
    env = world([(pillar - away, pillar)], [(0.9, pillar)], num_obstacles=2, obstacle_radius_m=0.1)
    # 20 cm of air, of 25 at which one gives way: nearness 0.2, so 0.2^2 back and 1.5 x 0.2 to the right
    expected = rules.towards(np.array([[[1 - 0.04, -0.3]]]), np.zeros((1, 1)), PERIOD_S)
    assert env.heuristic("avoid").flatten().tolist() == pytest.approx(expected.flatten().tolist(), abs=1e-5)


def test_giving_way_passes_on_the_right() -> None:
    to_goal, ahead = np.array([[[1.0, 0.0]]]), np.array([[[[0.15, 0.0]]]])
    wish = rules.give_way(to_goal, ahead, np.full((1, 1, 1), 0.076))[0, 0]
    assert wish[1] < -0.5 * abs(wish[0]), "to the right of the way along x"
    behind = rules.give_way(to_goal, -ahead, np.full((1, 1, 1), 0.076))[0, 0]
    assert behind[1] == 0
    assert behind[0] > 0
    far = rules.give_way(to_goal, ahead, np.full((1, 1, 1), np.inf))[0, 0]
    np.testing.assert_allclose(far, [rules.SIGHT_M, 0.0])


@pytest.mark.parametrize(
    ("settings", "policy", "expected"),
    [
        ({}, "random", 4.1),
        ({}, "straight", 182.0),
        ({}, "avoid", 166.0),
        ({"convention": "tight"}, "straight", 172.0),
        ({"convention": "tight"}, "avoid", 215.5),
    ],
    ids=str,
)
def test_anchors(settings: dict[str, object], policy: str, expected: float) -> None:
    env = make("formation", 24, [5], settings)
    mean, error = episode_return(env, policy)
    assert mean == pytest.approx(expected, abs=max(4 * error, 1.0))


PENALTIES = ("collision_penalty", "penalty_radius_m")
IDLE = [
    ({}, set()),
    ({"num_agents": 2, "num_obstacles": 0}, {"obstacle_radius_m", "neighbours"}),
    ({"num_agents": 1}, {"neighbours"}),
    ({"num_agents": 1, "num_obstacles": 0}, {"obstacle_radius_m", "neighbours", "sight", *PENALTIES}),
    ({"collision_penalty": 0.0}, {"penalty_radius_m"}),
    ({"density": 0.8}, {"arena_m"}),
]


@pytest.mark.parametrize(("settings", "idle"), IDLE)
def test_settings_that_change_nothing_are_named(settings, idle: set[str]) -> None:
    others = {"obstacle_radius_m": 0.04, "neighbours": 9, "sight": "nearness", "collision_penalty": 0.9}
    others |= {"penalty_radius_m": 1.9, "arena_m": 2.5}

    def played(more: dict[str, object]) -> list[float]:
        env = make("formation", 1, [0], {**settings, **more})
        env.reset()
        step = env.step(env.heuristic())
        return [*step.next.obs.flatten().tolist(), *step.reward.flatten().tolist()]

    assert FormationSettings(**settings).without_effect() == idle
    assert all(played({name: others[name]}) == played({}) for name in idle)
