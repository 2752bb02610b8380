"""Tasks with many agents: pairs by broadcasting, neighbours alone, one density, and an assignment that scales."""

import itertools
import math
from operator import methodcaller

import pytest
import torch

from esp_cli.training.build import ScriptedController, play
from esp_envs import make
from esp_envs.mpe import covering, many, predator_prey_spec


@pytest.mark.parametrize("settings", [{}, {"convention": "pettingzoo"}, {"num_landmarks": 4}, {"reward_offset": 0.5}])
@pytest.mark.parametrize("agents", [2, 8])
def test_pairs_by_broadcasting_are_those_of_the_list(agents, settings):
    few = make("navigation", 5, [0, 1], {**settings, "num_agents": agents})
    many = make("navigation", 5, [0, 1], {**settings, "num_agents": agents, "sees": 99})
    many.set_state(few.reset().state)
    for _ in range(20):
        action = few.heuristic()
        here, there = few.step(action), many.step(action)
        torch.testing.assert_close(here.next.state, there.next.state, atol=1e-6, rtol=0)
        torch.testing.assert_close(here.reward, there.reward, atol=1e-4, rtol=1e-6)
        for name, value in here.metrics.items():
            torch.testing.assert_close(value, there.metrics[name], atol=1e-6, rtol=0)


def test_what_a_tree_finds_is_what_all_pairs_show(monkeypatch):
    settings = {"num_agents": 30, "num_landmarks": 20, "sees": 4}
    pairs, tree = (make("navigation", 3, [0, 1], settings) for _ in range(2))
    state = pairs.reset().state
    state[..., 60:64] = 0.5  # two agents in one place
    pairs.set_state(state)
    monkeypatch.setattr(many, "BY_TREE", 1)
    tree.set_state(state)
    for _ in range(10):
        action = pairs.heuristic()
        monkeypatch.setattr(many, "BY_TREE", 1)
        there = tree.step(action)
        monkeypatch.setattr(many, "BY_TREE", 99)
        here = pairs.step(action)
        torch.testing.assert_close(here.next.state, there.next.state, atol=1e-4, rtol=0)
        torch.testing.assert_close(here.next.obs, there.next.obs, atol=1e-4, rtol=0)
        for name, value in here.metrics.items():
            torch.testing.assert_close(value, there.metrics[name], atol=1e-5, rtol=0)


@pytest.mark.parametrize("settings", [{}, {"prey": "fleeing", "num_obstacles": 0}, {"control": "both"}])
def test_predators_by_broadcasting_are_those_of_the_list(monkeypatch, settings):
    few = make("predator-prey", 5, [0, 1], {**settings, "num_predators": 5})
    monkeypatch.setattr(predator_prey_spec, "MOST_BODIES", 1)
    many = make("predator-prey", 5, [0, 1], {**settings, "num_predators": 5})
    many.set_state(few.reset().state)
    many.prey_moves.copy_(few.prey_moves)
    touches = 0.0
    for _ in range(15):
        action = few.heuristic()
        here, there = few.step(action), many.step(action)
        torch.testing.assert_close(here.next.obs, there.next.obs, atol=1e-3, rtol=0)
        torch.testing.assert_close(here.reward, there.reward, atol=1e-2, rtol=0)
        touches += float(here.metrics["touches"].sum())
    assert touches > 10


def test_what_a_tree_finds_of_predators_is_what_all_pairs_show(monkeypatch):
    settings = {"num_predators": 30, "num_obstacles": 9, "sees": 4, "density": 30.0}
    pairs, tree = (make("predator-prey", 3, [0, 1], settings) for _ in range(2))
    state = pairs.reset().state
    pairs.prey_moves.zero_()
    tree.prey_moves.zero_()
    for _ in range(10):
        action = pairs.heuristic()
        monkeypatch.setattr(many, "BY_TREE", 1)
        tree.set_state(state)
        there = tree.step(action)
        monkeypatch.setattr(many, "BY_TREE", 99)
        pairs.set_state(state)
        here = pairs.step(action)
        torch.testing.assert_close(here.next.state, there.next.state, atol=1e-4, rtol=0)
        torch.testing.assert_close(here.next.obs, there.next.obs, atol=1e-4, rtol=0)
        state = here.next.state


