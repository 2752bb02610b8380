"""Predator-prey: rewards by hand, who drives the prey, and the anchors that its numbers are read against."""

import math

import pytest
import torch

from esp_envs import Items, UserError, make
from esp_envs.mpe.predator_prey import chase, circle, flee, out_of_bounds
from esp_envs.mpe.task import nearest_move
from tests.envs.playing import episode_return

QUARTER = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
MIRROR = torch.tensor([[-1.0, 0.0], [0.0, 1.0]])


def state_of(positions: list[list[float]]) -> torch.Tensor:
    """Return a state at rest: three predators, the prey, two obstacles."""
    return torch.cat([torch.zeros(8), torch.tensor(positions).flatten()]).view(1, 1, -1)


FAR_OBSTACLES = [[5.0, 5.0], [-5.0, 5.0]]


def test_each_predator_gets_ten_for_every_touch() -> None:
    env = make("predator-prey", 1, [0], {"prey": "still", "convention": "pettingzoo"})
    for prey_x, touches in ((2.0, 0), (0.12, 1), (0.0, 2)):
        # predators at the origin, right above it and far away; a touch is nearer than 0.125; nothing moves in the
        # first step from rest when positions are updated first
        env.set_state(state_of([[0.0, 0.0], [0.0, 0.1], [3.0, 3.0], [prey_x, 0.0], *FAR_OBSTACLES]))
        step = env.step(torch.zeros(1, 1, 3, dtype=torch.int64))
        assert step.reward[0, 0].tolist() == [10.0 * touches] * 3
        assert step.metrics["touches"].item() == touches
        assert step.metrics["contact"].item() == float(touches > 0)


def test_bounds_of_the_prey_by_hand() -> None:
    position = torch.tensor([0.0, 0.9, -0.95, 1.0, -1.5, 3.0])
    expected = torch.tensor([0.0, 0.0, 0.5, 1.0, math.exp(1.0), 10.0])
    torch.testing.assert_close(out_of_bounds(position), expected, atol=1e-5, rtol=0)


def test_a_learning_prey_pays_for_touches_and_bounds() -> None:
    env = make("predator-prey", 1, [0], {"control": "prey", "convention": "pettingzoo"})
    env.set_state(state_of([[0.95, 0.0], [3.0, 3.0], [-3.0, 3.0], [0.95, 0.05], *FAR_OBSTACLES]))
    step = env.step(torch.zeros(1, 1, 1, dtype=torch.int64))
    torch.testing.assert_close(step.reward, torch.full((1, 1, 1), -10.5))
    assert env.spec.num_agents == 1
    assert env.spec.symmetry == "d4*agents"
    assert [f.name for f in env.spec.state.fields if f.items is Items.AGENTS] == ["prey_velocity", "prey_position"]


def test_the_random_prey_follows_its_plan() -> None:
    env = make("predator-prey", 3, [0, 1])
    env.reset()
    assert env.prey_moves.shape == (25, 2, 3, 2)
    plan = env.prey_moves.clone()
    env.set_state(state_of([[3.0, 3.0], [-3.0, 3.0], [3.0, -3.0], [0.0, 0.0], *FAR_OBSTACLES]).expand(2, 3, -1))
    velocity = torch.zeros(2, 3, 2)
    for t in range(3):
        state = env.step(env.random_action()).next.state
        velocity = 0.75 * velocity + 0.4 * plan[t]
        torch.testing.assert_close(state[..., 6:8], velocity)


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_the_random_prey_is_uniform(actions: str) -> None:
    env = make("predator-prey", 2000, [0], {"actions": actions})
    env.reset()
    moves = env.prey_moves.reshape(-1, 2)
    length = moves.norm(dim=-1)
    assert ((length - 1).abs() < 1e-5).float().mean().item() == pytest.approx(0.8, abs=0.01)
    assert (length == 0).float().mean().item() == pytest.approx(0.2, abs=0.01)
    assert moves.mean(0).abs().max() < 0.01
    torch.testing.assert_close(moves.t() @ moves / len(moves), 0.4 * torch.eye(2), atol=0.01, rtol=0)
    assert (len(moves.unique(dim=0)) == 5) == (actions == "discrete")


def test_every_episode_draws_new_prey_moves() -> None:
    env = make("predator-prey", 4, [0], {"horizon": 2})
    env.reset()
    first = env.prey_moves.clone()
    for _ in range(2):
        env.step(env.random_action())
    assert not torch.equal(first, env.prey_moves)


def test_the_still_prey_stays_and_the_fleeing_one_runs() -> None:
    start = state_of([[-0.3, 0.0], [3.0, 3.0], [3.0, -3.0], [0.0, 0.0], *FAR_OBSTACLES])
    for prey, velocity in (("still", [0.0, 0.0]), ("fleeing", [0.4, 0.0])):
        env = make("predator-prey", 1, [0], {"prey": prey})
        env.set_state(start)
        moved = env.step(torch.zeros(1, 1, 3, dtype=torch.int64)).next.state[0, 0, 6:8]
        torch.testing.assert_close(moved, torch.tensor(velocity))


