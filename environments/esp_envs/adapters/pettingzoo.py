"""Any PettingZoo `ParallelEnv` as a task: say how to make one copy and what its numbers are.

The adapter needs `possible_agents`, `reset(seed)`, `step(actions)` and the spaces, so it imports no PettingZoo itself.
"""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.adapters import require_attributes, require_roles, seed_of
from esp_envs.adapters.attributes import deciding_attributes, simulated_layout
from esp_envs.adapters.copies import FINAL, NOW, TERMINATED, TRUNCATED, Board, WorkerCopies
from esp_envs.adapters.hooks import Copy, CopyHooks
from esp_envs.adapters.pairing import Array
from esp_envs.adapters.stepper import CopyStepper
from esp_envs.base import Environment, Observation, Step, require_shape
from esp_envs.errors import UserError
from esp_envs.installed import available_cores
from esp_envs.roles import spec_with_roles, with_state
from esp_envs.scene import Scene
from esp_envs.settings import TaskSettings
from esp_envs.spec import ActionSpace, Layout, TaskSpec

_FEW_COPIES = 8  # up to this number of copies, worker processes cost more time than they save


class ParallelSettings(TaskSettings):
    """What a user may change of every task of this kind; a subclass adds its own."""

    horizon: int = Setting(25, ge=1, le=100_000, description="steps of an episode")
    workers: int | None = Setting(
        None, ge=0, le=256, description="processes that step copies; 0 is none, by default one a core of the run"
    )


