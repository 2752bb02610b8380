"""Wildlife monitoring against its rules in plain Python, and by hand."""

import numpy as np
import pytest
import torch

from esp_envs import Environment, make
from esp_envs.wildlife import MOVES
from tests.envs import wildlife_rules
from tests.envs.playing import episode_return

CASES = [
    {},
    {"convention": "corrected"},
    {"num_agents": 5, "width": 5, "height": 3},
    {"num_agents": 2, "width": 3, "height": 3, "convention": "corrected"},
    {"num_agents": 4, "width": 3, "height": 5, "poacher_moves": 1.0},
]
REST, UP, RIGHT, DOWN, LEFT = range(5)


def crowded(env: Environment, seed: int) -> torch.Tensor:
    """Random cells, drones in one cell with others included, half of the worlds with all near the poacher."""
    settings = env.settings
    g = torch.Generator().manual_seed(seed)
    shape = (env.num_seeds, env.num_envs, settings.num_agents + 1)
    x = torch.randint(settings.width, shape, generator=g) - settings.width // 2
    y = torch.randint(settings.height, shape, generator=g) - settings.height // 2
    cells = torch.stack([x, y], -1)
    near = cells[:, ::2, -1:] + torch.randint(-1, 2, cells[:, ::2, :-1].shape, generator=g)
    half = torch.tensor([settings.width // 2, settings.height // 2])
    cells[:, ::2, :-1] = torch.maximum(torch.minimum(near, half), -half)
    return cells.flatten(-2).float()


@pytest.mark.parametrize("settings", CASES, ids=str)
def test_thousands_of_states_step_as_the_rules_in_plain_python_say(settings) -> None:
    env = make("wildlife", 500, [0, 1], settings)
    known = env.settings
    size, corrected = (known.width, known.height), known.convention == "corrected"
    env.reset()
    seen = {"trapped": 0, "bumped": 0}
    for seed in range(2):
        state = crowded(env, seed)
        first = env.set_state(state)
        action = env.random_action()
        step = env.step(action)
        for s in range(2):
            for e in range(500):
                *drones, poacher = [tuple(c) for c in state[s, e].long().unflatten(0, (-1, 2)).tolist()]
                if e < 50:
                    for i in range(known.num_agents):
                        expected = wildlife_rules.observation(drones, poacher, i, *size, corrected)
                        np.testing.assert_array_equal(first.obs[s, e, i].numpy(), expected)
                move = tuple(env.plan[0, s, e, 0].tolist())
                actions = action[s, e].tolist()
                after, poacher, reward, trapped = wildlife_rules.step(drones, poacher, actions, move, *size, corrected)
                assert step.final is not None
                assert step.final.state[s, e].tolist() == [float(x) for cell in (*after, poacher) for x in cell]
                assert step.reward[s, e, 0].item() == pytest.approx(reward, abs=1e-6)
                assert bool(step.terminated[s, e]) == trapped
                for i in range(known.num_agents if e < 50 else 0):
                    expected = wildlife_rules.observation(after, poacher, i, *size, corrected)
                    np.testing.assert_array_equal(step.final.obs[s, e, i].numpy(), expected)
                seen["trapped"] += trapped
        seen["bumped"] += int(step.metrics["collisions"].sum())
    assert min(seen.values()) > 50, "traps and collisions must have been met"


def put(cells: list[tuple[int, int]], poacher_move=(0, 0), **settings) -> Environment:
    """One world with the drones and, last, the poacher in these cells."""
    env = make("wildlife", 1, [0], settings | {"num_agents": len(cells) - 1})
    env.reset()
    env.set_state(torch.tensor(cells, dtype=torch.float32).view(1, 1, -1))
    env.plan[0, 0, 0, 0] = torch.tensor(poacher_move)
    return env


def act(env: Environment, *actions: int):
    return env.step(torch.tensor(actions).view(1, 1, -1))


@pytest.mark.parametrize(("convention", "poacher_flees"), [("esp", False), ("corrected", True)])
def test_the_poachers_cell_before_or_after_its_move_counts(convention, poacher_flees) -> None:
    env = put([(-1, 0), (0, 2), (3, 3), (0, 0)], poacher_move=(0, -1), convention=convention)
    step = act(env, RIGHT, DOWN, REST)  # onto the poacher, and beside it
    assert bool(step.terminated) == (not poacher_flees)
    reward = -0.05 if poacher_flees else 2 - 0.05
    assert step.reward.flatten().tolist() == pytest.approx([reward] * 3)


@pytest.mark.parametrize(("convention", "trapped"), [("esp", False), ("corrected", True)])
def test_being_beside_goes_round_the_torus_in_the_corrected_convention_alone(convention, trapped) -> None:
    env = put([(3, 1), (-3, 0), (0, 0), (3, 0)], convention=convention)
    assert bool(act(env, DOWN, REST, REST).terminated) == trapped


def test_drones_that_would_share_a_cell_stay_and_do_not_count_as_beside() -> None:
    env = put([(0, 0), (1, 0), (2, 1), (0, 0)])  # the second and third both want to (2, 0)
    step = act(env, REST, RIGHT, DOWN)
    assert step.final is not None
    assert step.final.state.flatten()[:6].tolist() == [0, 0, 1, 0, 2, 1]
    assert not step.terminated
    assert (step.metrics["collisions"].item(), step.metrics["lone_landings"].item()) == (2, 1)
    env = put([(0, 0), (1, 0), (-1, 0), (0, 1), (0, 0)])
    assert act(env, REST, REST, REST, REST).reward.flatten().tolist() == pytest.approx([4 - 0.05] * 4), "all three pay"


def test_actions_mean_what_they_are_called() -> None:
    for action, name in enumerate(MOVES.names):
        state = act(put([(0, 0), (3, 3), (-3, -3)]), action, REST).next.state.flatten().tolist()
        assert (name, tuple(state[:2])) == (name, MOVES.points[action])


def test_the_poacher_moves_as_often_as_it_should_and_in_all_directions_alike() -> None:
    env = make("wildlife", 500, [0], {"poacher_moves": 0.6})
    env.reset()
    moves = env.plan[:, 0, :, 0].reshape(-1, 2).float()
    shares = [(moves == torch.tensor(point)).all(1).float().mean().item() for point in MOVES.points]
    assert shares == pytest.approx([0.4, 0.15, 0.15, 0.15, 0.15], abs=0.01)


def test_starts_are_on_different_cells_and_all_choices_are_alike() -> None:
    env = make("wildlife", 20000, [0], {"width": 3, "height": 3, "num_agents": 2, "horizon": 1})
    cells = env.reset().state.view(-1, 3, 2)
    index = (cells[..., 0] + 1) * 3 + cells[..., 1] + 1
    assert (index.sort(-1).values.diff(dim=-1) > 0).all()
    counts = torch.zeros(9, 9, 9)
    counts.index_put_(tuple(index.long().unbind(-1)), torch.ones(20000), accumulate=True)
    possible = counts[counts > 0]
    assert possible.numel() == 9 * 8 * 7
    assert possible.std().item() < 1.3 * possible.mean().sqrt().item(), "as a uniform choice scatters"


def test_the_nearest_drone_lands_where_another_will_stand_beside_it() -> None:
    for second, choice in (((0, 2), LEFT), ((0, 3), REST)):
        assert put([(1, 0), second, (0, 0)]).heuristic().flatten().tolist() == [choice, DOWN]


def test_worlds_that_end_begin_anew_where_the_plan_says() -> None:
    env = put([(0, 0), (1, 0), (0, 0)])
    step = act(env, REST, REST)
    assert step.terminated
    assert torch.equal(step.next.state.view(-1, 2), env.plan[0, 0, 0, 1:].float())


def test_a_new_plan_follows_when_one_is_used_up() -> None:
    env = make("wildlife", 8, [0], {"horizon": 4})
    env.reset()
    first = env.plan.clone()
    for is_used_up in (False, False, False, True):
        env.step(env.random_action())
        assert torch.equal(env.plan, first) is not is_used_up


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"width": 6}, "odd numbers"),
        ({"width": 3, "height": 3, "num_agents": 9}, "do not fit on 9 cells"),
        ({"num_agents": 1}, "num_agents"),
    ],
)
def test_settings_that_make_no_game_are_refused(settings, message) -> None:
    with pytest.raises(ValueError, match=message):
        make("wildlife", 1, [0], settings)


def test_anchors_of_the_card() -> None:
    env = make("wildlife", 4000, [1])
    for policy, expected in (("random", -2.8), ("surround", 1.98)):
        mean, error = episode_return(env, policy)
        assert mean == pytest.approx(expected, abs=4 * error + 0.03)


@pytest.mark.parametrize("drones", [3, 18])
def test_few_and_many_drones_see_where_each_other_is(drones) -> None:
    env = make("wildlife", 2, [0], {"num_agents": drones, "width": 9, "height": 9})
    seen = env.reset()
    cells = seen.state.view(2, drones + 1, 2)[:, :drones]
    others = seen.obs.view(2, drones, -1)[..., -2 * (drones - 1) :].view(2, drones, drones - 1, 2)
    for i in range(drones):
        assert torch.equal(others[:, i], torch.cat([cells[:, :i], cells[:, i + 1 :]], 1) - cells[:, i : i + 1])
