"""Each role's view of the worlds of a task, and how learners of all roles step them together."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from torch import Tensor

from esp_envs.base import Environment, Observation, Step, generators_for, joined, require_shape
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.spec import Continuous, TaskSpec

T = TypeVar("T")


class Turns(Protocol):
    """Steps the worlds with what all roles do."""

    env: Environment

    def reset(self, k: int) -> Observation:
        """Start a new episode in every world; asked for by role k."""

    def step(self, k: int, action: Tensor) -> Step:
        """Advance every world by one step, in which role k acts so [S, E, N(, width)]."""


class RoleView(Environment):
    """The worlds of a task as one role meets them: its agents, what they see, do and get.

    Args:
        turns: steps the worlds.
        role: its name.

    Example:
        prey = RoleView(OthersAtRandom(make("tag:Tag", 8, (0,))), "prey")
    """

    def __init__(self, turns: Turns, role: str) -> None:
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

    def settable(self) -> bool:
        return self.inner.settable()

    def has(self, method: str) -> bool:
        return self.inner.has(method)

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
    """Worlds in which the agents of all other roles act at random, for checks of one role.

    Attributes:
        image: what makes of a random joint action the one that is done, as in a scene that was turned.
    """

    def __init__(self, env: Environment) -> None:
        self.env = env
        self.image: Callable[[Tensor], Tensor] = lambda action: action

    def reset(self, k: int) -> Observation:
        return self.env.reset()

    def step(self, k: int, action: Tensor) -> Step:
        joint = self.image(self.env.random_action())
        where = self.env.spec.parts[k][1]
        joint[:, :, where] = joined([action, joint[:, :, :0]])
        return self.env.step(joint)


def worlds_of_role(make: MakeWorlds, role: str) -> MakeWorlds:
    """Return what makes the worlds of one role, in which all others act at random."""
    return lambda num_envs, seeds: RoleView(OthersAtRandom(make(num_envs, seeds)), role)


class Lockstep:
    """Worlds that learners of all roles step together, each learner in a thread of its own.

    One of them computes at a time, so nothing depends on which is faster. A learner that asks for a step or a new
    episode waits until all have; then the worlds step once.
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
