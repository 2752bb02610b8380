"""Navigation: reward, metrics and start by hand, and the anchors that its numbers are read against."""

import math

import pytest
import torch

from esp_envs import make
from esp_envs.mpe import covering
from esp_envs.mpe.navigation import Navigation
from tests.envs.playing import episode_return


def still_after(env: Navigation, positions: list[list[float]]) -> tuple[torch.Tensor, dict[str, float]]:
    """Put bodies at rest, let everybody do nothing for a step, and return the reward [N] and the metrics."""
    flat = torch.tensor(positions).flatten()
    env.set_state(torch.cat([torch.zeros(2 * env.spec.num_agents), flat]).view(1, 1, -1))
    step = env.step(torch.zeros(1, 1, env.spec.num_agents, dtype=torch.int64))
    return step.reward[0, 0], {name: value.item() for name, value in step.metrics.items()}


APART = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.5], [1.05, 0.0], [0.6, 0.8]]
"""Agents, then landmarks: nearest distances 0.5 (either), 0.05 (second), and that of (0.6, 0.8)."""
LAST = math.dist((0.6, 0.8), (0.0, 1.0))


def test_esp_reward_by_hand() -> None:
    reward, metrics = still_after(make("navigation", 1, [0]), APART)
    # each agent: -(0.5 + 0.05 + LAST) and -1 for itself; everybody gets the sum over the three
    torch.testing.assert_close(reward, torch.full((3,), -3 * (0.55 + LAST) - 3))
    assert metrics["collisions"] == 0
    assert metrics["landmark_distance"] == pytest.approx((0.55 + LAST) / 3)
    assert metrics["coverage"] == pytest.approx(1 / 3)


def test_pettingzoo_reward_by_hand() -> None:
    env = make("navigation", 1, [0], {"convention": "pettingzoo", "local_ratio": 0.25})
    reward, _ = still_after(env, APART)
    torch.testing.assert_close(reward, torch.full((3,), -0.75 * (0.55 + LAST)))
    assert env.spec.shared_reward is False
    # at rest in mpe2's order nothing moves in the first step, so 0.2 apart is still a collision, of two agents
    close = [[0.0, 0.0], [0.2, 0.0], [0.0, 1.0], [0.0, 0.0], [0.2, 0.0], [0.0, 1.0]]
    reward, metrics = still_after(env, close)
    torch.testing.assert_close(reward, torch.tensor([-0.25, -0.25, 0.0]))
    assert metrics["collisions"] == 1
    assert metrics["coverage"] == 1


def test_esp_collisions_count_for_both_and_for_everybody() -> None:
    env = make("navigation", 1, [0])
    # two agents 0.5 apart run at each other, and meet in the second step
    state = torch.tensor([1.0, 0, -1.0, 0, 0, 0, -0.25, 0, 0.25, 0, 0, 1.0, -0.15, 0, 0.15, 0, 0, 1.0]).view(1, 1, -1)
    env.set_state(state)
    step = env.step(torch.zeros(1, 1, 3, dtype=torch.int64))
    # velocities 0.75 towards each other, 0.075 each: 0.35 apart, no contact yet
    assert step.metrics["collisions"].item() == 0
    step = env.step(torch.zeros(1, 1, 3, dtype=torch.int64))
    # 0.5625 each, 0.05625 each: 0.2375 apart; the landmarks at +-0.15 are 0.03125 away, the third at 0
    assert step.metrics["collisions"].item() == 1
    torch.testing.assert_close(step.reward[0, 0], torch.full((3,), -3 * 2 * 0.03125 - 2 - 3), atol=1e-5, rtol=0)


@pytest.mark.parametrize(("agents", "landmarks"), [(2, 3), (3, 3), (4, 4)])
def test_default_landmarks_are_the_papers(agents: int, landmarks: int) -> None:
    spec = make("navigation", 1, [0], {"num_agents": agents}).spec
    assert spec.observation.width == 2 * (2 + landmarks + agents - 1)
    assert spec.settings["num_landmarks"] == landmarks


def test_starts_fill_their_squares() -> None:
    for convention, extent in (("esp", 0.8), ("pettingzoo", 1.0)):
        state = make("navigation", 4000, [0], {"convention": convention}).reset().state[0]
        velocity, position, landmark = state.split([6, 6, 6], dim=-1)
        assert velocity.abs().max() == 0
        for places, side in ((position, 1.0), (landmark, extent)):
            assert 0.995 * side < places.abs().max() <= side
            assert places.mean().abs() < 0.02
            assert places.square().mean().item() == pytest.approx(side**2 / 3, rel=0.03)


ANCHORS = [  # settings, policy, mean return of one agent over 40,000 episodes (10,000 for cover)
    ({}, "random", -218.35),
    ({}, "greedy", -112.25),
    ({}, "cover", -108.65),
    ({"num_agents": 2}, "random", -165.46),
    ({"num_agents": 2}, "greedy", -98.22),
    ({"num_agents": 2}, "cover", -92.05),
    ({"num_agents": 4}, "random", -322.12),
    ({"num_agents": 4}, "greedy", -161.11),
    ({"num_agents": 4, "num_landmarks": 3}, "random", -267.20),
    ({"num_agents": 4, "num_landmarks": 3}, "greedy", -140.22),
    ({"convention": "pettingzoo"}, "random", -26.47),
    ({"actions": "continuous"}, "greedy", -108.85),
]


