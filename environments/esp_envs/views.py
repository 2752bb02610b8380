"""Other views of the worlds of a task: of one role, with learners of all roles together, and with a compass."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from esp_envs.base import Environment, Observation, Step, generators_for, joined, require_shape
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.spec import Continuous, Field, Items, Kind, TaskSpec, joint_layout, layout

T = TypeVar("T")


def _of_the_worlds(method: str) -> Any:
    """Return a method that hands on to that of the worlds; the frame changes nothing for it."""
    return lambda self, *given, **named: getattr(self.inner, method)(*given, **named)


class RoleView(Environment):
    """The worlds of a task as one role meets them: its agents, what they see, do and get; `turns` steps the worlds."""

    settable, has = map(_of_the_worlds, ("settable", "has"))

    def __init__(self, turns: OthersAtRandom | Lockstep, role: str) -> None:
        self.turns, self.inner = turns, turns.env
        worlds = self.inner.generators
        super().__init__(self.inner.settings, self.inner.num_envs, worlds)
        names = [spec.name for spec in self.inner.spec.roles]
        if role not in names:
            raise UserError(f"{self.inner.spec.name} has no role '{role}'; it has {', '.join(names) or 'none'}")
        self.index, self.heuristics = names.index(role), self.inner.heuristics
        self.generators = generators_for([g.initial_seed() ^ (self.index + 1) for g in worlds], self.device)

    @property
    def spec(self) -> TaskSpec:  # type: ignore[override]  # which an adapter changes where its state becomes another
        return self.inner.spec.roles[self.index]

    def reset(self) -> Observation:
        return self._seen(self.turns.reset(self.index))

    def step(self, action: Tensor) -> Step:
        require_shape("joint action", action, self.action_shape)
        step = self.turns.step(self.index, self.spec.action.admissible(action))
        return Step(
            next=self._seen(step.next),
            reward=step.reward[:, :, self._where].contiguous(),
            terminated=step.terminated.clone(),
            truncated=step.truncated.clone(),
            final=None if step.final is None else self._seen(step.final),
            metrics={name: value.clone() for name, value in step.metrics.items()},
        )

    def set_state(self, state: Tensor) -> Observation:
        return self._seen(self.inner.set_state(state))

    def heuristic(self, name: str | None = None) -> Tensor:
        return self._own(self.inner.heuristic(name))

    def action_mask(self) -> Tensor | None:
        return self.spec.own_mask(self.inner.action_mask(), self._where)

    def state_dict(self) -> dict[str, Tensor]:
        """Return this view's generators; the first role's also says where the worlds stand."""
        worlds = {f"worlds.{k}": v for k, v in self.inner.state_dict().items()} if self.index == 0 else {}
        return super().state_dict() | worlds

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        super().load_state_dict(tensors)
        if self.index == 0:
            self.inner.load_state_dict({k[7:]: v for k, v in tensors.items() if k.startswith("worlds.")})

    @property
    def _where(self) -> slice:
        return self.inner.spec.parts[self.index][1]

    def _own(self, action: Tensor) -> Tensor:
        action = action[:, :, self._where]
        return action[..., : self.action_shape[-1]] if isinstance(self.spec.action, Continuous) else action

    def _seen(self, seen: Observation) -> Observation:
        return Observation(
            seen.obs[:, :, self._where, : self.spec.observation.width].contiguous(),
            seen.state.clone(),
            self.spec.own_mask(seen.action_mask, self._where),
            None if seen.alive is None else seen.alive[:, :, self._where].contiguous(),
        )


class OthersAtRandom:
    """Worlds in which agents of other roles act at random, for checks of one role.

    `image` makes of a random joint action the one that is done, as in a scene that was turned.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env
        self.image: Callable[[Tensor], Tensor] = lambda action: action

    def reset(self, k: int) -> Observation:
        return self.env.reset()

    def step(self, k: int, action: Tensor) -> Step:
        joint = self.image(self.env.random_action())
        joint[:, :, self.env.spec.parts[k][1]] = joined([action, joint[:, :, :0]])
        return self.env.step(joint)


def worlds_of_role(make: MakeWorlds, role: str) -> MakeWorlds:
    """Return what makes the worlds of one role, in which all others act at random."""
    return lambda num_envs, seeds: RoleView(OthersAtRandom(make(num_envs, seeds)), role)


