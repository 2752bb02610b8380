"""Many copies of one environment, stepped here or in worker processes, with all numbers in shared memory.

A `Board` holds what goes to and comes from every copy; a `CopyStepper` steps some copies, in any process.
One stepper steps all copies here, or `WorkerCopies` shares them out among many, with the same results bit for bit.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import multiprocessing
import os
import signal
import warnings
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from esp_envs.errors import UserError
from esp_envs.installed import last_line
from esp_envs.spec import Discrete, TaskSpec

_LEAVE = b"leave"
TERMINATED, TRUNCATED = 1, 2  # what `Board.ended` says of a copy whose episode ended in this step
NOW, FINAL = 0, 1  # where a board holds what is seen now, and what was seen before an automatic reset


class Board:
    """Arrays of C copies of a task and M metrics, in memory that a fork of this process shares.

    cut [C] uint8: which copies reach the horizon with the next step. ended [C] uint8: 0 or how the episode ended in the
    last step. seed [C] int64: of the next start. action [C, N] int64 or [C, N, width] float32; reward [C, N] and
    metrics [C, M] float32. Of the others `NOW` is what is seen now, `FINAL` what was seen before the automatic reset,
    the same unless the episode ended: obs [2, C, N, D] and state [2, C, state width] float32, mask [2, C, N, A] uint8
    of allowed actions (A = 0 without masks), alive [2, C, N] uint8 of agents that have not ended.
    """

    def __init__(self, spec: TaskSpec, copies: int, metrics: int) -> None:
        team, action, choices = (copies, spec.num_agents), spec.action, 0
        if isinstance(action, Discrete):
            self.action, choices = _shared(np.int64, *team), action.count if spec.masks else 0
        else:
            self.action = _shared(np.float32, *team, action.width)
        self.cut, self.ended = _shared(np.uint8, copies), _shared(np.uint8, copies)
        self.seed = _shared(np.int64, copies)
        self.reward, self.metrics = _shared(np.float32, *team), _shared(np.float32, copies, metrics)
        self.obs = _shared(np.float32, 2, *team, spec.observation.width)
        self.state = _shared(np.float32, 2, copies, spec.state.width)
        self.mask = _shared(np.uint8, 2, *team, choices)
        self.alive = _shared(np.uint8, 2, *team)


def _shared(kind: type[np.generic], *shape: int) -> NDArray[Any]:
    """Return zeros in memory that a fork shares."""
    count = math.prod(shape)
    return np.frombuffer(mmap.mmap(-1, max(1, count) * np.dtype(kind).itemsize), kind, count).reshape(shape)


MakeStepper = Callable[[Board, range], Any]
"""Makes what can `reset`, `step` and `place` some copies of a board, as a `CopyStepper`."""


class WorkerCopies:
    """The copies shared out among worker processes, which are forks of this one.

    A command is the name of a stepper's method in a pipe; its answer is empty, or the sentence of what went wrong. A
    worker leaves when its pipe closes, so none outlives this process.
    """

    def __init__(self, board: Board, make_stepper: MakeStepper, count: int) -> None:
        self.board, copies = board, len(board.seed)
        context = multiprocessing.get_context("fork")
        self._workers: list[tuple[Connection, ForkProcess]] = []
        for k in range(count):
            share = range(copies * k // count, copies * (k + 1) // count)
            here, there = context.Pipe()
            ends = [here, *(pipe for pipe, _ in self._workers)]
            worker = context.Process(target=_work, args=(there, ends, make_stepper, self.board, share), daemon=True)
            with warnings.catch_warnings():  # threads of this process hold nothing that a worker uses
                warnings.simplefilter("ignore", DeprecationWarning)
                worker.start()
            there.close()
            self._workers.append((here, worker))
        self._finalizer = weakref.finalize(self, _stop, self._workers)
        self._wait()

    def reset(self) -> None:
        self._command(b"reset")

    def step(self) -> None:
        self._command(b"step")

    def place(self) -> None:
        self._command(b"place")

    def _command(self, word: bytes) -> None:
        if not self._finalizer.alive:
            raise UserError("the worker processes that step environments were stopped; make the environment anew")
        try:
            for pipe, _ in self._workers:
                with contextlib.suppress(BrokenPipeError):  # the answer will be missing
                    pipe.send_bytes(word)
            self._wait()
        except UserError:
            raise  # after the answers of all
        except BaseException:  # an answer that is still to come would be taken for that of the next command
            self._finalizer()
            raise

    def _wait(self) -> None:
        """Read one answer of every worker."""
        failures = [failure for pipe, worker in self._workers if (failure := _answer(pipe, worker))]
        if failures:
            raise UserError(failures[0])


def _answer(pipe: Connection, worker: ForkProcess) -> str:
    try:
        return pipe.recv_bytes().decode()
    except (EOFError, ConnectionError):
        worker.join()
        return (
            f"a worker process that steps environments died (exit code {worker.exitcode}); the run's checkpoints are "
            "intact, go on with esp train --resume"
        )


def _work(
    pipe: Connection, ends_of_the_parent: Sequence[Connection], make_stepper: MakeStepper, board: Board, share: range
) -> None:
    for stop in (signal.SIGINT, signal.SIGTERM):  # the parent stops in its own time, and then closes the pipe
        signal.signal(stop, signal.SIG_IGN)
    for end in ends_of_the_parent:
        end.close()
    os.dup2(2, 1)  # an environment may print, and the command's output stays clean
    torch.set_num_threads(1)
    steppers: list[Any] = []
    pipe.send_bytes(_failure_of(lambda: steppers.append(make_stepper(board, share))))
    if not steppers:
        return
    with contextlib.suppress(EOFError, ConnectionError):
        while (word := pipe.recv_bytes()) != _LEAVE:
            pipe.send_bytes(_failure_of(getattr(steppers[0], word.decode())))


def _failure_of(command: Callable[[], None]) -> bytes:
    try:
        command()
    except (Exception, SystemExit) as failure:
        said = str(failure) if isinstance(failure, UserError) else last_line(failure)
        return said.encode(errors="backslashreplace")
    return b""


def _stop(workers: Sequence[tuple[Connection, ForkProcess]]) -> None:
    for pipe, _ in workers:
        with contextlib.suppress(OSError):
            pipe.send_bytes(_LEAVE)
        pipe.close()
    for _, worker in workers:
        worker.join(timeout=5)
        if worker.exitcode is None:
            worker.kill()
            worker.join()
