"""Step for step against the public `mpe2` package, on random states.

mpe2 moves positions before velocities; so does our convention `pettingzoo`. The convention `esp` follows the original
MPE, which moves velocities first: for it mpe2's integrator is replaced by the original's, and the reward is computed
from the formula in the documentation.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch

from esp_envs import Step, make

simple_spread = pytest.importorskip("mpe2.simple_spread.simple_spread")
simple_tag = pytest.importorskip("mpe2.simple_tag.simple_tag")

STATES_PER_CASE = 250
NEAR = {"atol": 2e-5, "rtol": 1e-5}
"""float32 against float64: a contact's force grows by 100 per length of overlap."""
NO_OP_LEFT_RIGHT_DOWN_UP = np.array([[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]], dtype=np.float64)


def original_integrate_state(world: Any, forces: Sequence[Any]) -> None:
    """Move the bodies as the original MPE does: velocity, then position."""
    for body, force in zip(world.entities, forces, strict=True):
        if not body.movable:
            continue
        velocity = body.state.p_vel * (1 - world.damping)
        if force is not None:
            velocity = velocity + force / body.mass * world.dt
        if body.max_speed is not None and (speed := np.linalg.norm(velocity)) > body.max_speed:
            velocity = velocity / speed * body.max_speed
        body.state.p_vel = velocity
        body.state.p_pos = body.state.p_pos + velocity * world.dt


def reference(raw_env: Any, convention: str, **settings: Any) -> Any:
    env = raw_env(**settings)
    env.reset(seed=0)
    if convention == "esp":
        env.world.integrate_state = lambda forces: original_integrate_state(env.world, forces)
    return env


