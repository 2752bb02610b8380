"""The one contract of all environments: a batch of worlds, S seeds times E worlds each.

Every seed owns one random generator, so seed k sees the same episodes alone and among ten. Worlds never
influence each other. Everything is a tensor on one device; nothing here synchronises with a GPU.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import pad

from esp_envs.errors import UserError
from esp_envs.scene import Painter, Scene
from esp_envs.settings import TaskSettings
from esp_envs.spec import Continuous, TaskSpec


@dataclass(frozen=True)
class Observation:
    """What the agents and the critic see.

    Shape:
        obs: [S, E, N, D] float32; a fresh tensor, never a view of the simulator's buffers.
        state: [S, E, state width] float32.
        action_mask: [S, E, N, A] bool, which actions each agent may take; None where `spec.masks` is off.
        alive: [S, E, N] bool, which agents still act; None where `spec.agents_end` is off. An agent that has ended
            stays so until the episode is over. Its action is ignored, and its reward is 0 unless the reward is shared.
    """

    obs: Tensor
    state: Tensor
    action_mask: Tensor | None = None
    alive: Tensor | None = None


@dataclass(frozen=True)
class Step:
    """The result of one step of all worlds, after automatic reset of those that ended.

    Attributes:
        next: the observation to act on next (of the new episode where one has just begun).
        reward: [S, E, N] float32.
        terminated: [S, E] bool; the episode reached an end of its own: no value lies beyond.
        truncated: [S, E] bool; the horizon cut the episode: bootstrap from `final`.
        final: the last observation of the episodes that ended in this step (elsewhere equal to `next`), or None
            where no world can have ended; known without looking at the device.
        metrics: task measures of this step, each [S, E] float32; an evaluation averages them over an episode, or
            adds up those that `spec.totals` names.
    """

    next: Observation
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    final: Observation | None
    metrics: dict[str, Tensor]

    @property
    def ended(self) -> Tensor:
        """Which episodes ended in this step, [S, E] bool."""
        return self.terminated | self.truncated

    @property
    def reached(self) -> Observation:
        """What the step led to, before any reset."""
        return self.next if self.final is None else self.final


def random_choice(allowed: Tensor, number: Tensor) -> Tensor:
    """Return an action that a row of `allowed` [..., A] allows (one that allows none, all), by numbers in [0, 1)."""
    allowed = allowed | ~allowed.any(-1, keepdim=True)
    count = allowed.sum(-1)
    place = (number * count).long().minimum(count - 1)
    return (allowed.cumsum(-1) <= place.unsqueeze(-1)).sum(-1)


def joined(parts: Sequence[Tensor]) -> Tensor:
    """Return as one tensor what agents of all roles see or do: integers [..., agents], or rows padded to the widest."""
    if len(parts) == 1:
        return parts[0]
    if not parts[0].is_floating_point():
        return torch.cat([*parts], -1)
    width = max(part.shape[-1] for part in parts)
    return torch.cat([pad(part, (0, width - part.shape[-1])) for part in parts], -2)


def require_shape(what: str, tensor: Tensor, expected: tuple[int, ...], dtype: torch.dtype | None = None) -> None:
    """Raise a UserError for a tensor of another shape, or of another type where one is given."""
    if tuple(tensor.shape) != expected:
        raise UserError(f"the {what} has shape {tuple(tensor.shape)}, expected {expected}")
    if dtype is not None and tensor.dtype != dtype:
        raise UserError(f"the {what} is {tensor.dtype}, expected {dtype}")


OTHER_SIZE = "the saved environment has other seeds, worlds or bodies than this one; use its settings"


def generators_for(seeds: Sequence[int], device: torch.device | str = "cpu") -> list[torch.Generator]:
    """Return one generator per seed, on the CPU-or-GPU `device`."""
    return [torch.Generator(device=device).manual_seed(int(seed)) for seed in seeds]


def generator_states(generators: Sequence[torch.Generator]) -> Tensor:
    """Return the states of several generators, one row of bytes each."""
    return torch.stack([generator.get_state() for generator in generators])


def restore_generators(generators: Sequence[torch.Generator], states: Tensor) -> None:
    """Put generators into the states that `generator_states` returned; a UserError refuses another number of them."""
    if len(states) != len(generators):
        raise UserError(f"{len(states)} generator states are given for {len(generators)} generators")
    for generator, state in zip(generators, states, strict=True):
        # A copy: torch 2.13 reads a row of a larger tensor at the wrong place, and crashes.
        generator.set_state(state.cpu().clone())


def put_back(env: Environment, observation: Observation) -> None:
    """Put worlds back to the last observation of their episodes, for a picture; draws no random numbers."""
    states = generator_states(env.generators)
    env.set_state(observation.state)
    restore_generators(env.generators, states)


BLIND = "blind"
"""Name of a heuristic that sees nothing of what a task is about; no verdict compares two policies below it."""


class Environment(ABC):
    """A batch of worlds of one task.

    A subclass names its settings model, builds `spec` from settings in its constructor and implements the abstract
    methods. `set_state`, `heuristic`, `scene` and `state_dict` are optional: a task without them is trained and
    evaluated like any other. Its class docstring is the environment card.
    """

    Settings: ClassVar[type[TaskSettings]] = TaskSettings
    spec: TaskSpec
    heuristics: tuple[str, ...] = ()
    """Names that `heuristic` accepts, the main anchor first; an environment may have fewer than its class."""
    ending: str = "before its time"
    """What has come where an episode is terminated, for a film's last frame."""
    renews: bool = True
    """Whether worlds whose episode ends begin the next one. Who sets each state may do without where that takes long;
    `next` then holds what was reached. An environment may ignore it."""
    measures: bool = True
    """Whether steps give metrics. Learners read none and do without; an environment may ignore it."""
    robot: ClassVar[Mapping[str, float]] = {}
    """Dimensions of the e-puck that a policy of this task can drive, by name with unit; empty for other tasks."""

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        if num_envs < 1 or not generators:
            raise UserError("an environment needs at least one world and one seed")
        if not isinstance(self.heuristics, tuple) or not all(isinstance(name, str) for name in self.heuristics):
            raise UserError(
                f"{type(self).__name__}.heuristics is {self.heuristics!r}; give a tuple of names, as ('nearest',)"
            )
        self.settings = settings
        self.num_envs = num_envs
        self.generators = list(generators)
        self.device = self.generators[0].device

    @property
    def num_seeds(self) -> int:
        """S, the number of seeds."""
        return len(self.generators)

    @abstractmethod
    def reset(self) -> Observation:
        """Start a new episode in every world."""

    @abstractmethod
    def step(self, action: Tensor) -> Step:
        """Advance every world by one step.

        Args:
            action: [S, E, N] int64 for a discrete action space, else [S, E, N, width] float32.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs of the worlds.

        Here these are the generators alone: a run goes on with new episodes. A task that overrides this and
        `load_state_dict` goes on bit for bit.
        """
        return {"generators": generator_states(self.generators)}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            UserError: the tensors belong to an environment of another size.
        """
        if len(tensors["generators"]) != self.num_seeds:
            raise UserError(OTHER_SIZE)
        restore_generators(self.generators, tensors["generators"])

    def set_state(self, state: Tensor) -> Observation:
        """Put every world into a global state (as laid out by `spec.state`) at the start of an episode.

        What chance decides in the episode is what the last `reset` drew, so there has to be one before.

        Args:
            state: [S, E, state width]; it fixes the physics completely, up to the task's own noise.

        Raises:
            UserError: the task cannot be put into a state.
        """
        raise UserError(f"task {self.spec.name} cannot be put into a state; its class has no 'set_state'")

    def heuristic(self, name: str | None = None) -> Tensor:
        """Return the joint action of a hand-written policy in the present state (shape as for `step`).

        Args:
            name: one of `heuristics`; the first by default.

        Raises:
            UserError: the task has no such policy.
        """
        raise UserError(f"task {self.spec.name} has no hand-written policy; its class has no 'heuristic'")

    def named_heuristic(self, name: str | None) -> str:
        """Return a heuristic's name with its default filled in; a UserError refuses unknown ones."""
        name = name or self.heuristics[0]
        if name == "greedy" and self.heuristics[0] in ("nearest", "chase"):  # which scripts and files of 0.1 call so
            name = self.heuristics[0]
        if name not in self.heuristics:
            raise UserError(f"{self.spec.name} has no heuristic '{name}'; it has {', '.join(self.heuristics)}")
        return name

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        """Return what there is to draw of one world (seed index, world index).

        Raises:
            UserError: the task cannot be drawn.
        """
        raise UserError(f"task {self.spec.name} cannot be drawn; its class has no 'scene'")

    def settable(self) -> bool:
        """Return whether worlds can be put into states; an adapter then shows its simulator's state from here on."""
        return self.has("set_state")

    def has(self, method: str) -> bool:
        """Return whether the task offers an optional method: `set_state`, `heuristic`, `scene` or `state_dict`."""
        return getattr(type(self), method) is not getattr(Environment, method)

    def painter(self, size: int) -> AbstractContextManager[Painter] | None:
        """Return a view of this task's own, pictures `size` pixels wide, or None where it has none.

        Opening it raises a UserError where this machine cannot draw it.
        """
        return None

    @property
    def action_shape(self) -> tuple[int, ...]:
        """Shape of a joint action: [S, E, N], and the width of a continuous one."""
        lead = (self.num_seeds, self.num_envs, self.spec.num_agents)
        return (*lead, self.spec.action.width) if isinstance(self.spec.action, Continuous) else lead

    @property
    def state_shape(self) -> tuple[int, ...]:
        """Shape of the global states: [S, E, state width]."""
        return self.num_seeds, self.num_envs, self.spec.state.width

    def action_mask(self) -> Tensor | None:
        """Return which actions each agent may take now, [S, E, N, A] bool; None where `spec.masks` is off."""
        return None

    def random_action(self) -> Tensor:
        """Return a random joint action, drawn from each seed's own generator.

        Allowed discrete actions are equally likely. Numbers of a continuous action are uniform in [-1, 1]. So a vector
        is uniform in a square, not in the disc: it prefers diagonals, and the task scales back what is longer than 1.
        """
        mask = self.action_mask()
        return joined([_drawn(self, role, role.own_mask(mask, where)) for role, where in self.spec.parts])


def _drawn(env: Environment, spec: TaskSpec, mask: Tensor | None) -> Tensor:
    """Draw actions of all agents of a role [S, E, N] or [S, E, N, width]."""
    action = spec.action
    shape = (env.num_envs, spec.num_agents, *([action.width] if isinstance(action, Continuous) else []))

    def draw(generator: torch.Generator) -> Tensor:
        if mask is None and not isinstance(action, Continuous):
            return torch.randint(action.count, shape, generator=generator, device=env.device)
        return torch.rand(shape, generator=generator, device=env.device)

    drawn = torch.stack([draw(generator) for generator in env.generators])
    if mask is not None:
        return random_choice(mask, drawn)
    return drawn * 2 - 1 if isinstance(action, Continuous) else drawn
