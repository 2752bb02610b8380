"""What every environment promises, checked over the registry and a few settings of each task.

A new task adds its settings to SETTINGS; the registry test below complains if it does not.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pytest
import torch
from safetensors.torch import load, save
from torch import Tensor

from esp_envs import Environment, Items, Layout, make, task_class, task_names
from esp_envs.conformance import PROMISES, NotAsked, Subject, check
from esp_envs.promises import nearly, same_step

SETTINGS: dict[str, list[dict[str, object]]] = {
    "navigation": [
        {},
        {"num_agents": 2, "actions": "continuous"},
        {"num_agents": 4, "num_landmarks": 3, "convention": "pettingzoo"},
        {"num_agents": 1, "horizon": 3},
        {"num_agents": 10, "sees": 3, "density": 8.0},
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
        {"horizon": 6, "actions": "discrete", "physics": "pymunk", "num_obstacles": 0, "num_agents": 3},
        {"horizon": 5, "physics": "mujoco-3d", "num_agents": 4, "sight": "nearness", "convention": "tight"},
        {"horizon": 7, "num_agents": 5, "neighbours": 2, "action_delay": 2, "mass_spread": 0.3, "friction_spread": 0.5},
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


NOT_ASKED = ("the state leaves out ", "what is seen has chance")
"""How the only reasons begin for which a built-in task may not be asked."""


@dataclass(frozen=True)
class Case:
    task: str
    settings: Mapping[str, object]

    def make(self, num_envs: int = 5, seeds: tuple[int, ...] = (3, 7), device: str = "cpu") -> Environment:
        return make(self.task, num_envs, seeds, self.settings, device)

    def __str__(self) -> str:
        return "-".join([self.task, *(f"{key}={value}" for key, value in self.settings.items())])


CASES = [Case(task, settings) for task, many in SETTINGS.items() for settings in many]
cases = pytest.mark.parametrize("case", CASES, ids=str)


def chance(env: Environment) -> Tensor | None:
    """What a task has drawn in advance, a row for each step; a test may write to it. None where there is none."""
    return getattr(env, "prey_moves", getattr(env, "plan", None))


def align(env: Environment, other: Environment, step: int) -> None:
    if (drawn := chance(env)) is not None:
        chance(other)[0] = drawn[step]


def test_every_task_of_this_package_is_covered() -> None:
    assert set(SETTINGS) == {task for task in task_names() if task_class(task).__module__.startswith("esp_envs.")}


@cases
@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__)
def test_every_promise_holds(case: Case, promise: Callable[[Subject], None]) -> None:
    make_worlds = lambda num_envs, seeds: case.make(num_envs, tuple(seeds))  # noqa: E731
    subject = Subject(make_worlds, ROUNDING.get(case.task, 0), align)
    try:
        promise(subject)
    except NotAsked as reason:
        assert str(reason).startswith(NOT_ASKED)  # noqa: PT017 - a promise that is not asked is not kept either
        pytest.skip(str(reason))


@pytest.mark.parametrize(("delay", "result"), [(0, None), (2, "the state leaves out delayed actions")])
def test_what_follows_a_state_is_asked_where_it_says_everything(delay: int, result: str | None) -> None:
    case = Case("formation", {"horizon": 7, "num_agents": 3, "action_delay": delay})
    findings = check(Subject(lambda num_envs, seeds: case.make(num_envs, tuple(seeds)), ROUNDING["formation"]))
    (found,) = (found for found in findings if found.promise == "set state reproduces what follows")
    assert (found.broken, found.not_asked) == (None, result)


@cases
def test_every_task_measures_something(case: Case) -> None:
    env = case.make()
    assert env.spec.name == case.task
    env.reset()
    assert env.step(env.random_action()).metrics
    assert env.heuristics


@cases
def test_a_state_survives_a_file(case: Case) -> None:
    env, other = case.make(), case.make(seeds=(100, 101))
    env.reset(), other.reset()
    env.step(env.random_action())
    file = save({name: value.contiguous() for name, value in env.state_dict().items()})
    other.load_state_dict(load(file))
    assert same_step(env.step(env.random_action()), other.step(other.random_action()))


@cases
def test_both_ends_of_an_episode_are_met(case: Case) -> None:
    env = case.make(num_envs=40)
    if not env.spec.terminates:
        pytest.skip("all worlds end together")
    env.reset()
    steps = [env.step(env.random_action()) for _ in range(4 * env.spec.horizon)]
    assert any(bool(step.terminated.any()) for step in steps)
    assert any(bool(step.truncated.any()) for step in steps)


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
        assert nearly([seen.obs], [expected], ROUNDING.get(case.task, 0))
        assert not nearly([seen.obs], [observation.obs], 0.01), "an order that changes nothing checks nothing"
        action = env.heuristic()
        a, b = env.step(action), other.step(action[:, :, list(order)])
        torch.testing.assert_close(b.reward, a.reward[..., list(order)])
        after, expected_after = ((step.final or step.next).state for step in (b, a))
        torch.testing.assert_close(after, permute(expected_after, spec.state, list(order)))


@pytest.mark.parametrize("task", SETTINGS)
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
    with pytest.raises(ValueError, match=r"no heuristic 'wishful'|has no hand-written policy"):
        env.heuristic("wishful")


@pytest.mark.gpu
@cases
def test_a_gpu_gives_the_same_physics(case: Case) -> None:
    if case.settings.get("sensor_noise_m"):
        pytest.skip("a GPU draws other noise")
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