def test_a_predator_sees_the_nearest_first():
    """Predators at x = 0, 1, 3, the prey at 10, obstacles at x = 5, -2."""
    env = make("predator-prey", 1, [0], {"num_predators": 3, "sees": 1})
    x = [0.0, 1.0, 3.0, 10.0, 5.0, -2.0]
    state = torch.tensor([0.0] * 8 + [part for place in x for part in (place, 0.0)])
    seen = env.set_state(state.view(1, 1, -1)).obs[0, 0]
    # velocity, position, the nearest obstacle, the nearest other, the prey and its velocity
    assert seen[0].tolist() == [0, 0, 0, 0, -2, 0, 1, 0, 10, 0, 0, 0]
    assert seen[2].tolist() == [0, 0, 3, 0, 2, 0, -2, 0, 7, 0, 0, 0]
    whole = make("predator-prey", 1, [0]).spec.observation
    assert env.spec.observation.without_counts == whole.without_counts


def test_contacts_happen_in_what_is_compared_above():
    env = make("navigation", 5, [0], {"num_agents": 8, "sees": 99})
    env.reset()
    assert sum(float(env.step(env.heuristic()).metrics["collisions"].sum()) for _ in range(20)) > 10


def test_one_sees_the_nearest_first():
    """Agents at x = 0, 1, 3, 7; landmarks at x = 0.5, -2, 6, 3.5."""
    env = make("navigation", 1, [0], {"num_agents": 4, "sees": 2})
    x = [0.0, 1.0, 3.0, 7.0, 0.5, -2.0, 6.0, 3.5]
    state = torch.tensor([0.0] * 8 + [part for place in x for part in (place, 0.0)])
    seen = env.set_state(state.view(1, 1, -1)).obs[0, 0]
    # velocity, position, two landmarks, two others
    assert seen[0].tolist() == [0, 0, 0, 0, 0.5, 0, -2, 0, 1, 0, 3, 0]
    assert seen[2].tolist() == [0, 0, 3, 0, 0.5, 0, -2.5, 0, -2, 0, -3, 0]
    assert env.spec.observation.width == 12
    assert [family.name for family in env.spec.observation.families] == ["landmarks", "others"]


def test_neighbours_look_like_all_of_them_up_to_their_number():
    near = make("navigation", 1, [0], {"num_agents": 20, "sees": 8}).spec.observation
    assert near.width == 2 + 2 + 16 + 16
    assert near.without_counts == make("navigation", 1, [0]).spec.observation.without_counts
    assert near.without_counts != make("predator-prey", 1, [0]).spec.observation.without_counts


def test_collisions_per_agent_by_hand():
    """Three of four agents within 0.3 of each other: three pairs, so two others touch each of three."""
    env = make("navigation", 1, [0], {"num_agents": 4, "convention": "pettingzoo", "sees": 8})
    places = [[0.0, 0.0], [0.2, 0.0], [0.0, 0.2], [2.0, 2.0], *[[5.0, 5.0]] * 4]
    env.set_state(torch.cat([torch.zeros(8), torch.tensor(places).flatten()]).view(1, 1, -1))
    step = env.step(torch.zeros(1, 1, 4, dtype=torch.int64))
    assert step.metrics["collisions"].item() == 3
    assert step.metrics["collisions_per_agent"].item() == 1.5
    distance = 4 * math.dist((2, 2), (5, 5))
    torch.testing.assert_close(
        step.reward[0, 0], torch.tensor([-0.5 * distance - 1] * 3 + [-0.5 * distance]), rtol=1e-5, atol=0
    )


def test_density_says_how_large_the_square_is():
    env = make("navigation", 50, [0], {"num_agents": 32, "density": 8.0})
    state = env.reset().state
    position, landmarks = state[..., 64:128], state[..., 128:]
    for places in (position, landmarks):  # 32 agents on a square of side 4: half of it is 2
        assert 1.9 < places.abs().max() <= 2.0
    assert make("navigation", 50, [0], {"num_agents": 32}).reset().state[..., 64:128].abs().max() <= 1.0


def test_walls_of_an_arena_grow_with_the_robots():
    env = make("formation", 1, [0], {"num_agents": 16, "density": 2.0})
    assert env.settings.arena.side_m == env.spec.settings["arena_m"] == 2.0
    assert make("formation", 1, [0]).settings.arena.side_m == 2.0


def by_brute_force(position, landmark):
    ways = (position.unsqueeze(1) - landmark.unsqueeze(0)).norm(dim=2)[..., 0]
    return min(sum(ways[i, k] for i, k in enumerate(order)) for order in itertools.permutations(range(len(landmark))))


def test_the_assignment_has_the_least_sum_of_ways():
    rng = torch.Generator().manual_seed(0)
    for _ in range(5):
        position, landmark = torch.randn(5, 2, 1, generator=rng), torch.randn(5, 2, 1, generator=rng)
        goals = covering.assigned(position, landmark)
        assert (goals - position).norm(dim=1).sum().item() == pytest.approx(float(by_brute_force(position, landmark)))


