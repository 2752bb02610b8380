"""The task under test, and promises about what a step returns, how episodes end, and what is refused."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from esp_envs.base import Environment, Observation, Step
from esp_envs.spec import Continuous, Discrete

MakeWorlds = Callable[[int, Sequence[int]], Environment]
WORLDS, SEEDS = 5, (3, 7)


class Broken(ValueError):  # noqa: N818 - it is a finding, not an error of the program
    """A task does not keep a promise; the message says what happens instead."""


class NotAsked(ValueError):  # noqa: N818
    """A promise does not concern a task; the message says why."""


class Unfinished(ValueError):  # noqa: N818
    """The time is over, and what was seen until then keeps the promise; the message says how much that is."""


@dataclass(frozen=True)
class Subject:
    """A task to check."""

    make: MakeWorlds  # makes the worlds, given E and the seeds
    rounding: float = 0.0  # how far a step from a restored state may differ, where physics is finer than float32
    align: Callable[[Environment, Environment, int], None] | None = None  # gives the second the first's chance
    deadline: float = math.inf  # at which `time.monotonic` promises stop looking

    def worlds(self, num_envs: int = WORLDS, seeds: Sequence[int] = SEEDS) -> Environment:
        return self.make(num_envs, seeds)

    def steps(self, count: int) -> Iterator[int]:
        """Count so many steps; raise `Unfinished` where the time is over before."""
        for done in range(count):
            if time.monotonic() >= self.deadline:
                raise Unfinished(f"the time was over after {done} of {count} steps")
            yield done


def tensors_of(step: Step) -> list[Tensor]:
    """Return every tensor of a step."""
    final = [] if step.final is None else parts_of(step.final)
    return [*parts_of(step.next), step.reward, *step.metrics.values(), *final, step.terminated, step.truncated]


def equal(a: Tensor, b: Tensor) -> bool:
    """Return whether two tensors are equal bit for bit; NaN equals NaN."""
    return a.shape == b.shape and bool(((a == b) | ((a != a) & (b != b))).all())  # noqa: PLR0124


def same_step(a: Step, b: Step, where: tuple[slice | Tensor, ...] = ()) -> bool:
    """Return whether two steps are equal bit for bit, in the worlds that `where` selects."""
    if (a.final is None) != (b.final is None) or a.metrics.keys() != b.metrics.keys():
        return False
    return all(equal(x[where], y[where]) for x, y in zip(tensors_of(a), tensors_of(b), strict=True))


def parts_of(observation: Observation) -> list[Tensor]:
    """Return what an observation consists of."""
    parts = (observation.obs, observation.state, observation.action_mask, observation.alive)
    return [part for part in parts if part is not None]


def same_observation(a: Observation, b: Observation, where: tuple[Tensor, ...] = ()) -> bool:
    """Return whether two observations are equal bit for bit, in the worlds that `where` selects."""
    return all(equal(x[where], y[where]) for x, y in zip(parts_of(a), parts_of(b), strict=True))


def nearly(a: Sequence[Tensor], b: Sequence[Tensor], bound: float) -> bool:
    """Return whether tensors agree within `bound`; bit for bit where it is 0."""
    close = (torch.allclose(x.float(), y.float(), 0.0, bound, equal_nan=True) for x, y in zip(a, b, strict=False))
    return len(a) == len(b) and all(close)


def require_method(env: Environment, method: str, otherwise: str) -> None:
    """Ask nothing of a task that lacks an optional method."""
    if not env.has(method):
        raise NotAsked(otherwise)


def require_refusal(call: Callable[..., object], given: object, otherwise: str) -> None:
    """Raise `Broken` unless a call with this argument raises a ValueError."""
    try:
        call(given)
    except ValueError:
        return
    raise Broken(otherwise)


def require(holds: bool, otherwise: str) -> None:
    """Raise `Broken` with a sentence unless something holds."""
    if not holds:
        raise Broken(otherwise)


def require_equal(what: str, got: object, expected: object) -> None:
    """Raise `Broken` unless something is as expected."""
    require(got == expected, f"{what} is {got}, expected {expected}")


_MANY, _ENOUGH = 40, 4000  # worlds among which some end early at random, and steps of an episode times worlds


def observations_rewards_and_metrics_fit_the_spec(subject: Subject) -> None:
    """Shapes, types, finite numbers and contiguous memory, over more than an episode."""
    env = subject.worlds()
    spec, lead = env.spec, (env.num_seeds, env.num_envs)
    observation = env.reset()
    for _ in subject.steps(spec.horizon + 2):
        require_equal("obs", tuple(observation.obs.shape), (*lead, spec.num_agents, spec.observation.width))
        require_equal("state", tuple(observation.state.shape), (*lead, spec.state.width))
        _require_mask(env, observation.action_mask)
        step = env.step(env.random_action())
        _require_ends(env, observation.alive, step)
        observation = step.next
        require_equal("reward", tuple(step.reward.shape), (*lead, spec.num_agents))
        for name, flags in (("terminated", step.terminated), ("truncated", step.truncated)):
            require_equal(name, (tuple(flags.shape), flags.dtype), (lead, torch.bool))
        for name, value in step.metrics.items():
            require_equal(f"metric {name}", tuple(value.shape), lead)
        for value in tensors_of(step):
            require(value.dtype in (torch.float32, torch.bool), f"a result of 'step' is {value.dtype}, not float32")
            require(value.is_contiguous(), "a result of 'step' is not contiguous")
            require(bool(torch.isfinite(value.float()).all()), "a result of 'step' is not finite")
        if spec.shared_reward:
            same = equal(step.reward, step.reward[..., :1].expand_as(step.reward))
            require(same, "the spec says that agents share the reward, but they get different ones")


def _require_mask(env: Environment, mask: Tensor | None) -> None:
    spec, now = env.spec, env.action_mask()
    if not isinstance(spec.action, Discrete) or not spec.masks:
        require(mask is None and now is None, "an action mask is given, but the spec does not say 'masks'")
        return
    if mask is None or now is None:
        raise Broken("the spec says 'masks', but an observation or 'action_mask()' gives none")
    require_equal("action mask", (tuple(mask.shape), mask.dtype), ((*env.action_shape, spec.action.count), torch.bool))
    require(bool(mask.any(-1).all()), "an action mask allows an agent nothing")
    require(equal(mask, now), "the observation's action mask differs from that of 'action_mask()'")


def _require_ends(env: Environment, alive: Tensor | None, step: Step) -> None:
    after = step.reached.alive
    if alive is None or after is None:
        require(alive is None and after is None, "'alive' is given in some observations only")
        require(not env.spec.agents_end, "the spec says 'agents_end', but observations have no 'alive'")
        return
    require(env.spec.agents_end, "'alive' is given, but the spec does not say 'agents_end'")
    require_equal("alive", (tuple(after.shape), after.dtype), (env.action_shape[:3], torch.bool))
    require(not bool((after & ~alive).any()), "an agent that has ended acts again in the same episode")
    paid = not env.spec.shared_reward and bool(step.reward[~alive].any())
    require(not paid, "an agent that has ended gets a reward of its own")


def actions_of_heuristics_and_chance_lie_in_the_action_space(subject: Subject) -> None:
    """Shape, type and range of every joint action that the task itself proposes."""
    env = subject.worlds()
    env.reset()
    action = env.spec.action
    for name in (None, *env.heuristics):
        for propose in (env.random_action, partial(env.heuristic, name) if env.heuristics else env.random_action):
            joint = propose()
            require_equal("a joint action", tuple(joint.shape), env.action_shape)
            if isinstance(action, Continuous):
                require(joint.dtype == torch.float32, f"a continuous action is {joint.dtype}, not float32")
                require(float(joint.abs().max()) <= 1 + 1e-6, "a continuous action is larger than 1")
            else:
                require(joint.dtype == torch.int64, f"a discrete action is {joint.dtype}, not int64")
                require(int(joint.min()) >= 0 and int(joint.max()) < action.count, "an action is out of range")
                mask = env.action_mask()
                allowed = mask is None or bool(mask.gather(-1, joint.unsqueeze(-1)).all())
                require(allowed, "an action is not among those that the mask allows")
            env.step(joint)
    if env.heuristics:
        first = equal(env.heuristic(), env.heuristic(env.heuristics[0]))
        require(first, "the default heuristic is not the first that the class names")


def episodes_end_when_the_spec_says(subject: Subject) -> None:
    """Truncated at the horizon, and ended before only with `terminates`; `final` where a world may have ended."""
    env = subject.worlds()
    horizon, terminates = env.spec.horizon, env.spec.terminates
    if terminates:
        env = subject.worlds(max(WORLDS, min(_MANY, _ENOUGH // horizon)))
    age = torch.zeros(env.num_seeds, env.num_envs, device=env.device)
    elsewhere = env.reset().state.roll(1, 1)  # the starts of other worlds
    for t in subject.steps(2 * horizon + 3):
        if t == 2 * horizon + 1:  # in mid-episode
            env.reset()
            age.zero_()
        step = env.step(env.random_action())
        age += 1
        require(terminates or not bool(step.terminated.any()), "a world terminated; set 'terminates' in the spec")
        require(not bool((step.terminated & step.truncated).any()), "a world is terminated and truncated at once")
        due = (age == horizon) & ~step.terminated
        cut = step.truncated & due if terminates else step.truncated  # what terminates may be cut before, too
        require(equal(cut, due), "a world is truncated at another step than the horizon")
        may_end = terminates or bool(due.any())
        require((step.final is not None) == may_end, "'final' belongs to the steps in which a world may have ended")
        if step.final is not None:
            same = same_observation(step.final, step.next, (~step.ended,))
            require(same, "'final' differs from 'next' in a world that goes on")
            unlike = not bool(step.ended.any()) or not equal(step.final.state, step.next.state)
            alike = equal(step.next.state[step.ended], elsewhere[step.ended])  # as of a game that has one state
            require(unlike or alike, "the next episode starts where the last ended")
        age[step.ended] = 0


def a_joint_action_of_the_wrong_shape_is_refused(subject: Subject) -> None:
    """A ValueError, before anything has moved."""
    env = subject.worlds()
    env.reset()
    turned = env.random_action().transpose(0, 1)
    require_refusal(env.step, turned, "a joint action of another shape is accepted; compare it with 'action_shape'")


def a_scene_can_be_drawn(subject: Subject) -> None:
    """Finite bodies in a window, other ones in a world of another state."""
    env = subject.worlds()
    require_method(env, "scene", "the task has no picture")
    state = env.reset().state
    first, second = env.scene((0, 0)), env.scene((1, WORLDS - 1))
    if first.picture is not None:  # the environment draws itself
        return
    require(first != second or equal(state[0, 0], state[1, WORLDS - 1]), "two worlds give the same picture")
    require(len(first.bodies) >= env.spec.num_agents, "fewer bodies than agents are drawn")
    x_min, x_max, y_min, y_max = first.window
    require(x_min < x_max and y_min < y_max, f"the window {first.window} is empty")
    places = torch.tensor([(*body.position, body.radius) for body in first.bodies])
    require(bool(places.isfinite().all() and (places[:, 2] > 0).all()), "a body has no finite place or no radius")
