"""Tasks whose worlds begin and end their episodes together: the clock is one integer, and no device is ever asked.

`LockstepTask` keeps what all such tasks share. `BatchedTask` derives everything else from three methods, for a task
whose world is a few named tensors:

    class Rendezvous(BatchedTask):
        def _describe(self) -> TaskSpec: ...                    # from self.settings
        def _start(self, generator) -> World: ...               # the worlds of one seed
        def _advance(self, world, action) -> Outcome: ...       # reward and metrics; writes the new world
        def _observe(self, world) -> Tensor: ...                # [S, E, N, D]
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from esp_envs.base import (
    OTHER_SIZE,
    Environment,
    Observation,
    Step,
    TaskSettings,
    generator_states,
    require_flags,
    require_shape,
    restore_generators,
)
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, TaskSpec

World = dict[str, Tensor]
"""The tensors of all worlds by the name of their field in `spec.state`: [S, E, items, numbers of an item]."""
Outcome = tuple[Tensor, dict[str, Tensor]]
"""The reward [S, E, N] of a step and its metrics [S, E]."""


class LockstepTask(Environment):
    """A batch of worlds that all begin and end an episode in the same step, after `spec.horizon` steps."""

    _time = 0

    @abstractmethod
    def _begin(self) -> None:
        """Draw a new episode for every world."""

    @abstractmethod
    def _play(self, action: Tensor) -> Outcome:
        """Advance every world by one step; the action has the right shape."""

    @abstractmethod
    def _seen(self) -> Observation:
        """Return what the agents and the critic see now, as tensors of their own."""

    @abstractmethod
    def _put(self, state: Tensor) -> None:
        """Write a global state [S, E, state width] into the worlds."""

    def reset(self) -> Observation:
        """Start a new episode in every world."""
        self._time = 0
        self._begin()
        return self._seen()

    def step(self, action: Tensor) -> Step:
        """Advance every world by one step.

        Raises:
            UserError: the action has another shape than [S, E, N] (discrete) or [S, E, N, width] (continuous).
        """
        require_shape("joint action", action, self.action_shape)
        reward, metrics = self._play(action)
        self._time += 1
        following, final = self._seen(), None
        ended = self._time == self.spec.horizon
        if ended:
            final, following = following, self.reset()
        shape = (self.num_seeds, self.num_envs)
        return Step(
            next=following,
            reward=reward,
            terminated=torch.zeros(shape, dtype=torch.bool, device=self.device),
            truncated=torch.full(shape, ended, dtype=torch.bool, device=self.device),
            final=final,
            metrics=metrics,
        )

    def set_state(self, state: Tensor) -> Observation:
        """Put every world into a global state at the start of an episode.

        Raises:
            UserError: the state has another shape than [S, E, state width].
        """
        require_shape("state", state, self.state_shape)
        self._time = 0
        self._put(state)
        return self._seen()


class BatchedTask(LockstepTask):
    """A task whose world is one tensor for each field of its state.

    A subclass implements `_describe`, `_start`, `_advance` and `_observe`, and may add `_allow`, `_living`, `heuristic`
    and `scene`. All randomness comes from `draw` or from the generator that `_start` is given. Vectors of a continuous
    action arrive in `_advance` with a length of at most 1, its other numbers in [-1, 1].
    """

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        self.spec = self._describe()
        if not isinstance(self.spec, TaskSpec):
            raise UserError(f"'_describe' of {type(self).__name__} returns {self.spec!r}; return a TaskSpec")
        if self.spec.terminates:
            raise UserError(
                f"{self.spec.name}: all episodes of a BatchedTask last 'horizon' steps; leave 'terminates' out, or "
                "derive from Environment"
            )
        self.world: World = self._split(torch.zeros(self.state_shape, device=self.device))
        self._unproven = self.spec.horizon  # steps in which shared rewards are still looked at

    @abstractmethod
    def _describe(self) -> TaskSpec:
        """Return the spec that follows from `self.settings`."""

    @abstractmethod
    def _start(self, generator: torch.Generator) -> World:
        """Draw an episode for the E worlds of one seed: for each field of the state [E, items, item width]."""

    @abstractmethod
    def _advance(self, world: World, action: Tensor) -> Outcome:
        """Write the next step's tensors into `world`; return reward and metrics [S, E].

        A reward may be [S, E, N]; where agents have rewards of their own, switch `shared_reward` off in the spec.
        """

    @abstractmethod
    def _observe(self, world: World) -> Tensor:
        """Return each agent's observation [S, E, N, D] as the layout says; any trailing axes are flattened."""

    def _allow(self, world: World) -> Tensor | None:
        """Return which actions each agent may take, [S, E, N, A] bool, where `spec.masks` is on."""
        return None

    def _living(self, world: World) -> Tensor | None:
        """Return which agents still act, [S, E, N] bool, where `spec.agents_end` is on."""
        return None

    def action_mask(self) -> Tensor | None:
        """Return which actions each agent may take now."""
        mask = self._allow(self.world)
        if (mask is not None) != self.spec.masks:
            raise UserError(f"{self.spec.name}: implement '_allow' and set 'masks' in the spec, or do neither")
        if mask is None:
            return None
        assert isinstance(self.spec.action, Discrete), "masks are for discrete actions"
        require_flags("action mask", mask, (*self.action_shape[:3], self.spec.action.count))
        return mask.contiguous().clone()

    def draw(self, *shape: int, generator: torch.Generator | None = None) -> Tensor:
        """Return numbers uniform in [-1, 1]: [E, *shape] from one generator, else [S, E, *shape] from each seed's."""
        own = self.generators if generator is None else [generator]
        drawn = [torch.rand(self.num_envs, *shape, generator=g, device=self.device) * 2 - 1 for g in own]
        return torch.stack(drawn) if generator is None else drawn[0]

    def state_dict(self) -> dict[str, Tensor]:
        """Return the world, the clock and the generators."""
        return {
            "world": self._state(),
            "time": torch.tensor(self._time),
            "generators": generator_states(self.generators),
        }

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            UserError: the tensors belong to an environment of another size.
        """
        if tensors["world"].shape != self.state_shape or len(tensors["generators"]) != self.num_seeds:
            raise UserError(OTHER_SIZE)
        self._put(tensors["world"].to(self.device))
        self._time = int(tensors["time"])
        restore_generators(self.generators, tensors["generators"])

    def _begin(self) -> None:
        drawn = [self._named("_start", self._start(generator)) for generator in self.generators]
        self.world = {name: torch.stack([one[name] for one in drawn]) for name in drawn[0]}
        for field in self.spec.state.fields:
            found = self.world.get(field.name)
            expected = (self.num_seeds, self.num_envs, field.count, field.item_width)
            if found is None or tuple(found.shape) != expected:
                got = "is missing" if found is None else f"has shape {tuple(found.shape[1:])}"
                raise UserError(f"'{field.name}' {got} in what '_start' of {self.spec.name} drew; give {expected[1:]}")

    def _play(self, action: Tensor) -> Outcome:
        outcome: object = self._advance(self.world, self.spec.action.admissible(action))
        if not isinstance(outcome, tuple) or len(outcome) != 2 or not isinstance(outcome[0], Tensor):
            raise UserError(
                f"'_advance' of {self.spec.name} gives {type(outcome).__name__}; return a tensor of rewards and a dict "
                "of metrics, as 'return reward, {}'"
            )
        reward, metrics = outcome[0], self._named("_advance", outcome[1])
        shared = reward.dim() == 2
        if shared:
            reward = reward.unsqueeze(-1).expand(-1, -1, self.spec.num_agents)
        require_shape(f"reward that '_advance' of {self.spec.name} gives", reward, self.action_shape[:3])
        if self._unproven and self.spec.shared_reward and not shared:  # not for ever: a GPU is waited for
            self._unproven -= 1
            if bool((reward != reward[..., :1]).any()):
                raise UserError(
                    f"agents of {self.spec.name} get different rewards, but its spec says that they share them; return "
                    "one reward [S, E], or set shared_reward=False in the spec"
                )
        for name, value in metrics.items():
            require_shape(f"metric {name} that '_advance' of {self.spec.name} gives", value, self.action_shape[:2])
        metrics = {name: value.float().contiguous().clone() for name, value in metrics.items()}
        return reward.float().contiguous().clone(), metrics

    def _seen(self) -> Observation:
        seen: object = self._observe(self.world)
        if not isinstance(seen, Tensor):
            raise UserError(f"'_observe' of {self.spec.name} gives {type(seen).__name__}; return a tensor [S, E, N, D]")
        obs = seen.flatten(3).float().clone(memory_format=torch.contiguous_format)
        width = self.spec.observation.width
        require_shape(f"observation that '_observe' of {self.spec.name} gives", obs, (*self.action_shape[:3], width))
        alive = self._living(self.world)
        if (alive is not None) != self.spec.agents_end:
            raise UserError(f"{self.spec.name}: implement '_living' and set 'agents_end' in the spec, or do neither")
        if alive is not None:
            require_flags("tensor of '_living'", alive, self.action_shape[:3])
        return Observation(obs, self._state(), self.action_mask(), None if alive is None else alive.clone())

    def _named(self, method: str, named: object) -> Mapping[str, Tensor]:
        """Refuse what a method of a subclass gives instead of tensors by name."""
        if not isinstance(named, Mapping):
            raise UserError(
                f"'{method}' of {self.spec.name} gives {type(named).__name__}; give a dict of tensors by name"
            )
        for name, value in named.items():
            if not isinstance(value, Tensor):
                raise UserError(f"'{name}' of what '{method}' of {self.spec.name} gives is no tensor; give tensors")
        return named

    def _put(self, state: Tensor) -> None:
        self.world = self._split(state.clone())

    def _state(self) -> Tensor:
        return torch.cat([self.world[field.name].flatten(2) for field in self.spec.state.fields], -1)

    def _split(self, state: Tensor) -> World:
        parts = state.split([field.width for field in self.spec.state.fields], -1)
        fields = self.spec.state.fields
        return {f.name: part.unflatten(-1, (f.count, f.item_width)) for f, part in zip(fields, parts, strict=True)}


def to_others(position: Tensor) -> Tensor:
    """Return where each agent sees each other agent, in index order: [..., N, N - 1, w] from positions [..., N, w]."""
    index = torch.arange(position.shape[-2], device=position.device)
    others = index[:-1] + (index[:-1] >= index.unsqueeze(-1))
    return position[..., others, :] - position.unsqueeze(-2)
