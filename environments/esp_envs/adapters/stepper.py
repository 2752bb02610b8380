"""Steps copies of a `ParallelTask`'s environment, and writes what they give on a board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from esp_envs.adapters import foreign
from esp_envs.adapters.copies import FINAL, NOW, TERMINATED, TRUNCATED, Board
from esp_envs.adapters.hooks import Copy, CopyHooks
from esp_envs.errors import UserError
from esp_envs.spec import Discrete


class CopyStepper:
    """Steps some copies of a board, whose state is that of the simulator where they are `simulated`."""

    def __init__(self, task: CopyHooks, board: Board, copies: range, simulated: bool = False) -> None:
        self._task, self.board, self._simulated = task, board, simulated
        self._of_task = f"of {type(task).__name__}"
        self._copies: dict[int, Copy] = {}
        self._copies.update((k, Copy(task)) for k in copies)
        self._seen: dict[int, Mapping[str, Any]] = {}
        self._infos: dict[int, Mapping[str, Any]] = {}
        self._living: dict[int, set[Any]] = {}
        self._opponents_draws: dict[int, np.random.Generator] = {}
        self._lost = set(task.metrics) if type(task).measure is CopyHooks.measure else set[str]()
        self._told: set[str] = set()
        self._whole: set[int] = set()  # copies that have ended an episode while a metric was lost

    def reset(self) -> None:
        for k in self._copies:
            self._start(k)

    def step(self) -> None:
        """Advance every copy by one step, and reset those whose episode ends."""
        for k, copy in self._copies.items():
            self._step(k, copy)

    def picture(self, k: int) -> NDArray[np.uint8]:
        """Return what the environment of a copy draws of itself, [H, W, 3]."""
        with self._copies[k].naming("render", k):
            return np.asarray(self._copies[k].simulator.bare.render(), np.uint8)

    def place(self) -> None:
        """Put every copy, which has just been reset, into the state on the board."""
        for k, copy in self._copies.items():
            state = self.board.state[NOW, k].copy()
            with copy.naming("put", k):
                seen = copy.put(state)
            if seen is None or not self._write_told(k, seen):  # nobody knows what agents see before the first step
                self.board.obs[NOW, k], self.board.mask[NOW, k] = np.nan, True

    def _write_told(self, k: int, seen: Mapping[str, Any]) -> bool:
        """Write what agents see in a state; False where they are given more, such as a mask in an info."""
        before = self._seen[k], self._infos[k]
        self._seen[k], self._infos[k] = seen, {}
        try:
            self._write(k, NOW)
        except UserError:
            self._seen[k], self._infos[k] = before
            return False
        return True

    def __del__(self) -> None:
        """Close the copies of a task that is forgotten, or of a worker that leaves."""
        for copy in self._copies.values():
            copy.close()

    def _start(self, k: int) -> None:
        seed, copy = int(self.board.seed[k]), self._copies[k]
        self._opponents_draws[k] = np.random.default_rng([seed, 1])  # of `seed` alone the environment's own are made
        with copy.naming("reset", k):
            self._seen[k], self._infos[k] = copy.start(seed)
        self._living[k] = {*copy.learners, *(name for name in copy.rest if name in self._seen[k])}
        self._write(k, NOW)

    def _step(self, k: int, copy: Copy) -> None:
        task, board, seen, living = self._task, self.board, self._seen[k], self._living[k]
        native = {name: copy.native(i, board.action[k, i]) for i, name in enumerate(copy.learners) if name in living}
        with copy.naming("acting", k):
            chosen = {name: task.acting(name, action) for name, action in native.items()}
        acting, others = list(chosen), [name for name in copy.rest if name in living]
        with copy.naming("opponent", k):
            chosen |= {name: task.opponent(name, seen[name], self._opponents_draws[k]) for name in others}
        with copy.naming("step", k):
            seen, reward, *flags, infos = foreign.parts(copy.env.step(chosen), "step")
            ended, cut = foreign.ends(copy.env, copy.agents, *flags)
        self._seen[k], self._infos[k] = seen, infos
        with copy.naming("measure", k):
            found = task.measure(copy.env, infos)
            board.metrics[k] = [found[name] for name in task.metrics]
            if self._lost:
                self._told |= {name for info in infos.values() for name in info}
                self._lost -= self._told
        self._require_whole(copy, seen, acting, ended | cut, flags)
        if missing := [name for name in acting if name not in seen and (name in cut or name not in ended)]:
            who = f"{missing[0]} {self._of_task}"
            raise UserError(f"'step' gives {who} no observation; give one to all that have not ended")
        paid = {name: self._paid(name, reward, name in ended and name not in seen) for name in acting}
        shared = self._shared(copy, paid)
        board.reward[k] = [paid.get(name, shared.get(kind.name, 0.0)) for name, kind in copy.kinds.items()]
        over = [name for name in acting if name in ended or name in cut]
        if over and len(over) < len(acting) and not task.agents_end:
            who = f"{over[0]} {self._of_task}"
            raise UserError(f"{who} ends before the others; set 'agents_end = True' in the class")
        # where agents end one by one, `alive` says who has ended, and a value lies beyond for one that is cut
        ends = all if task.agents_end else any
        board.ended[k] = self._how(k, len(over) == len(acting), ends(name in ended for name in acting))
        if not board.ended[k] and (alone := [name for name in over if name in cut]):
            who = f"{alone[0]} {self._of_task}"
            raise UserError(f"{who} is truncated while others go on; let it terminate, or truncate all")
        going = {name for name in copy.rest if name in seen} - ended - cut
        self._living[k] = going | {name for name in acting if name not in ended}
        self._write(k, FINAL)
        if board.ended[k]:
            if self._lost:
                self._require_metrics(k)
            self._start(k)
        else:
            for seen_by in (board.obs, board.state, board.mask, board.alive):
                seen_by[NOW, k] = seen_by[FINAL, k]

    def _shared(self, copy: Copy, paid: Mapping[Any, float]) -> dict[str, float]:
        """Return the rewards that agents share, by role, after checking that they are the same."""
        shared = dict[str, float]()
        for kind, reward in ((copy.kinds[name], reward) for name, reward in paid.items()):
            if not kind.shared_reward:
                continue
            if not np.allclose(reward, shared.setdefault(kind.name, reward), 1e-5, 1e-8, equal_nan=True):
                raise UserError(f"agents {self._of_task} get different rewards; leave out 'shared_reward'")
        return shared

    def _require_metrics(self, k: int) -> None:
        """Refuse a metric that no info has held when every copy has ended an episode."""
        self._whole.add(k)
        if len(self._whole) == len(self._copies):
            told = ", ".join(sorted(map(str, self._told))[:8]) or "nothing"
            raise UserError(
                f"no info {self._of_task} holds the metric '{min(self._lost)}' in a whole episode; they "
                f"hold {told}; correct 'metrics', or define 'measure'"
            )

    def _require_whole(
        self, copy: Copy, seen: Mapping[Any, Any], acting: Sequence[Any], over: set[Any], flags: Sequence[Any]
    ) -> None:
        """Refuse learning agents that come back, and those of which nothing says whether they have ended."""
        for name in copy.learners:
            if name in over:
                continue
            who = f"{name} {self._of_task}"
            if name not in acting and name in seen:
                raise UserError(f"{who} is back after its end; end agents for good, or keep their flags set")
            if name in acting and not any(one in flag for one in (name, foreign.EVERYONE) for flag in flags):
                raise UserError(f"'step' does not say whether {who} has ended; give it both flags")

    def _paid(self, name: Any, reward: Mapping[Any, Any], left: bool) -> float:
        if name not in reward and not left:
            raise UserError(f"'step' gives {name} {self._of_task} no reward; give one to all that acted")
        return float(foreign.numbers(reward[name], f"the reward of {name}", 1)[0]) if name in reward else 0.0

    def _how(self, k: int, over: bool, terminated: bool) -> int:
        """Return how the episode of a copy ended, 0 where it goes on; the horizon counts as a cut in any case."""
        task = self._task
        if over and terminated and task.terminates:
            return TERMINATED
        if over and not self.board.cut[k] and not task.terminates:
            way = "set 'terminates = True' in the class"
            way = way if terminated else f"give both the same number of steps, or {way}"
            raise UserError(f"an episode {self._of_task} ends before its horizon; {way}")
        return TRUNCATED if over or self.board.cut[k] else 0

    def _write(self, k: int, when: int) -> None:
        """Write what the agents of a copy see; zeros, and everything allowed, for one that is there no more."""
        copy, seen, infos, task, board = self._copies[k], self._seen[k], self._infos[k], self._task, self.board
        alive = board.alive[when, k] = [name in self._living[k] for name in copy.learners]
        with copy.naming("reading", k):
            board.obs[when, k] = copy.seen(seen)
        if task.masks:
            over = when == FINAL and board.ended[k] > 0
            with copy.naming("allowed", k):
                for i, (name, kind) in enumerate(copy.kinds.items()):
                    row, action = np.ones(board.mask.shape[-1], np.float32), kind.action
                    if alive[i] and kind.masks and isinstance(action, Discrete):
                        allowed = task.allowed(name, seen[name], infos.get(name, {}))
                        row[: action.count] = foreign.numbers(allowed, f"the mask of {name}", action.count)
                        row[action.count :] = 0
                    if not row.any() and not over:
                        raise UserError(f"the mask of {name} allows nothing; leave it one action")
                    board.mask[when, k, i] = (row != 0) | (not row.any())  # after the end a mask often allows nothing
        if self._simulated:
            state = copy.take()
        else:
            rows = zip(board.obs[when, k], copy.kinds.values(), strict=True)
            own = [row[: kind.observation.width] for row, kind in rows]
            state = np.concatenate(own) if task.state is None else copy.state(k)
        board.state[when, k] = foreign.numbers(state, "the state", board.state.shape[-1])
