"""Any PettingZoo `ParallelEnv` as a task: say how to make one copy and what its numbers are.

    class Spread(ParallelTask):
        observation = layout(Field("velocity", Kind.VECTOR), ...)
        action = MOVES
        symmetry = "d4*agents"
        convention = "mpe2 simple_spread_v3"

        def make_one(self):
            return simple_spread_v3.parallel_env(max_cycles=self.settings.horizon)

The adapter needs `possible_agents`, `reset(seed)`, `step(actions)` and the spaces, so it imports no PettingZoo itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.adapters import seed_of
from esp_envs.adapters.copies import TERMINATED, TRUNCATED, Board, Sizes, Stepper, WorkerCopies, can_fork
from esp_envs.adapters.stepper import Array, Copy, CopyHooks, CopyStepper
from esp_envs.base import (
    OTHER_SIZE,
    Environment,
    Observation,
    Step,
    TaskSettings,
    generator_states,
    require_attributes,
    require_shape,
    restore_generators,
)
from esp_envs.errors import UserError
from esp_envs.machine import available_cores
from esp_envs.spec import Discrete, TaskSpec, joint_layout

_FEW_COPIES = 8
"""Up to this number of copies, worker processes cost more time than they save."""


class ParallelSettings(TaskSettings):
    """What a user may change of every task of this kind; a subclass adds its own."""

    horizon: int = Setting(25, ge=1, le=100_000, description="steps of an episode")
    workers: int | None = Setting(
        None, ge=0, le=256, description="processes that step copies; 0 is none, by default one a core of the run"
    )


class ParallelTask(CopyHooks, Environment):
    """Copies of a PettingZoo environment, S x E of them.

    A subclass sets the attributes of `CopyHooks`, implements `make_one`, and may override `reading`, `opponent` and
    `measure`. A copy must be repeatable: from `reset(seed)` on, the same actions give the same numbers, since a saved
    run is restored by repeating its episode.
    """

    Settings: ClassVar[type[TaskSettings]] = ParallelSettings
    settings: ParallelSettings

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        require_attributes(self, "observation", "action", "symmetry", "convention")
        one = Copy(self)
        agents = len(one.learners)
        self.spec = TaskSpec(
            name=type(self).__name__.lower(),
            version=1,
            convention=self.convention,
            num_agents=agents,
            horizon=self.settings.horizon,
            observation=self.observation,
            state=self.state or joint_layout(self.observation, agents),
            action=self.action,
            symmetry=self.symmetry,
            shared_reward=self.shared_reward,
            terminates=self.terminates,
            agents_end=self.agents_end,
            masks=self.masks,
            settings=settings.model_dump(),
        )
        one.require_spaces()
        one.close()
        self._copies: Stepper | None = None
        lead = (self.num_seeds, num_envs)
        self._base = torch.zeros(lead, dtype=torch.int64)
        self._begun, self._time = torch.zeros_like(self._base), torch.zeros_like(self._base)
        kind = torch.int64 if isinstance(self.action, Discrete) else torch.float32
        self._taken = torch.zeros(self.spec.horizon, *self.action_shape, dtype=kind)

    def reset(self) -> Observation:
        """Start a new episode in every copy."""
        drawn = [torch.randint(2**62, (self.num_envs,), generator=g, device=self.device) for g in self.generators]
        self._base = torch.stack(drawn).cpu()
        self._begun.zero_()
        return self._restart()

    def step(self, action: Tensor) -> Step:
        """Advance every copy by one step.

        Raises:
            UserError: the action has another shape, an environment raises, a worker dies, or agents end apart.
        """
        require_shape("joint action", action, self.action_shape)
        board = self._started().board
        copies = torch.arange(self._base.numel())
        self._taken.flatten(1, 2)[self._time.flatten(), copies] = action.flatten(0, 1).cpu()
        self._advance(torch.ones_like(self._base, dtype=torch.bool), action)
        ended = torch.from_numpy(board.ended.copy()).view_as(self._base)
        final = None
        if self.terminates or bool((ended > 0).any()):
            final = self._final()
        return Step(
            next=self._seen(),
            reward=self._per_world(board.reward),
            terminated=(ended == TERMINATED).to(self.device),
            truncated=(ended == TRUNCATED).to(self.device),
            final=final,
            metrics={name: self._per_world(board.metrics[:, m]) for m, name in enumerate(self.metrics)},
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return seeds, clocks, what was done in the present episodes and what is seen now."""
        board = self._started().board
        return {
            "base": self._base.clone(),
            "begun": self._begun.clone(),
            "time": self._time.clone(),
            "taken": self._taken.clone(),
            "seen": self._per_world(board.obs).cpu(),
            "generators": generator_states(self.generators),
        }

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned, by repeating the present episode of each copy.

        Raises:
            UserError: the tensors belong to an environment of another size, or a copy does not repeat itself.
        """
        if tensors["taken"].shape != self._taken.shape or len(tensors["generators"]) != self.num_seeds:
            raise UserError(OTHER_SIZE)
        self._base, self._begun = tensors["base"].cpu().clone(), tensors["begun"].cpu() - 1
        restore_generators(self.generators, tensors["generators"])
        self._taken = tensors["taken"].cpu().clone()
        if bool((self._begun < 0).any()):  # it was saved before its first reset
            self._begun.zero_()
            return
        self._restart()
        until = tensors["time"].cpu()
        for t in range(int(until.max())):
            self._advance(until > t, self._taken[t])
        if not torch.equal(self._per_world(self._started().board.obs).cpu(), tensors["seen"].cpu()):
            raise UserError(
                f"a copy of {self.spec.name} does not repeat its episode from the same seed and actions, so the run "
                "cannot go on bit for bit; let 'reset(seed)' decide all that chance does in the environment"
            )

    def _started(self) -> Stepper:
        """Return the copies, made when they are first needed."""
        if self._copies is None:
            count, workers = self._base.numel(), self.settings.workers
            if workers is None:
                cores = min(available_cores(), torch.get_num_threads())  # a run of a study has one of them
                workers = cores if cores > 1 and count > _FEW_COPIES else 0
            spec, discrete = self.spec, isinstance(self.action, Discrete)
            sizes = Sizes(
                count,
                spec.num_agents,
                spec.observation.width,
                spec.state.width,
                len(self.metrics),
                None if discrete else self.action_shape[-1],
                self.action.count if isinstance(self.action, Discrete) and self.masks else 0,
            )
            if workers and can_fork():
                self._copies = WorkerCopies(sizes, self._stepper, min(workers, count))
            else:
                self._copies = self._stepper(Board(sizes), range(count))
        return self._copies

    def _stepper(self, board: Board, copies: range) -> CopyStepper:
        return CopyStepper(self, board, copies)

    def _restart(self) -> Observation:
        """Start the present episode of every copy from its seed."""
        copies = self._started()
        self._time.zero_()
        copies.board.active[:] = 1
        copies.board.seed[:] = self._seeds(copies.board.active)
        copies.reset()
        self._begun += 1
        copies.board.seed[:] = self._seeds(copies.board.active)
        return self._seen()

    def _advance(self, active: Tensor, action: Tensor) -> None:
        copies = self._started()
        board = copies.board
        board.active[:] = active.flatten().numpy()
        board.action[:] = self.action.admissible(action).flatten(0, 1).cpu().numpy()
        board.cut[:] = (self._time + 1 == self.spec.horizon).flatten().numpy()
        copies.step()
        self._time += active
        ended = torch.from_numpy(board.ended > 0).view_as(self._base) & active
        if bool(ended.any()):
            self._begun += ended
            self._time[ended] = 0
            which = ended.flatten().numpy()
            board.seed[which] = self._seeds(which)

    def _seeds(self, which: Array) -> list[int]:
        """Return the seed of the next episode of some copies; no copy's depends on the others."""
        base, episode = self._base.flatten().numpy()[which > 0], self._begun.flatten().numpy()[which > 0]
        return list(map(seed_of, base.tolist(), episode.tolist()))

    def action_mask(self) -> Tensor | None:
        """Return which actions each agent may take now; None without `masks`."""
        return self._per_world(self._started().board.mask).bool() if self.masks else None

    def _seen(self) -> Observation:
        board = self._started().board
        return self._observation(board.obs, board.state, board.mask, board.alive)

    def _final(self) -> Observation:
        board = self._started().board
        return self._observation(board.final_obs, board.final_state, board.final_mask, board.final_alive)

    def _observation(self, obs: Array, state: Array, mask: Array, alive: Array) -> Observation:
        return Observation(
            self._per_world(obs),
            self._per_world(state),
            self._per_world(mask).bool() if self.masks else None,
            self._per_world(alive).bool() if self.agents_end else None,
        )

    def _per_world(self, values: Array) -> Tensor:
        """Return [S, E, ...] on the task's device, as memory of its own."""
        return torch.from_numpy(values.copy()).view(*self._base.shape, *values.shape[1:]).to(self.device)