def test_the_fleeing_prey_turns_back_when_out_of_bounds() -> None:
    wish = flee(torch.tensor([[[0.5], [0.0]]]), torch.tensor([[0.95], [0.0]]))
    assert nearest_move(wish.unsqueeze(0)).item() == 1, "left, although the predator comes from there"


@pytest.mark.parametrize("element", [QUARTER, MIRROR, QUARTER @ MIRROR], ids=["rot90", "flip", "both"])
@pytest.mark.parametrize("rule", ["flee", "chase"])
def test_hand_written_rules_are_equivariant(element: torch.Tensor, rule: str) -> None:
    generator = torch.Generator().manual_seed(0)
    predator, velocity = (torch.rand(3, 2, 500, generator=generator) * 2 - 1 for _ in range(2))
    prey, prey_velocity = (torch.rand(2, 500, generator=generator) * 2 - 1 for _ in range(2))

    def wish(turn: torch.Tensor) -> torch.Tensor:
        if rule == "flee":
            return flee(turn @ predator, turn @ prey).unsqueeze(0)
        return chase(turn @ predator, turn @ velocity, turn @ prey, turn @ prey_velocity)

    straight = wish(torch.eye(2))
    torch.testing.assert_close(wish(element), element @ straight, atol=1e-4, rtol=1e-5)
    points = torch.tensor([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1.0]])
    turned = points[nearest_move(straight)] @ element.t()
    assert torch.equal(points[nearest_move(wish(element))], turned)
    assert not torch.equal(points[nearest_move(straight)], turned), "the moves of a turned world are other moves"


def test_a_rotation_that_the_moves_cannot_carry_is_not_a_symmetry() -> None:
    eighth = torch.tensor([[1.0, -1.0], [1.0, 1.0]]) / math.sqrt(2)
    prey = torch.tensor([[0.3], [0.1]])
    predator = torch.tensor([[[0.0], [0.0]]])
    points = torch.tensor([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1.0]])
    move, turned = (
        points[nearest_move(flee(g @ predator, g @ prey).unsqueeze(0))[0, 0]] for g in (torch.eye(2), eighth)
    )
    assert not torch.allclose(eighth @ move, turned, atol=0.1)


ANCHORS = [  # settings, policy, mean return of one learner over 40,000 episodes
    ({}, "random", 3.14),
    ({}, "greedy", 88.28),
    ({"prey": "fleeing"}, "greedy", 62.79),
    ({"prey": "still"}, "greedy", 167.01),
    ({"convention": "pettingzoo"}, "greedy", 67.19),
    ({"actions": "continuous"}, "greedy", 108.57),
    ({"control": "prey"}, "random", -105.84),
    ({"control": "prey"}, "greedy", -64.10),
]


@pytest.mark.parametrize(("settings", "policy", "expected"), ANCHORS)
def test_anchors(settings: dict[str, object], policy: str, expected: float) -> None:
    mean, sem = episode_return(make("predator-prey", 4000, [1], settings), policy)
    assert sem < max(0.02 * abs(expected), 0.2)
    assert mean == pytest.approx(expected, abs=4.5 * sem)


@pytest.mark.parametrize(
    "settings", [{"prey": "policy"}, {"control": "prey", "prey": "fleeing"}, {"num_predators": 0}, {"prey": "wild"}]
)
def test_settings_that_contradict_each_other_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(UserError, match="predator-prey does not take these settings"):
        make("predator-prey", 1, [0], settings)


def test_the_blind_circle_whatever_the_prey_does() -> None:
    # at the radius of the circle, 0.3, an agent on the x axis goes up; inside of it outwards
    predators = torch.tensor([[[0.3], [0.0]], [[0.0], [0.1]]])
    torch.testing.assert_close(circle(predators, 0.3)[..., 0], torch.tensor([[0.0, 1.0], [-1.0, 2.0]]))
    env = make("predator-prey", 2, [0], {"prey": "still"})
    rows = torch.zeros(1, 2, env.spec.state.width)
    place = env.spec.state.slices()
    rows[..., place["position"]] = torch.tensor([0.3, 0.0, -0.3, 0.0, 0.0, 0.3])
    rows[0, :, place["prey_position"]] = torch.tensor([[0.8, 0.8], [-0.8, 0.1]])
    env.reset()
    env.set_state(rows)
    assert env.heuristic("blind").tolist() == [[[4, 3, 1]] * 2], "up, down, left"
    assert make("predator-prey", 1, [0], {"control": "prey"}).heuristics == ("chase",)