def step_reference(env: Any, state: np.ndarray, actions: Sequence[Any]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Put mpe2 into a state, step it, and return the new state and everybody's observation."""
    rows = state.astype(np.float64).reshape(-1, 2)
    agents, bodies = env.world.agents, env.world.entities
    for k, agent in enumerate(agents):
        agent.state.p_vel = rows[k].copy()
    for k, body in enumerate(bodies):
        body.state.p_pos = rows[len(agents) + k].copy()
    env.current_actions = [action.copy() if isinstance(action, np.ndarray) else action for action in actions]
    env._execute_world_step()
    after = [agent.state.p_vel for agent in agents] + [body.state.p_pos for body in bodies]
    return np.concatenate(after), [env.scenario.observation(agent, env.world) for agent in agents]


def random_states(generator: torch.Generator, count: int, agents: int, fixed: int) -> torch.Tensor:
    """Return states [1, count, width] crowded enough that many bodies touch."""
    velocity = torch.randn(count, agents, 2, generator=generator) * 0.7
    position = (torch.rand(count, agents + fixed, 2, generator=generator) * 2 - 1) * 0.6
    return torch.cat([velocity, position], dim=1).reshape(1, count, -1)


def five_way(force: np.ndarray) -> np.ndarray:
    """Return mpe2's continuous action (no-op, left, right, down, up) of a planar force."""
    x, y = force.astype(np.float64)
    return np.array([0.0, max(-x, 0), max(x, 0), max(-y, 0), max(y, 0)])


def documented_esp_reward(state: np.ndarray, agents: int) -> float:
    """Return sum_i [-sum_l min_j d(j, l) - c_i - 1] in plain Python."""
    places = [tuple(p) for p in state.reshape(-1, 2)[agents:]]
    here, landmarks = places[:agents], places[agents:]
    total = 0.0
    for i in range(agents):
        total -= sum(min(math.dist(a, mark) for a in here) for mark in landmarks)
        total -= sum(1 for j in range(agents) if math.dist(here[i], here[j]) < 0.3)  # j = i counts: the original's bug
    return total


def final_of(step: Step) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return observation, state and reward of all worlds of the first seed."""
    return step.next.obs[0].numpy(), step.next.state[0].numpy(), step.reward[0].numpy()


@pytest.mark.parametrize("convention", ["esp", "pettingzoo"])
@pytest.mark.parametrize("agents", [2, 3, 4])
@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_navigation_steps_like_simple_spread(convention: str, agents: int, actions: str) -> None:
    count = STATES_PER_CASE
    settings = {"num_agents": agents, "num_landmarks": agents, "convention": convention, "actions": actions}
    ours = make("navigation", count, [agents], settings)
    theirs = reference(simple_spread.raw_env, convention, N=agents, continuous_actions=actions == "continuous")
    states = random_states(ours.generators[0], count, agents, agents)
    ours.set_state(states)
    action = ours.random_action()
    obs, state, reward = final_of(ours.step(action))
    collided = 0.0
    for k in range(count):
        chosen = action[0, k].numpy()
        if actions == "continuous":
            scaled = chosen / np.maximum(1.0, np.linalg.norm(chosen, axis=-1, keepdims=True))
            joint: Sequence[Any] = [five_way(force) for force in scaled]
        else:
            joint = [int(a) for a in chosen]
        after, seen = step_reference(theirs, states[0, k].numpy(), joint)
        np.testing.assert_allclose(state[k], after, **NEAR)
        for i in range(agents):
            # mpe2 appends the others' silent communication, zeros of 2 (N - 1) numbers
            np.testing.assert_allclose(obs[k, i], seen[i][: obs.shape[-1]], **NEAR)
            assert not seen[i][obs.shape[-1] :].any()
        if convention == "pettingzoo":
            expected = [theirs.rewards[f"agent_{i}"] for i in range(agents)]
        else:
            expected = [documented_esp_reward(after, agents)] * agents
        np.testing.assert_allclose(reward[k], expected, atol=1e-4)
        collided += theirs.scenario.reward(theirs.world.agents[0], theirs.world)
    assert collided < -0.05 * count, "too few collisions to say anything"


@pytest.mark.parametrize("convention", ["esp", "pettingzoo"])
@pytest.mark.parametrize(("predators", "obstacles"), [(3, 2), (2, 3), (4, 0)])
def test_predator_prey_steps_like_simple_tag(convention: str, predators: int, obstacles: int) -> None:
    count = STATES_PER_CASE
    settings = {"num_predators": predators, "num_obstacles": obstacles, "convention": convention}
    ours = make("predator-prey", count, [predators], settings)
    theirs = reference(simple_tag.raw_env, convention, num_adversaries=predators, num_obstacles=obstacles)
    states = random_states(ours.generators[0], count, predators + 1, obstacles) * 0.7
    ours.reset()
    ours.set_state(states)
    action = ours.random_action()
    prey_moves = torch.randint(5, (count,), generator=ours.generators[0]).numpy()
    ours.prey_moves[0, 0] = torch.tensor(NO_OP_LEFT_RIGHT_DOWN_UP[prey_moves], dtype=torch.float32)
    obs, state, reward = final_of(ours.step(action))
    touches = 0.0
    for k in range(count):
        joint = [int(a) for a in action[0, k]] + [int(prey_moves[k])]
        after, seen = step_reference(theirs, states[0, k].numpy(), joint)
        np.testing.assert_allclose(state[k], after, **NEAR)
        for i in range(predators):
            np.testing.assert_allclose(obs[k, i], seen[i], **NEAR)
            assert reward[k, i] == theirs.rewards[f"adversary_{i}"]
        touches += reward[k, 0] / 10
    assert touches > 0.02 * count, "too few touches to say anything"


@pytest.mark.parametrize("convention", ["esp", "pettingzoo"])
def test_a_learning_prey_sees_and_gets_what_simple_tag_gives(convention: str) -> None:
    count = STATES_PER_CASE
    ours = make("predator-prey", count, [5], {"control": "prey", "convention": convention})
    hunters = make("predator-prey", count, [5], {"convention": convention})
    theirs = reference(simple_tag.raw_env, convention)
    states = random_states(ours.generators[0], count, 4, 2) * 2.2
    ours.set_state(states)
    hunters.set_state(states)
    action, hunt = ours.random_action(), hunters.heuristic()
    obs, state, reward = final_of(ours.step(action))
    for k in range(count):
        after, seen = step_reference(theirs, states[0, k].numpy(), [*hunt[0, k].tolist(), int(action[0, k, 0])])
        np.testing.assert_allclose(state[k], after, **NEAR)
        np.testing.assert_allclose(obs[k, 0], seen[3], **NEAR)
        np.testing.assert_allclose(reward[k, 0], theirs.rewards["agent_0"], atol=2e-4)
    assert (reward < -0.1).mean() > 0.1, "too few prey out of bounds to say anything"