class Lockstep:
    """Worlds that learners of all roles step together, each learner in a thread of its own.

    One of them computes at a time, so nothing depends on which is faster. Worlds step once when all have asked.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env
        self._asked: list[Tensor | str] = ["" for _ in env.spec.roles]
        self._given: Any = None
        self._all = threading.Barrier(len(self._asked), self._advance)
        self._computing = threading.Lock()

    def run(self, jobs: Sequence[Callable[[], T]]) -> list[T]:
        """Run one job for each role until all have ended, and return what they return; the first error ends all."""
        results: dict[int, T] = {}
        errors: list[BaseException] = []

        def work(k: int) -> None:
            with self._computing:
                try:
                    results[k] = jobs[k]()
                    self._wait(k, "the end")
                except BaseException as error:  # whatever it is, the others wait for it
                    errors.append(error)
                    self._all.abort()

        threads = [threading.Thread(target=work, args=(k,), daemon=True) for k in range(len(jobs))]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        except BaseException:  # an interrupt
            self._all.abort()
            raise
        self._all.reset()
        real = [error for error in errors if not isinstance(error, threading.BrokenBarrierError)]
        if errors:
            raise (real or errors)[0]
        return [results[k] for k in range(len(jobs))]

    def reset(self, k: int) -> Observation:
        self._wait(k, "a new episode")
        return self._given

    def step(self, k: int, action: Tensor) -> Step:
        self._wait(k, action)
        return self._given

    def _wait(self, k: int, asked: Tensor | str) -> None:
        self._asked[k] = asked
        self._computing.release()
        try:
            self._all.wait()
        finally:
            self._computing.acquire()

    def _advance(self) -> None:
        """Do what all have asked for."""
        actions = [asked for asked in self._asked if isinstance(asked, Tensor)]
        if len(actions) == len(self._asked):
            self._given = self.env.step(joined(actions))
            return
        words = [asked if isinstance(asked, str) else "a step" for asked in self._asked]
        if len(set(words)) > 1:
            told = ", ".join(f"{role.name} for {w}" for role, w in zip(self.env.spec.roles, words, strict=True))
            raise UserError(f"learners of roles have to step the worlds together, but here they ask: {told}")
        if words[0] == "a new episode":
            self._given = self.env.reset()


class Compass(Environment):
    """A task whose observations and states end with a frame: with it, every problem is exactly symmetric.

    Dynamics and reward may prefer a direction. Written for a scene whose frame is an input, they are a function of
    scene and frame, and turning both changes nothing: f(L_g s, g frame, K_g a) = L_g f(s, frame, a) for every g,
    whatever f is. So a prior that turns the frame too never says anything false. The task itself only shows the frame
    that stands still.

    The frame is the two axes of the plane, as planar vectors: one vector alone is its own image in a mirror. Short
    ones, by `length`, are hard to learn from, so that the symmetry is given up late. Where agents are exchanged,
    `labels` let each see a number that goes with it to its new place.
    """

    has, heuristic, scene, painter = map(_of_the_worlds, ("has", "heuristic", "scene", "painter"))
    action_mask, random_action = map(_of_the_worlds, ("action_mask", "random_action"))
    state_dict, load_state_dict = map(_of_the_worlds, ("state_dict", "load_state_dict"))

    def __init__(self, inner: Environment, length: float, labels: bool = False) -> None:
        super().__init__(inner.settings, inner.num_envs, inner.generators)
        self.inner, self.heuristics, self.ending = inner, inner.heuristics, inner.ending
        spec = inner.spec
        self._joint = spec.is_joint
        self.spec = framed(spec, labels)
        frame = torch.tensor([length, 0.0, 0.0, length], device=self.device)
        label = torch.linspace(-length, length, spec.num_agents, device=self.device) if labels else frame[:0]
        rows = frame.expand(spec.num_agents, -1)
        self._seen = torch.cat([rows, label.unsqueeze(-1)], -1) if labels else rows
        self._stated = torch.cat([frame, label])

    def reset(self) -> Observation:
        return self._framed(self.inner.reset())

    def step(self, action: Tensor) -> Step:
        step = self.inner.step(action)
        final = None if step.final is None else self._framed(step.final)
        return replace(step, next=self._framed(step.next), final=final)

    def set_state(self, state: Tensor) -> Observation:
        own = self.inner.spec
        if self._joint:
            rows = state.unflatten(-1, (own.num_agents, -1))
            return self._framed(self.inner.set_state(rows[..., : own.observation.width].flatten(2)))
        return self._framed(self.inner.set_state(state[..., : own.state.width]))

    def _framed(self, seen: Observation) -> Observation:
        lead = seen.obs.shape[:2]
        obs = torch.cat([seen.obs, self._seen.expand(*lead, -1, -1)], -1)
        state = obs.flatten(2) if self._joint else torch.cat([seen.state, self._stated.expand(*lead, -1)], -1)
        return replace(seen, obs=obs, state=state)


def framed(spec: TaskSpec, labels: bool = False) -> TaskSpec:
    """Return the spec of a task with its frame; arguments as of `Compass`."""
    frame = Field("compass", Kind.VECTOR, 2)
    own = (Field("label", Kind.SCALAR),) if labels else ()
    each = (Field("labels", Kind.SCALAR, spec.num_agents, items=Items.AGENTS),) if labels else ()
    observation = layout(*spec.observation.fields, frame, *own)
    if spec.is_joint:
        return replace(spec, observation=observation, state=joint_layout(observation, spec.num_agents))
    return replace(spec, observation=observation, state=layout(*spec.state.fields, frame, *each))