@pytest.mark.parametrize("most", [2000, 0])
@pytest.mark.parametrize(("agents", "landmarks"), [(5, 3), (3, 5), (6, 6)])
def test_everybody_gets_a_landmark_of_its_own_or_stays(monkeypatch, most, agents, landmarks):
    monkeypatch.setattr(covering, "MOST_ASSIGNED", most)
    rng = torch.Generator().manual_seed(1)
    position, landmark = torch.randn(agents, 2, 2, generator=rng), torch.randn(landmarks, 2, 2, generator=rng)
    goals = covering.assigned(position, landmark)
    for world in range(2):
        places = {tuple(x) for x in landmark[:, :, world].tolist()}
        chosen = [tuple(x) for x in goals[:, :, world].tolist()]
        taken = [goal for goal in chosen if goal in places]
        assert len(taken) == len(set(taken)) == min(agents, landmarks)
        stay = [i for i, goal in enumerate(chosen) if goal not in places]
        assert all(goals[i, :, world].tolist() == position[i, :, world].tolist() for i in stay)


def test_nearer_agents_go_first_where_there_are_too_many_for_the_hungarian_method(monkeypatch):
    """Agents at 0 and 1, landmarks at 1.1 and 3: the second takes the first landmark, and the first what is left."""
    monkeypatch.setattr(covering, "MOST_ASSIGNED", 0)
    line = lambda *x: torch.tensor([[[place], [0.0]] for place in x])  # noqa: E731
    assert covering.assigned(line(0.0, 1.0), line(1.1, 3.0))[:, 0, 0].tolist() == [3.0, pytest.approx(1.1)]


def test_the_hand_written_policy_beats_chance_with_fifty_agents():
    settings = {"num_agents": 50, "sees": 8, "density": 8.0}
    distance = {}
    for name, policy in (("random", methodcaller("random_action")), ("greedy", methodcaller("heuristic"))):
        env = make("navigation", 2, [0], settings)
        played = play(env, ScriptedController(policy))
        distance[name] = float(played.metrics["landmark_distance"].mean())
    assert distance["greedy"] < 0.6 * distance["random"]


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("predator-prey", {"num_predators": 24}),
        ("predator-prey", {"num_predators": 300, "sees": 8, "density": 8.0, "num_obstacles": 60}),
        ("wildlife", {"num_agents": 60, "width": 21, "height": 21}),
        ("wildlife", {"num_agents": 300, "width": 21, "height": 21}),
        ("formation", {"num_agents": 24, "arena_m": 5.0}),
        ("formation", {"num_agents": 80, "density": 1.0, "neighbours": 20}),
    ],
)
def test_the_other_tasks_take_many_agents_too(task, settings):
    env = make(task, 2, [0], settings)
    env.reset()
    for _ in range(3):
        step = env.step(env.heuristic())
        assert bool(step.next.obs.isfinite().all())
        assert step.reward.shape[-1] in settings.values()


@pytest.mark.parametrize(("task", "agents"), [("navigation", "num_agents"), ("predator-prey", "num_predators")])
def test_worlds_are_made_without_a_look_at_pairs_of_bodies_that_stand_nowhere_yet(task, agents, monkeypatch):
    looked = []
    monkeypatch.setattr(many.ManyWorlds, "_measure_by_tree", lambda *_: looked.append(1))
    env = make(task, 2, [0], {agents: 300, "sees": 4, "density": 3.0})
    assert not looked, "all lie in one place, so that these are N^2"
    monkeypatch.undo()
    env.reset()
    assert env.worlds._near.shape[1] < 300**2 / 4


def test_a_state_that_is_no_row_of_observations_is_told_by_its_number_of_fields(monkeypatch):
    env = make("predator-prey", 1, [0], {"num_predators": 300, "sees": 4})
    monkeypatch.setattr("esp_envs.spec.joint_layout", lambda *_: pytest.fail("lists a field of each agent"))
    assert env.spec.joint_fields is None
    assert not env.spec.is_joint


def test_a_seed_that_failed_leaves_the_others_alone():
    envs = [make("navigation", 1, [0, 1], {"num_agents": 200, "sees": 2, "actions": "continuous"}) for _ in range(2)]
    for env in envs:
        env.reset()
    whole = envs[0].random_action()
    broken = whole.clone()
    broken[1] = torch.nan
    first, second = (env.step(action).next.obs for env, action in zip(envs, (whole, broken), strict=True))
    assert torch.equal(first[0], second[0])
    assert not bool(second[1].isfinite().all())
