"""What every environment promises, checked over the registry and a few settings of each task.

A new task adds its settings to SETTINGS; the registry test below complains if it does not.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from torch import Tensor

from esp_envs import Continuous, Environment, Items, Layout, Observation, Step, make, task_class, task_names

SETTINGS: dict[str, list[dict[str, object]]] = {
    "navigation": [
        {},
        {"num_agents": 2, "actions": "continuous"},
        {"num_agents": 4, "num_landmarks": 3, "convention": "pettingzoo"},
        {"num_agents": 1, "horizon": 3},
    ],
    "predator-prey": [
        {},
        {"actions": "continuous", "num_obstacles": 0},
        {"prey": "fleeing", "num_predators": 2, "num_obstacles": 3},
        {"prey": "still", "convention": "pettingzoo", "num_predators": 1},
        {"control": "prey"},
    ],
    "formation": [
        {"horizon": 8},
        {
            "horizon": 6,
            "actions": "discrete",
            "physics": "pymunk",
            "num_obstacles": 0,
            "num_agents": 3,
            "neighbours": 2,
        },
        {"horizon": 5, "physics": "mujoco-3d", "num_agents": 4, "sight": "nearness", "convention": "tight"},
        {"horizon": 7, "num_agents": 5, "action_delay": 2, "mass_spread": 0.3, "friction_spread": 0.5},
        {"horizon": 6, "num_agents": 2, "sensor_noise_m": 0.01, "heading_noise_rad": 0.1, "wheel_mismatch": 0.05},
    ],
    "wildlife": [
        {"horizon": 30},
        {"num_agents": 4, "width": 5, "height": 3, "convention": "corrected", "horizon": 12},
        {"num_agents": 2, "width": 3, "height": 3, "horizon": 8, "poacher_moves": 0.0},
    ],
}
ROUNDING = {"formation": 1e-5}
"""Tasks whose physics is finer than the float32 of the states they hand out, and how far one step carries that."""


def hides_state(settings: Mapping[str, object]) -> bool:
    """Whether a task has noise of its own, or wheels and tilts that its planar state leaves out."""
    own = ("noise", "spread", "mismatch", "delay")
    return settings.get("physics") == "mujoco-3d" or any(word in name for name in settings for word in own)


@dataclass(frozen=True)
class Case:
    """A task with settings."""

    task: str
    settings: Mapping[str, object]

    def make(self, num_envs: int = 5, seeds: tuple[int, ...] = (3, 7), device: str = "cpu") -> Environment:
        return make(self.task, num_envs, seeds, self.settings, device)

    def __str__(self) -> str:
        return "-".join([self.task, *(f"{key}={value}" for key, value in self.settings.items())])


CASES = [Case(task, settings) for task, many in SETTINGS.items() for settings in many]
cases = pytest.mark.parametrize("case", CASES, ids=str)


def same_observation(a: Observation, b: Observation) -> bool:
    return torch.equal(a.obs, b.obs) and torch.equal(a.state, b.state)


def same_step(a: Step, b: Step, where: tuple[object, ...] = ()) -> bool:
    """Whether two steps are equal bit for bit, in the worlds that `where` selects."""
    pairs = [
        (a.next.obs, b.next.obs),
        (a.next.state, b.next.state),
        (a.reward, b.reward),
        (a.terminated, b.terminated),
        (a.truncated, b.truncated),
        *((a.metrics[name], b.metrics[name]) for name in a.metrics),
    ]
    assert (a.final is None) == (b.final is None)
    if a.final is not None and b.final is not None:
        pairs += [(a.final.obs, b.final.obs), (a.final.state, b.final.state)]
    return all(torch.equal(x[where], y[where]) for x, y in pairs)


def nearly_same(a: list[Tensor], b: list[Tensor], bound: float) -> bool:
    """Whether tensors agree within `bound`; bit for bit where it is 0."""
    return all(bool(((x.float() - y.float()).abs() <= bound).all()) for x, y in zip(a, b, strict=True))


def tensors_of(step: Step) -> list[Tensor]:
    final = [] if step.final is None else [step.final.obs, step.final.state]
    floats = [step.next.obs, step.next.state, step.reward, *step.metrics.values(), *final]
    return [*floats, step.terminated, step.truncated]


def test_every_registered_task_is_covered() -> None:
    assert set(SETTINGS) == set(task_names())


@cases
def test_observations_and_rewards_fit_the_spec(case: Case) -> None:
    env = case.make()
    spec = env.spec
    assert spec.name == case.task
    lead = (2, 5)
    observation = env.reset()
    for _ in range(spec.horizon + 2):
        assert observation.obs.shape == (*lead, spec.num_agents, spec.observation.width)
        assert observation.state.shape == (*lead, spec.state.width)
        step = env.step(env.random_action())
        observation = step.next
        assert step.reward.shape == (*lead, spec.num_agents)
        assert step.terminated.shape == step.truncated.shape == lead
        assert step.terminated.dtype == step.truncated.dtype == torch.bool
        assert step.metrics, "a task measures something"
        assert all(value.shape == lead for value in step.metrics.values())
        for value in tensors_of(step):
            assert value.dtype in (torch.float32, torch.bool)
            assert value.is_contiguous()
            assert torch.isfinite(value.float()).all()
        if spec.shared_reward:
            assert torch.equal(step.reward, step.reward[..., :1].expand_as(step.reward))


@cases
def test_actions_of_heuristics_and_chance_lie_in_the_action_space(case: Case) -> None:
    env = case.make()
    env.reset()
    action = env.spec.action
    for name in (None, *env.heuristics):
        for joint in (env.random_action(), env.heuristic(name)):
            if isinstance(action, Continuous):
                assert joint.shape == (2, 5, env.spec.num_agents, action.width)
                assert joint.dtype == torch.float32
                assert joint.abs().max() <= 1 + 1e-6
            else:
                assert joint.shape == (2, 5, env.spec.num_agents)
                assert joint.dtype == torch.int64
                assert 0 <= joint.min() <= joint.max() < action.count
            env.step(joint)
    assert torch.equal(env.heuristic(), env.heuristic(env.heuristics[0])), "the first name is the default"


@cases
def test_episodes_end_together_at_the_horizon(case: Case) -> None:
    env = case.make()
    if env.spec.terminates:
        pytest.skip("each world ends for itself")
    env.reset()
    for _ in range(2):
        for t in range(env.spec.horizon):
            step = env.step(env.random_action())
            last = t == env.spec.horizon - 1
            assert not step.terminated.any()
            assert step.truncated.all() if last else not step.truncated.any()
            assert (step.final is not None) == last
        assert step.final is not None
        assert not torch.equal(step.final.state, step.next.state), "a new episode starts elsewhere"
    env.step(env.random_action())
    env.reset()
    ends = [bool(env.step(env.random_action()).truncated.any()) for _ in range(env.spec.horizon)]
    assert ends == [False] * (env.spec.horizon - 1) + [True], "reset restarts the clock"


@cases
def test_episodes_that_end_for_themselves_end_at_the_horizon_at_the_latest(case: Case) -> None:
    env = case.make(num_envs=40)
    if not env.spec.terminates:
        pytest.skip("all worlds end together")
    env.reset()
    age = torch.zeros(2, 40)
    seen = {"terminated": 0, "truncated": 0}
    for _ in range(4 * env.spec.horizon):
        step = env.step(env.random_action())
        age += 1
        assert step.final is not None
        assert not (step.terminated & step.truncated).any()
        ended = step.terminated | step.truncated
        assert torch.equal(step.truncated, (age == env.spec.horizon) & ~step.terminated)
        assert torch.equal(step.final.state[~ended], step.next.state[~ended])
        assert torch.equal(step.final.obs[~ended], step.next.obs[~ended])
        age[ended] = 0
        seen["terminated"] += int(step.terminated.sum())
        seen["truncated"] += int(step.truncated.sum())
    assert min(seen.values()) > 0, "both ends must have been met"


def chance(env: Environment) -> Tensor | None:
    """What a task has drawn in advance, a row for each step; a test may write to it. None where there is none."""
    return getattr(env, "prey_moves", getattr(env, "plan", None))


@cases
def test_the_same_seed_gives_the_same_run(case: Case) -> None:
    first, again, other = case.make(seeds=(3,)), case.make(seeds=(3,)), case.make(seeds=(4,))
    start = first.reset()
    assert same_observation(start, again.reset())
    assert not torch.equal(start.state, other.reset().state)
    for _ in range(first.spec.horizon + 5):
        action = first.random_action()
        assert torch.equal(action, again.random_action())
        assert same_step(first.step(action), again.step(action))


@cases
def test_a_seed_alone_equals_itself_among_others(case: Case) -> None:
    alone, among = case.make(num_envs=7, seeds=(7,)), case.make(num_envs=7, seeds=(3, 7, 11))
    assert torch.equal(alone.reset().obs[0], among.reset().obs[1])
    for _ in range(alone.spec.horizon + 5):
        own, joint = alone.random_action(), among.random_action()
        assert torch.equal(own[0], joint[1])
        mine, ours = alone.step(own), among.step(joint)
        for x, y in zip(tensors_of(mine), tensors_of(ours), strict=True):
            assert torch.equal(x[0], y[1])


@cases
def test_worlds_do_not_touch_each_other(case: Case) -> None:
    env, twin = case.make(num_envs=4), case.make(num_envs=4)
    env.reset(), twin.reset()
    rest = (slice(None), slice(1, None))
    changed = False
    for _ in range(env.spec.horizon + 3):
        action = env.random_action()
        assert torch.equal(action, twin.random_action())
        different = action.clone()
        different[:, 0] = -action[:, 0] if isinstance(env.spec.action, Continuous) else (action[:, 0] + 1) % 5
        a, b = env.step(action), twin.step(different)
        assert same_step(a, b, rest)
        changed |= not same_step(a, b)
    assert changed, "the other actions must have moved world 0"


@cases
def test_what_is_handed_out_is_nobody_elses_memory(case: Case) -> None:
    env, twin = case.make(), case.make()
    for start in (env.reset(), twin.reset()):
        kept = (start.obs.clone(), start.state.clone())
    start.obs.fill_(7), start.state.fill_(7)  # the twin's
    assert not torch.equal(start.obs, kept[0])
    for _ in range(env.spec.horizon + 2):
        action = env.random_action()
        before = action.clone()
        step, marred = env.step(action), twin.step(twin.random_action())
        assert torch.equal(action, before), "a step leaves the action alone"
        assert same_step(step, marred), "writing into earlier results changed the simulation"
        copies = [value.clone() for value in tensors_of(step)]
        for value in tensors_of(marred):
            value.fill_(1)
        env.heuristic()
        assert all(torch.equal(x, y) for x, y in zip(copies, tensors_of(step), strict=True))
        kept_step = [value.clone() for value in tensors_of(step)]
    env.step(env.random_action())
    assert all(torch.equal(x, y) for x, y in zip(kept_step, tensors_of(step), strict=True))


@cases
def test_a_saved_environment_goes_on_bit_for_bit(case: Case) -> None:
    env, other = case.make(), case.make(seeds=(100, 101))
    env.reset(), other.reset()
    for _ in range(env.spec.horizon // 2):
        env.step(env.random_action())
    file = save({name: value.contiguous() for name, value in env.state_dict().items()})
    expected = [env.step(env.random_action()) for _ in range(env.spec.horizon + 5)]
    other.load_state_dict(load(file))
    for step in expected:
        assert same_step(step, other.step(other.random_action()))


@cases
def test_a_saved_environment_is_a_copy(case: Case) -> None:
    env = case.make()
    env.reset()
    saved = env.state_dict()
    copies = {name: value.clone() for name, value in saved.items()}
    for _ in range(env.spec.horizon + 1):
        env.step(env.random_action())
    assert all(torch.equal(saved[name], copies[name]) for name in copies)


@cases
def test_an_environment_of_another_size_is_refused(case: Case) -> None:
    saved = case.make(num_envs=5).state_dict()
    for other in (case.make(num_envs=6), case.make(seeds=(1,))):
        with pytest.raises(ValueError, match="other seeds, worlds or bodies"):
            other.load_state_dict(saved)


@cases
def test_set_state_reproduces_what_follows(case: Case) -> None:
    if hides_state(case.settings):
        pytest.skip("the state does not say everything")
    env, other = case.make(), case.make(seeds=(50, 60))
    observation = env.reset()
    for t in range(min(6, env.spec.horizon - 1)):
        again = other.set_state(observation.state)
        assert nearly_same([again.obs, again.state], [observation.obs, observation.state], ROUNDING.get(case.task, 0))
        if (drawn := chance(other)) is not None:
            drawn[0] = chance(env)[t]
        action = env.random_action()
        step, copy = env.step(action), other.step(action)
        assert nearly_same(tensors_of(copy), tensors_of(step), ROUNDING.get(case.task, 0))
        observation = step.next


@cases
def test_set_state_starts_an_episode(case: Case) -> None:
    env = case.make()
    observation = env.reset()
    if env.spec.horizon > 1:
        env.step(env.random_action())
    env.set_state(observation.state)
    alive = torch.ones(2, 5, dtype=torch.bool)
    for t in range(env.spec.horizon):
        step = env.step(env.random_action())
        alive &= ~step.terminated
        assert torch.equal(step.truncated & alive, alive & torch.tensor(t == env.spec.horizon - 1))
        alive &= ~step.truncated
    with pytest.raises(ValueError, match="shape"):
        env.set_state(observation.state[:, :-1])


@cases
def test_a_joint_action_of_the_wrong_shape_is_refused(case: Case) -> None:
    env = case.make()
    env.reset()
    with pytest.raises(ValueError, match="shape"):
        env.step(env.random_action().transpose(0, 1))


def permute(values: Tensor, layout: Layout, order: list[int]) -> Tensor:
    """Reorder the AGENTS items of a row: item i of the result is item order[i] of `values`."""
    values = values.clone()
    for field, where in zip(layout.fields, layout.slices().values(), strict=True):
        if field.items is Items.AGENTS:
            items = values[..., where].unflatten(-1, (field.count, -1))
            values[..., where] = items[..., order, :].flatten(-2)
    return values


def permute_observations(obs: Tensor, layout: Layout, order: list[int]) -> Tensor:
    """Reorder the agents of obs [..., N, D], and in each row the items that count over the other agents."""
    rows = []
    for i, old in enumerate(order):
        row = obs[..., old, :].clone()
        others_now = [order[j] for j in range(len(order)) if j != i]
        others_then = [k for k in range(len(order)) if k != old]
        source = [others_then.index(k) for k in others_now]
        for field, where in zip(layout.fields, layout.slices().values(), strict=True):
            if field.items is Items.OTHERS:
                row[..., where] = row[..., where].unflatten(-1, (field.count, -1))[..., source, :].flatten(-2)
        rows.append(row)
    return torch.stack(rows, dim=-2)


@cases
def test_agents_of_a_team_are_interchangeable(case: Case) -> None:
    """Permuting the agents permutes everything that the layouts mark as counting over agents."""
    if case.settings.get("sensor_noise_m"):
        pytest.skip("each sensor has noise of its own")
    env, other = case.make(), case.make()
    spec = env.spec
    observation = env.reset()
    other.reset()
    for order in itertools.islice(itertools.permutations(range(spec.num_agents)), 1, 6):
        env.set_state(observation.state)
        seen = other.set_state(permute(observation.state, spec.state, list(order)))
        expected = permute_observations(observation.obs, spec.observation, list(order))
        assert nearly_same([seen.obs], [expected], ROUNDING.get(case.task, 0))
        assert not nearly_same([seen.obs], [observation.obs], 0.01), "an order that changes nothing checks nothing"
        action = env.heuristic()
        a, b = env.step(action), other.step(action[:, :, list(order)])
        torch.testing.assert_close(b.reward, a.reward[..., list(order)])
        after, expected_after = ((step.final or step.next).state for step in (b, a))
        torch.testing.assert_close(after, permute(expected_after, spec.state, list(order)))


@cases
def test_a_scene_can_be_drawn(case: Case) -> None:
    env = case.make()
    env.reset()
    first, second = env.scene((0, 0)), env.scene((1, 4))
    assert first != second
    assert len(first.bodies) >= env.spec.num_agents
    x_min, x_max, y_min, y_max = first.window
    assert x_min < x_max
    assert y_min < y_max
    assert all(np.isfinite(body.position).all() and body.radius > 0 for body in first.bodies)


@pytest.mark.parametrize("task", task_names())
def test_the_card_shows_the_layout_that_the_spec_has(task: str) -> None:
    env = make(task, 1, [0])
    card = type(env).__doc__ or ""
    table = [line for line in card.splitlines() if line.strip().startswith("|")]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table]
    told = [(row[0], row[1], row[3]) for row in rows[2:]]
    assert told == [(span, name, unit) for span, name, _, unit in env.spec.observation.table()]
    for heading in ("Actions", "Observation", "State", "Reward", "Start", "Terminated", "Truncated", "Versions"):
        assert f"{heading}" in card
    assert all(name in card for name in (*env.heuristics, *env.step(env.random_action()).metrics))


@pytest.mark.parametrize("task", task_names())
def test_settings_are_described_and_checked(task: str) -> None:
    fields = task_class(task).Settings.model_fields
    assert all(field.description for field in fields.values())
    with pytest.raises(ValueError, match="no_such_setting"):
        make(task, 1, [0], {"no_such_setting": 1})
    with pytest.raises(ValueError, match="horizon"):
        make(task, 1, [0], {"horizon": 0})
    env = make(task, 1, [0])
    env.reset()
    with pytest.raises(ValueError, match="no heuristic 'wishful'"):
        env.heuristic("wishful")


def test_an_unknown_task_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(ValueError, match="navigation"):
        make("navigaton", 1, [0])


@pytest.mark.gpu
@cases
def test_a_gpu_gives_the_same_physics(case: Case) -> None:
    cpu, gpu = case.make(num_envs=300), case.make(num_envs=300, device="cuda")
    state = cpu.reset().state
    gpu.reset()
    cpu.set_state(state), gpu.set_state(state.cuda())
    if (drawn := chance(gpu)) is not None:
        drawn.copy_(chance(cpu))
    action = cpu.heuristic()
    a, b = cpu.step(action), gpu.step(action.cuda())
    torch.testing.assert_close(b.next.obs.cpu(), a.next.obs, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(b.next.state.cpu(), a.next.state, atol=1e-4, rtol=1e-4)
    assert ((b.reward.cpu() - a.reward).abs() < 1e-3).float().mean() > 0.98, "a contact may fall to either side"
    for _ in range(gpu.spec.horizon):
        gpu.step(gpu.random_action())
    saved = gpu.state_dict()
    expected = gpu.step(gpu.random_action())
    gpu.load_state_dict(saved)
    assert same_step(expected, gpu.step(gpu.random_action()))