@pytest.mark.parametrize(("settings", "policy", "expected"), ANCHORS)
def test_anchors(settings: dict[str, object], policy: str, expected: float) -> None:
    mean, sem = episode_return(make("navigation", 4000 if policy == "random" else 1500, [1], settings), policy)
    assert sem < 0.01 * abs(expected)
    assert mean == pytest.approx(expected, abs=4.5 * sem)


def goals_of_one_world(agents: list[list[float]], landmarks: list[list[float]]) -> list[list[float]]:
    goals = covering.one_each(torch.tensor(agents).unsqueeze(-1), torch.tensor(landmarks).unsqueeze(-1))
    return goals[..., 0].tolist()


def test_one_each_takes_the_nearest_free_pair_first() -> None:
    assert goals_of_one_world([[-1, 0.0], [0, 0]], [[0.5, 0], [-1.25, 0]]) == [[-1.25, 0.0], [0.5, 0.0]]
    # agent 1 takes the nearer of two, agent 0 gets the third choice rather than nothing
    assert goals_of_one_world([[0.0, 3.0], [0, 0]], [[0.0, 0.5], [0, 5], [1, 0]]) == [[0.0, 5.0], [0.0, 0.5]]


def test_one_each_swaps_where_that_is_shorter() -> None:
    # the nearest pair (agent 1, first landmark) would cost 0.125 + 2.0 in all, the other way round 0.875 + 1.0
    assert goals_of_one_world([[0.0, 1.0], [0, 0]], [[0.0, 0.125], [0, -1]]) == [[0.0, 0.125], [0.0, -1.0]]


def test_agents_without_a_landmark_stay() -> None:
    position = torch.tensor([[[0.0], [0.0]], [[1.0], [0.0]], [[2.0], [0.0]]])
    goals = covering.one_each(position, torch.tensor([[[1.1], [0.0]]]))
    torch.testing.assert_close(goals[:, 0, 0], torch.tensor([0.0, 1.1, 2.0]))


def test_cover_stands_between_two_landmarks() -> None:
    # agent 0 near the pair (0, 0), (0, 1) at x = 0.5; agent 1 beside the third landmark
    position = torch.tensor([[[0.5], [0.5]], [[5.0], [0.0]]])
    landmark = torch.tensor([[[0.0], [0.0]], [[0.0], [1.0]], [[5.0], [0.2]]])
    goals = covering.shared_out(position, landmark)
    torch.testing.assert_close(goals[..., 0], torch.tensor([[0.0, 0.5], [5.0, 0.2]]))


@pytest.mark.parametrize("wrong", [{"landmark_extent": 1e25}, {"density": 1e-30}])
def test_lengths_whose_squares_no_float_holds_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=min(wrong)):
        make("navigation", 1, [0], wrong)


def test_cover_is_left_out_where_it_cannot_enumerate() -> None:
    assert make("navigation", 1, [0], {"num_agents": 4, "num_landmarks": 6}).heuristics == ("nearest", "cover", "blind")
    env = make("navigation", 1, [0], {"num_agents": 4, "num_landmarks": 7})
    env.reset()
    with pytest.raises(ValueError, match="has no heuristic 'cover'; it has nearest"):
        env.heuristic("cover")


def test_the_blind_share_out_fixed_places_whatever_the_landmarks_are() -> None:
    torch.testing.assert_close(covering.places(1), torch.zeros(1, 2), atol=1e-3, rtol=0)
    quarters = {(round(float(x), 2), round(float(y), 2)) for x, y in covering.places(4)}
    assert quarters == {(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)}, "the middle of each quarter"
    env = make("navigation", 2, [0], {"num_agents": 4})
    env.reset()
    agents = torch.tensor([[0.0, 0, 0, 0, 0, 0, 0, 0, 0.7, 0.4, -0.4, 0.7, -0.7, -0.4, 0.4, -0.7]])
    states = torch.stack([torch.cat([agents, torch.full((1, 8), place)], 1) for place in (0.1, -0.8)], 1)
    env.set_state(states)
    # from (0.7, 0.4) to 0.8 (0.5, 0.5) = (0.4, 0.4): left; and each other by a quarter turn on: down, right, up
    assert env.heuristic("blind").tolist() == [[[1, 3, 2, 4]] * 2]
    assert not torch.equal(*env.heuristic("nearest")[0])
    assert make("navigation", 1, [0], {"num_agents": 40, "sees": 3}).heuristics == ("nearest", "blind")
    assert make("navigation", 1, [0], {"num_agents": 65}).heuristics == ("nearest",)


def test_the_former_name_of_a_heuristic_still_names_it() -> None:
    for task, name in (("navigation", "nearest"), ("predator-prey", "chase")):
        env = make(task, 1, [0])
        env.reset()
        assert torch.equal(env.heuristic("greedy"), env.heuristic(name))
    with pytest.raises(ValueError, match="has no heuristic 'greedy'; it has avoid"):
        make("formation", 1, [0]).heuristic("greedy")
