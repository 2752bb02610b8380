"""The base of tasks whose worlds are a few named tensors, of yours and of this package."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch
from torch import Tensor

from esp_envs.base import OTHER_SIZE, Environment, Observation, Step, require_shape
from esp_envs.errors import UserError
from esp_envs.settings import TaskSettings
from esp_envs.spec import Discrete, TaskSpec

World = dict[str, Tensor]  # all worlds' tensors by field of `spec.state`: [S, E, items, numbers of an item]
Outcome = tuple[Tensor, dict[str, Tensor]]  # the reward [S, E] or [S, E, N] of a step and its metrics [S, E]
FURTHER = "world."  # what the names of saved tensors begin with that are no fields of the state


class BatchedTask(Environment):
    """A batch of worlds that are one tensor for each field of their state.

    A subclass implements `_describe`, `_start`, `_advance` and `_observe`. It may add `_ended`, `_allow`, `_living`,
    `heuristic` and `scene`. All randomness comes from `draw` or from the generator that `_start` is given. Vectors of a
    continuous action arrive in `_advance` with a length of at most 1, its other numbers in [-1, 1].

    All worlds begin together. Without `terminates` in the spec they also end together, after `horizon` steps; the clock
    is one integer then, and a GPU is never waited for. With `terminates`, `_ended` says which end earlier, and each
    begins anew for itself. Its start is drawn in every step, so that no world's chance depends on when others end.

    Attributes:
        world: what `_start` drew and `_advance` wrote. `_start` may draw further tensors beside the fields of the
            state, such as chance for a whole episode; they are saved too, and `set_state` leaves them alone.

    Example:
        class Rendezvous(BatchedTask):
            def _describe(self): return TaskSpec(name="rendezvous", horizon=25, ...)
            def _start(self, generator): return {"position": self.draw(3, 2, generator=generator)}
            def _advance(self, world, action):
                world["position"] = world["position"] + 0.1 * action
                return -world["position"].norm(dim=-1).mean(-1), {}
            def _observe(self, world): return to_others(world["position"])
    """

    makes_new_tensors: ClassVar[bool] = False
    """Whether `_start`, `_advance` and `_observe` return new memory in each call, which then need not be copied."""

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        self.spec = self._describe()
        if not isinstance(self.spec, TaskSpec):
            raise UserError(f"'_describe' of {type(self).__name__} returns {self.spec!r}; return a TaskSpec")
        self.world: World = self._split(torch.zeros(self.state_shape, device=self.device))
        self._time = 0  # since the last reset, modulo the horizon
        self._worlds_shape = (self.num_seeds, num_envs)
        self._agents_shape = (*self._worlds_shape, self.spec.num_agents)
        self._episode_time = torch.zeros(
            self._worlds_shape, dtype=torch.int64, device=self.device
        )  # where worlds end apart
        self._lost = set(self.spec.totals)  # names that no step's metrics had yet
        self._unproven = self.spec.horizon  # steps in which all that a subclass gives is still looked at

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

    def _ended(self, world: World) -> Tensor | None:
        """Return which episodes are over after a step, [S, E] bool, where `spec.terminates` is on."""
        return None

    def _allow(self, world: World) -> Tensor | None:
        """Return which actions each agent may take, [S, E, N, A] bool, where `spec.masks` is on."""
        return None

    def _living(self, world: World) -> Tensor | None:
        """Return which agents still act, [S, E, N] bool, where `spec.agents_end` is on."""
        return None

    def draw(self, *shape: int, generator: torch.Generator | None = None) -> Tensor:
        """Return numbers uniform in [-1, 1]: [E, *shape] from one generator, else [S, E, *shape] from each seed's."""
        own = self.generators if generator is None else [generator]
        drawn = [torch.rand(self.num_envs, *shape, generator=g, device=self.device) * 2 - 1 for g in own]
        return torch.stack(drawn) if generator is None else drawn[0]

    def reset(self) -> Observation:
        self._time, self._episode_time = 0, torch.zeros_like(self._episode_time)
        self._begin_with(self._episodes())
        return self._seen()

    def step(self, action: Tensor) -> Step:
        require_shape("joint action", action, self.action_shape)
        reward, metrics = self._play(action)
        reached, horizon = self._seen(), self.spec.horizon
        terminated = self._switched("_ended", "terminates", self._worlds_shape)
        self._unproven = max(self._unproven - 1, 0)
        if terminated is not None:
            self._episode_time += 1
            truncated = (self._episode_time == horizon) & ~terminated
            self._renew(terminated | truncated)
            self._time = (self._time + 1) % horizon
            return Step(self._seen(), reward, terminated, truncated, reached, metrics)
        self._time += 1
        ended = self._time == horizon
        following, final = (self.reset(), reached) if ended else (reached, None)
        terminated = torch.zeros(self._worlds_shape, dtype=torch.bool, device=self.device)
        truncated = torch.full(self._worlds_shape, ended, dtype=torch.bool, device=self.device)
        return Step(following, reward, terminated, truncated, final, metrics)

    def set_state(self, state: Tensor) -> Observation:
        require_shape("state", state, self.state_shape)
        self._time, self._episode_time = 0, torch.zeros_like(self._episode_time)
        self._put(state)
        return self._seen()

    def state_dict(self) -> dict[str, Tensor]:
        """Return what decides what follows: the worlds, the clock and the generators."""
        memory = self._to_save().items()
        saved = {name: value.clone(memory_format=torch.contiguous_format) for name, value in memory}
        time = torch.tensor(self._time)
        clock = {"time": self._episode_time.clone(), "clock": time} if self.spec.terminates else {"time": time}
        return saved | clock | super().state_dict()

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        shapes = {name: tensor.shape for name, tensor in tensors.items()}
        own = {name: value.shape for name, value in self.state_dict().items()}
        if any(shapes.get(name) != shape for name, shape in own.items() if not name.startswith(FURTHER)):
            raise UserError(OTHER_SIZE)
        super().load_state_dict(tensors)
        self._take_back({name: tensor.to(self.device) for name, tensor in tensors.items()})
        self._time = int(tensors["clock" if self.spec.terminates else "time"])
        if self.spec.terminates:
            self._episode_time = tensors["time"].to(self.device).clone()

    def action_mask(self) -> Tensor | None:
        choices = self.spec.action.count if isinstance(self.spec.action, Discrete) else 0
        return self._switched("_allow", "masks", (*self._agents_shape, choices))

    def _episodes(self) -> World:
        """Draw an episode for every world."""
        drawn = [self._named("_start", self._start(generator)) for generator in self.generators]
        if self.makes_new_tensors and len(drawn) == 1:
            return {name: value.unsqueeze(0) for name, value in drawn[0].items()}
        return {name: torch.stack([one[name] for one in drawn]) for name in drawn[0]}

    def _begin_with(self, drawn: World) -> None:
        """Take the tensors with which episodes begin in all worlds."""
        for field in self.spec.state.fields:
            found = drawn.get(field.name)
            expected = (*self._worlds_shape, field.count, field.item_width)
            if found is None or tuple(found.shape) != expected:
                got = "is missing" if found is None else f"has shape {tuple(found.shape[1:])}"
                raise UserError(f"'{field.name}' {got} in what '_start' of {self.spec.name} drew; give {expected[1:]}")
            if found.dtype != torch.float32:  # as states are, which worlds are put back into
                raise UserError(
                    f"'{field.name}' of what '_start' of {self.spec.name} drew is {found.dtype}; give torch.float32"
                )
        self.world = drawn

    def _next_episodes(self) -> World:
        """Return the tensors with which worlds begin anew that end in this step."""
        return self._episodes()

    def _renew(self, ended: Tensor) -> None:
        fresh = self._next_episodes()
        for name, value in fresh.items():
            over = ended.view(*ended.shape, *(1,) * (value.dim() - 2))
            self.world[name] = torch.where(over, value, self.world[name])
        self._episode_time = self._episode_time.masked_fill(ended, 0)

    def _play(self, action: Tensor) -> Outcome:
        """Advance every world; return reward [S, E, N] and metrics, as float32 memory of their own."""
        known = {*self.world}
        outcome: object = self._advance(self.world, self.spec.admissible(action))
        if added := self.world.keys() - known:
            raise UserError(
                f"'_advance' of {self.spec.name} adds '{min(added)}' to the world, which '_start' did not draw; let "
                "'_start' draw its first value, with which episodes begin"
            )
        if not isinstance(outcome, tuple) or len(outcome) != 2 or not isinstance(outcome[0], Tensor):
            raise UserError(
                f"'_advance' of {self.spec.name} gives {type(outcome).__name__}; return a tensor of rewards and a dict "
                "of metrics, as 'return reward, {}'"
            )
        reward, metrics = outcome[0], self._named("_advance", outcome[1]) if self.measures else {}
        shared = reward.dim() == 2
        if shared:
            reward = reward.unsqueeze(-1).expand(-1, -1, self.spec.num_agents)
        if reward.shape != self._agents_shape:
            require_shape(f"reward that '_advance' of {self.spec.name} gives", reward, self._agents_shape)
        asked = self._unproven and self.spec.shared_reward and not shared  # not for ever: a GPU is waited for
        if asked and bool((reward != reward[..., :1]).any()):
            raise UserError(
                f"agents of {self.spec.name} get different rewards, but its spec says that they share them; return "
                "one reward [S, E], or set shared_reward=False in the spec"
            )
        for name, value in metrics.items():
            if value.shape != self._worlds_shape:  # first, since the sentence takes time
                require_shape(f"metric {name} that '_advance' of {self.spec.name} gives", value, self._worlds_shape)
        if self._lost and self.measures:
            self._lost -= metrics.keys()
            if self._lost and self._unproven == 1:
                told = ", ".join(metrics) or "no metric"
                raise UserError(
                    f"'_advance' of {self.spec.name} gives no metric '{min(self._lost)}' in a whole episode, but "
                    f"'totals' of its spec names it; it gives {told}"
                )
        is_new = self.makes_new_tensors
        return _owned(reward, is_new), {name: _owned(value, is_new) for name, value in metrics.items()}

    def _seen(self) -> Observation:
        """Return what the agents and the critic see now, as memory of its own."""
        seen: object = self._observe(self.world)
        if not isinstance(seen, Tensor):
            raise UserError(f"'_observe' of {self.spec.name} gives {type(seen).__name__}; return a tensor [S, E, N, D]")
        obs = _owned(seen.flatten(3), self.makes_new_tensors)
        shape = (*self._agents_shape, self.spec.observation.width)
        if obs.shape != shape:
            require_shape(f"observation that '_observe' of {self.spec.name} gives", obs, shape)
        alive = self._switched("_living", "agents_end", self._agents_shape)
        return Observation(obs, self._state(), self.action_mask(), alive)

    def _switched(self, method: str, switch: str, shape: tuple[int, ...]) -> Tensor | None:
        """Return a copy of what an optional method says of the worlds, where the spec has its switch on."""
        if not (self._unproven or getattr(self.spec, switch)):
            return None
        flags: Tensor | None = getattr(self, method)(self.world)
        if (flags is not None) != getattr(self.spec, switch):
            raise UserError(f"{self.spec.name}: implement '{method}' and set '{switch}' in the spec, or do neither")
        if flags is None:
            return None
        require_shape(f"tensor of '{method}'", flags, shape, torch.bool)
        return flags.contiguous().clone()

    def _named(self, method: str, named: object) -> Mapping[str, Tensor]:
        if not isinstance(named, Mapping):
            raise UserError(
                f"'{method}' of {self.spec.name} gives {type(named).__name__}; give a dict of tensors by name"
            )
        for name, value in named.items():
            if not isinstance(value, Tensor):
                raise UserError(f"'{name}' of what '{method}' of {self.spec.name} gives is no tensor; give tensors")
        return named

    def _to_save(self) -> dict[str, Tensor]:
        """Return the tensors that decide what follows, by the names under which they are saved."""
        fields = self.spec.state.slices()
        further = {FURTHER + name: value for name, value in self.world.items() if name not in fields}
        return {"world": self._state()} | further

    def _take_back(self, saved: dict[str, Tensor]) -> None:
        """Take back the tensors of `_to_save`; their shapes are right."""
        self._put(saved["world"])
        self.world |= {n.removeprefix(FURTHER): saved[n].clone() for n in saved if n.startswith(FURTHER)}

    def _put(self, state: Tensor) -> None:
        """Write a global state [S, E, state width] into the worlds."""
        self.world = self.world | self._split(state.clone())

    def _state(self) -> Tensor:
        """Return the global state [S, E, state width], as memory of its own."""
        return torch.cat([self.world[field.name].flatten(2) for field in self.spec.state.fields], -1)

    def _split(self, state: Tensor) -> World:
        """Return the fields [..., items, item width] of global states [..., state width]."""
        fields = self.spec.state.fields
        parts = state.split([field.width for field in fields], -1)
        return {f.name: part.unflatten(-1, (f.count, f.item_width)) for f, part in zip(fields, parts, strict=True)}


def _owned(values: Tensor, is_new: bool) -> Tensor:
    """Return float32 numbers as contiguous memory that nothing else writes to."""
    values = values if values.dtype == torch.float32 else values.float()
    return values.contiguous() if is_new else values.clone(memory_format=torch.contiguous_format)


def to_others(position: Tensor) -> Tensor:
    """Return where each agent sees each other agent, in index order: [..., N, N - 1, w] from positions [..., N, w]."""
    index = torch.arange(position.shape[-2], device=position.device)
    others = index[:-1] + (index[:-1] >= index.unsqueeze(-1))
    return position[..., others, :] - position.unsqueeze(-2)