class ParallelTask(CopyHooks, Environment):
    """Copies of a PettingZoo environment, S x E of them.

    A subclass sets the attributes of `CopyHooks`, implements `make_one`, and may override `reading`, `opponent` and
    `measure`. What chance decides in a copy should follow from `reset(seed)`; then a run can be repeated.

    Example:
        class Spread(ParallelTask):
            observation = layout(Field("velocity", Kind.VECTOR), ...)
            action, symmetry, convention = MOVES, "d4*agents", "mpe2 simple_spread_v3"

            def make_one(self):
                return simple_spread_v3.parallel_env(max_cycles=self.settings.horizon)
    """

    Settings: ClassVar[type[TaskSettings]] = ParallelSettings
    settings: ParallelSettings

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        require_attributes(self, "observation", "action", "symmetry", "convention")
        require_roles(self, self.role_names)
        for name, kind in (("observation", Layout), ("action", ActionSpace), ("state", Layout | None)):
            self._require_kind(name, kind)
        one = Copy(self)
        self.spec = self._described(one)
        one.require_spaces()
        self._draws = getattr(one.simulator.bare, "render_mode", None) == "rgb_array"
        one.close()
        self._copies: CopyStepper | WorkerCopies | None = None
        self._simulated = False
        self._base = torch.zeros((self.num_seeds, num_envs), dtype=torch.int64)
        self._begun, self._time = torch.zeros_like(self._base), torch.zeros_like(self._base)

    def _require_kind(self, name: str, kind: Any) -> None:
        """Refuse an attribute that is not of a kind, or not so for each role."""
        given = getattr(self, name)
        by_role = isinstance(given, Mapping) and name != "state"
        if by_role and (missing := next((role for role in self.role_names if role not in given), None)):
            raise UserError(f"the {name} of {type(self).__name__} is given by role, but not of '{missing}'; add it")
        for one in given.values() if by_role else [given]:
            if not isinstance(one, kind):
                kinds = "a layout(...)" if name != "action" else "Discrete(...) or Continuous(...)"
                raise UserError(
                    f"the {name} of {type(self).__name__} is a {type(one).__name__}; give {kinds} of esp_envs"
                )

    def _described(self, one: Copy) -> TaskSpec:
        """Return the spec, with roles where agents of several kinds learn."""
        counts = Counter(kind.name for kind in one.kinds.values())
        of_name = {kind.name: kind for kind in one.kinds.values()}
        return spec_with_roles(
            [replace(of_name[name], num_agents=count) for name, count in counts.items()],
            name=type(self).__name__.lower(),
            version=1,
            convention=self.convention,
            control_period_s=self.control_period_s,
            horizon=self.settings.horizon,
            symmetry=self.symmetry,
            nearly=self.nearly,
            state=self.state,
            terminates=self.terminates,
            agents_end=self.agents_end,
            totals=self.totals,
            settings=self.settings.model_dump(),
        )

    def reset(self) -> Observation:
        drawn = [torch.randint(2**62, (self.num_envs,), generator=g, device=self.device) for g in self.generators]
        self._base = torch.stack(drawn).cpu()
        copies, everyone = self._started(), np.ones(self._base.numel(), bool)
        self._time.zero_()
        self._begun.zero_()
        copies.board.seed[:] = self._seeds(everyone)
        copies.reset()
        self._begun += 1
        copies.board.seed[:] = self._seeds(everyone)
        return self._seen()

    def step(self, action: Tensor) -> Step:
        require_shape("joint action", action, self.action_shape)
        copies = self._started()
        board = copies.board
        board.action[:] = self.spec.admissible(action).flatten(0, 1).cpu().numpy()
        board.cut[:] = (self._time + 1 == self.spec.horizon).flatten().numpy()
        copies.step()
        ended = torch.from_numpy(board.ended.copy()).view_as(self._base)
        over = ended > 0
        self._time = (self._time + 1).masked_fill(over, 0)
        self._begun += over
        which = over.flatten().numpy()
        board.seed[which] = self._seeds(which)
        return Step(
            next=self._seen(),
            reward=self._per_world(board.reward),
            terminated=(ended == TERMINATED).to(self.device),
            truncated=(ended == TRUNCATED).to(self.device),
            final=self._seen(FINAL) if self.terminates or which.any() else None,
            metrics={name: self._per_world(board.metrics[:, m]) for m, name in enumerate(self.metrics)},
        )

    def settable(self) -> bool:
        """Let the state be the simulator's from here on; return whether it can be set.

        What agents see at the start of an episode from such a state is NaN where the environment does not say it.
        """
        one = Copy(self)
        with one.naming("put"):
            found = simulated_layout(one, self.spec.parts, self.simulated)
            if found is None and self.simulated is None and not self.spec.roles:
                self.attributes = deciding_attributes(one, self.spec.observation, min(self.spec.horizon, 64))
                found = None if self.attributes is None else self.attributes.layout
        one.close()
        if found is not None:
            self._simulated, self._copies, self.spec = True, None, with_state(self.spec, found)
        return self._simulated

    def has(self, method: str) -> bool:
        """Return whether the task offers a method: `set_state` where `settable`, `scene` where its own copies draw."""
        if method == "scene" and type(self).scene is ParallelTask.scene:
            return self._draws and not self._processes()
        return self._simulated if method == "set_state" else super().has(method)

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        """Return the picture that an environment made with `render_mode="rgb_array"` draws of itself."""
        copies = self._started()
        if not self._draws or not isinstance(copies, CopyStepper):
            return super().scene(world)  # refuses
        picture = copies.picture(world[0] * self.num_envs + world[1])
        return Scene((), (0.0, picture.shape[1], 0.0, picture.shape[0]), picture=picture)

    def set_state(self, state: Tensor) -> Observation:
        if not self._simulated:
            return super().set_state(state)
        require_shape("state", state, self.state_shape)
        if self._time.any():
            self.reset()
        copies = self._started()
        copies.board.state[NOW] = state.flatten(0, 1).cpu().numpy()
        copies.place()
        return self._seen()

    def _started(self) -> CopyStepper | WorkerCopies:
        if self._copies is None:
            count, workers = self._base.numel(), self._processes()
            board = Board(self.spec, count, len(self.metrics))
            if workers:
                self._copies = WorkerCopies(board, self._stepper, workers)
            else:
                self._copies = self._stepper(board, range(count))
        return self._copies

    def _processes(self) -> int:
        """Return how many worker processes step the copies; 0 is none."""
        count, workers = self._base.numel(), self.settings.workers
        if workers is None:
            cores = min(available_cores(), torch.get_num_threads())  # a run of a study has one of them
            workers = cores if cores > 1 and count > _FEW_COPIES else 0
        return min(workers, count) if "fork" in multiprocessing.get_all_start_methods() else 0

    def _stepper(self, board: Board, copies: range) -> CopyStepper:
        return CopyStepper(self, board, copies, self._simulated)

    def _seeds(self, which: Array) -> list[int]:
        base, episode = self._base.flatten().numpy()[which], self._begun.flatten().numpy()[which]
        return list(map(seed_of, base.tolist(), episode.tolist()))

    def action_mask(self) -> Tensor | None:
        return self._per_world(self._started().board.mask[NOW]).bool() if self.spec.masks else None

    def _seen(self, when: int = NOW) -> Observation:
        board = self._started().board
        obs, state, mask, alive = (self._per_world(x[when]) for x in (board.obs, board.state, board.mask, board.alive))
        return Observation(
            obs, state, mask.bool() if self.spec.masks else None, alive.bool() if self.agents_end else None
        )

    def _per_world(self, values: Array) -> Tensor:
        return torch.from_numpy(values.copy()).view(*self._base.shape, *values.shape[1:]).to(self.device)
