"""What every environment promises, as checks that anybody can run on a task.

    from esp_envs.conformance import PROMISES, Subject, check
    for finding in check(Subject(lambda worlds, seeds: make("navigation", worlds, seeds))):
        print(finding.promise, finding.broken or "holds")

Each promise is one function of a `Subject`. It returns nothing where the promise holds, and raises `Broken` with one
sentence where it does not, `NotAsked` where the task does not offer what the promise is about, or `Unfinished` where
the time for it is over.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from esp_envs.base import Environment, Step
from esp_envs.batched import FURTHER, BatchedTask
from esp_envs.errors import UserError
from esp_envs.installed import last_line, raised_in
from esp_envs.promises import (
    WORLDS,
    Broken,
    NotAsked,
    Subject,
    Unfinished,
    a_joint_action_of_the_wrong_shape_is_refused,
    a_scene_can_be_drawn,
    actions_of_heuristics_and_chance_lie_in_the_action_space,
    episodes_end_when_the_spec_says,
    equal,
    nearly,
    observations_rewards_and_metrics_fit_the_spec,
    parts_of,
    require,
    require_method,
    require_refusal,
    same_observation,
    same_step,
    tensors_of,
)
from esp_envs.spec import Continuous

__all__ = ["PROMISES", "QUICK", "Broken", "Finding", "NotAsked", "Subject", "Unfinished", "check"]


def the_same_seed_gives_the_same_run(subject: Subject) -> None:
    """Two environments of one seed agree bit for bit; one of another seed starts elsewhere, if starts differ at all."""
    first, again, other = (subject.worlds(seeds=(seed,)) for seed in (3, 3, 4))
    start = first.reset()
    require(same_observation(start, again.reset()), "two resets from one seed differ")
    alike = equal(start.state, other.reset().state)
    for _ in subject.steps(first.spec.horizon + 5):
        action = first.random_action()
        require(equal(action, again.random_action()), "random actions of one seed differ")
        require(same_step(first.step(action), again.step(action)), "two runs of one seed and the same actions differ")
    if alike:
        require(equal(first.reset().state, start.state), "another seed gives the same start")
        raise NotAsked("every episode starts alike")


def a_seed_alone_equals_itself_among_others(subject: Subject) -> None:
    """Seed 7 gives the same run alone and among three seeds."""
    alone, among = subject.worlds(seeds=(7,)), subject.worlds(seeds=(3, 7, 11))
    require(equal(alone.reset().obs[0], among.reset().obs[1]), "a seed starts otherwise among others")
    for _ in subject.steps(alone.spec.horizon + 5):
        own, joint = alone.random_action(), among.random_action()
        require(equal(own[0], joint[1]), "a seed draws other random actions among others")
        pairs = zip(tensors_of(alone.step(own)), tensors_of(among.step(joint)), strict=True)
        require(all(equal(x[0], y[1]) for x, y in pairs), "a seed gives another run among others")


def worlds_do_not_touch_each_other(subject: Subject) -> None:
    """Other actions in world 0 change nothing in the other worlds."""
    env, twin = subject.worlds(), subject.worlds()
    env.reset(), twin.reset()
    changed = False
    for _ in subject.steps(env.spec.horizon + 3):
        action = env.random_action()
        twin.random_action()
        different, mask = action.clone(), twin.action_mask()
        if mask is not None:
            different[:, 0] = mask[:, 0].int().argmax(-1)
        elif isinstance(env.spec.action, Continuous):
            different[:, 0] = -action[:, 0]
        else:
            different[:, 0] = (action[:, 0] + 1) % env.spec.action.count
        a, b = env.step(action), twin.step(different)
        require(same_step(a, b, (slice(None), slice(1, None))), "an action in one world changes another world")
        changed |= not same_step(a, b)
    require(changed, "actions change nothing")


def results_are_memory_of_their_own(subject: Subject) -> None:
    """Overwriting a result or an action changes neither the simulation nor another result."""
    env, twin = subject.worlds(), subject.worlds()
    env.reset()
    start = twin.reset()
    start.obs.fill_(7), start.state.fill_(7)
    for _ in subject.steps(env.spec.horizon + 2):
        action = env.random_action()
        before = action.clone()
        step, marred = env.step(action), twin.step(twin.random_action())
        require(equal(action, before), "a step writes into the action")
        require(same_step(step, marred), "overwriting an earlier result changes the simulation")
        copies = [value.clone() for value in tensors_of(step)]
        for value in tensors_of(marred):
            value.fill_(1)
        if env.heuristics:
            env.heuristic()
        intact = all(equal(x, y) for x, y in zip(copies, tensors_of(step), strict=True))
        require(intact, "two results share memory")
    env.step(env.random_action())
    intact = all(equal(x, y) for x, y in zip(copies, tensors_of(step), strict=True))
    require(intact, "a step overwrites the result of the one before")


def a_saved_environment_goes_on_bit_for_bit(subject: Subject) -> None:
    """Restored into worlds of other seeds, a saved state repeats what followed; saving takes a copy."""
    env, other = subject.worlds(), subject.worlds(seeds=(100, 101))
    require_method(env, "state_dict", "a run that is resumed begins new episodes")
    env.reset(), other.reset()
    for _ in subject.steps(env.spec.horizon // 2):
        env.step(env.random_action())
    saved = env.state_dict()
    copies = {name: value.clone() for name, value in saved.items()}
    expected = [env.step(env.random_action()) for _ in subject.steps(env.spec.horizon + 5)]
    intact = all(equal(saved[name], copies[name]) for name in copies)
    require(intact, "what 'state_dict' returned changes when the environment goes on")
    other.load_state_dict(copies)
    for step in expected:
        require(same_step(step, other.step(other.random_action())), "a restored environment goes on otherwise")


def an_environment_of_another_size_is_refused(subject: Subject) -> None:
    """A saved state of other seeds or worlds is answered by a ValueError."""
    env = subject.worlds()
    require_method(env, "state_dict", "a run that is resumed begins new episodes")
    env.reset()
    saved = env.state_dict()
    for other in (subject.worlds(WORLDS + 1), subject.worlds(seeds=(1,))):
        require_refusal(other.load_state_dict, saved, "the saved state of an environment of another size is accepted")


def set_state_reproduces_what_follows(subject: Subject) -> None:
    """A state fixes observations and, where a task has no chance of its own, the next step, whatever came before."""
    env, other, third = subject.worlds(), subject.worlds(seeds=(50, 60)), subject.worlds(seeds=(51, 61))
    require_method(env, "set_state", "the task cannot be put into a state")
    if env.spec.hidden:
        raise NotAsked(f"the state leaves out {' and '.join(env.spec.hidden)}")
    if env.spec.horizon == 1:
        raise NotAsked("an episode is one step")
    observation, _, _ = env.reset(), other.reset(), third.reset()
    for t in range(min(6, env.spec.horizon - 1)):
        _give_another_past((other, third), observation.state)
        again, seen = (parts_of(worlds.set_state(observation.state)) for worlds in (other, third))
        if not nearly(again, seen, subject.rounding):
            raise NotAsked("what is seen has chance of its own")
        same = nearly(again, parts_of(observation), subject.rounding)
        require(same, "the observation after 'set_state' differs from the one that came with the state")
        if subject.align is not None:
            subject.align(env, other, t)
            subject.align(env, third, t)
        action = env.random_action()
        step = env.step(action)
        copy, twin, expected = (_before_a_new_start(made) for made in (other.step(action), third.step(action), step))
        if not nearly(copy, twin, subject.rounding):
            if isinstance(other, BatchedTask):
                _require_no_memory(other, third, observation.state, subject.rounding)
            raise NotAsked("the task has chance of its own")
        require(
            nearly(copy, expected, subject.rounding),
            "the step after 'set_state' differs from the one that the state had; "
            "put into the state what decides it, or name that in 'hidden' of the spec",
        )
        observation = step.next


def _give_another_past(twins: Sequence[Environment], state: Tensor) -> None:
    """Take twins one step from a state by an action of their own, so that they remember another past."""
    for worlds in twins:
        worlds.set_state(state)
    action = twins[0].random_action()
    for worlds in twins:
        worlds.step(action)


def _require_no_memory(env: Environment, twin: Environment, state: Tensor, rounding: float) -> None:
    """Raise `Broken` where worlds of one state and chance part by what they keep beside it, which a step changes."""
    env.set_state(state), twin.set_state(state)
    before = env.state_dict()
    twin.load_state_dict(twin.state_dict() | {"generators": before["generators"]})
    first, second = (worlds.step(worlds.random_action()) for worlds in (env, twin))
    if nearly(_before_a_new_start(first), _before_a_new_start(second), rounding):
        return
    for name, value in env.state_dict().items():
        same = not name.startswith(FURTHER) or equal(value[~first.ended], before[name][~first.ended])
        kept = name.removeprefix(FURTHER)
        require(same, f"the world also keeps '{kept}', which a step changes; put it into the state or into 'hidden'")


def _before_a_new_start(step: Step) -> list[Tensor]:
    """Return the tensors of a step without the starts of episodes after it, which chance draws."""
    return [*parts_of(step.reached), step.reward, *step.metrics.values(), step.terminated, step.truncated]


def set_state_starts_an_episode(subject: Subject) -> None:
    """The clock starts at 0, and a state of another width is refused."""
    env = subject.worlds()
    require_method(env, "set_state", "the task cannot be put into a state")
    observation = env.reset()
    if env.spec.horizon > 1:
        env.step(env.random_action())
    env.set_state(observation.state)
    alive = torch.ones(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
    for t in subject.steps(env.spec.horizon):
        step = env.step(env.random_action())
        alive &= ~step.terminated
        due = alive & (t == env.spec.horizon - 1)
        require(equal(step.truncated & alive, due), "'set_state' does not restart the clock")
        alive &= ~step.truncated
    shorter = observation.state[:, :-1]
    require_refusal(env.set_state, shorter, "a state of another shape is accepted; compare it with 'state_shape'")


PROMISES: tuple[Callable[[Subject], None], ...] = (
    observations_rewards_and_metrics_fit_the_spec,
    actions_of_heuristics_and_chance_lie_in_the_action_space,
    episodes_end_when_the_spec_says,
    the_same_seed_gives_the_same_run,
    a_seed_alone_equals_itself_among_others,
    worlds_do_not_touch_each_other,
    results_are_memory_of_their_own,
    a_saved_environment_goes_on_bit_for_bit,
    an_environment_of_another_size_is_refused,
    a_joint_action_of_the_wrong_shape_is_refused,
    set_state_reproduces_what_follows,
    set_state_starts_an_episode,
    a_scene_can_be_drawn,
)
"""All promises, in the order in which `check` goes through them."""


@dataclass(frozen=True)
class Finding:
    """The result of one promise: `broken`, `not_asked` and `not_covered` are sentences; all are None where it holds."""

    promise: str
    broken: str | None = None
    not_asked: str | None = None
    not_covered: str | None = None


QUICK = (observations_rewards_and_metrics_fit_the_spec, the_same_seed_gives_the_same_run)
"""Promises that a short look at a task can find broken."""


def check(subject: Subject, promises: Sequence[Callable[[Subject], None]] = PROMISES) -> Iterator[Finding]:
    """Check promises in turn, each but the last in half of the time left; where all fail alike, only the first."""
    raised: set[str] = set()
    for promise in promises:
        name = promise.__name__.replace("_", " ")
        until = subject.deadline if promise is promises[-1] else (time.monotonic() + subject.deadline) / 2
        try:
            promise(replace(subject, deadline=until))
        except Unfinished as seen:
            yield Finding(name, not_covered=str(seen))
        except NotAsked as reason:
            yield Finding(name, not_asked=str(reason))
        except Broken as failure:
            yield Finding(name, broken=str(failure))
        except (Exception, SystemExit) as failure:
            place = raised_in(failure)
            said = str(failure) if isinstance(failure, UserError) else last_line(failure)
            said += f", in {place}" if place else ""
            kind = re.sub(r"\d+", "", said)  # whichever copy or agent it is
            again = kind in raised
            raised.add(kind)
            yield Finding(name, not_asked="it fails in the same way") if again else Finding(name, broken=said)
        else:
            yield Finding(name)
