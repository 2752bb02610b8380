"""Many copies of one environment, stepped here or in worker processes, with all numbers in shared memory.

A `Board` holds what goes to and comes from every copy; a `Stepper` steps some copies and knows nothing of processes.
One stepper steps all copies here, or `WorkerCopies` shares them out among many, with the same results bit for bit.
"""

from __future__ import annotations

import contextlib
import mmap
import multiprocessing
import os
import signal
import warnings
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from esp_envs.errors import UserError
from esp_envs.installed import last_line

_RESET, _STEP, _PLACE, _LEAVE = b"reset", b"step", b"place", b"leave"
TERMINATED, TRUNCATED = 1, 2  # what `Board.ended` says of a copy whose episode ended in this step
NOW, FINAL = 0, 1  # where a board holds what is seen now, and what was seen before an automatic reset


@dataclass(frozen=True)
class Sizes:
    """How large the arrays of a board are: C copies, N agents, and the widths of their numbers."""

    copies: int
    agents: int
    obs: int
    state: int
    metrics: int
    action: int | None
    """Width of a continuous action; None for a discrete one."""
    choices: int = 0
    """Discrete actions of a mask; 0 without masks."""


class Board:
    """Arrays over one piece of memory, which a fork of this process shares.

    Attributes:
        cut: [C] uint8, which copies reach the horizon with the next step.
        ended: [C] uint8, 0 or how the episode ended in the last step.
        seed: [C] int64, of the next start.
        action: [C, N] int64 or [C, N, width] float32.
        reward: [C, N] float32.
        metrics: [C, M] float32.
        obs: [2, C, N, D] float32; of these four arrays `NOW` is what is seen now, and `FINAL` what was seen before the
            automatic reset; the two are the same unless the episode ended.
        state: [2, C, state width] float32.
        mask: [2, C, N, A] uint8, the allowed actions; A = 0 without masks.
        alive: [2, C, N] uint8, the agents that have not ended.
    """

    cut: NDArray[np.uint8]
    ended: NDArray[np.uint8]
    seed: NDArray[np.int64]
    action: NDArray[Any]
    reward: NDArray[np.float32]
    metrics: NDArray[np.float32]
    obs: NDArray[np.float32]
    state: NDArray[np.float32]
    mask: NDArray[np.uint8]
    alive: NDArray[np.uint8]

    def __init__(self, sizes: Sizes) -> None:
        copies, agents = sizes.copies, sizes.agents
        action = ((copies, agents), np.int64) if sizes.action is None else ((copies, agents, sizes.action), np.float32)
        # the widest numbers first, so that each array begins at a multiple of its number's width
        parts: dict[str, tuple[tuple[int, ...], type[np.generic]]] = {
            "seed": ((copies,), np.int64),
            "action": action,
            "reward": ((copies, agents), np.float32),
            "metrics": ((copies, sizes.metrics), np.float32),
            "obs": ((2, copies, agents, sizes.obs), np.float32),
            "state": ((2, copies, sizes.state), np.float32),
            "mask": ((2, copies, agents, sizes.choices), np.uint8),
            "alive": ((2, copies, agents), np.uint8),
            "cut": ((copies,), np.uint8),
            "ended": ((copies,), np.uint8),
        }
        memory = mmap.mmap(-1, sum(int(np.prod(shape)) * np.dtype(kind).itemsize for shape, kind in parts.values()))
        start = 0
        for name, (shape, kind) in parts.items():
            array = np.frombuffer(memory, kind, int(np.prod(shape)), start).reshape(shape)
            setattr(self, name, array)
            start += array.nbytes


class Stepper(Protocol):
    """What resets and steps the copies of a board."""

    board: Board

    def reset(self) -> None:
        """Start an episode in every copy."""

    def step(self) -> None:
        """Advance every copy by one step, and reset those whose episode ends."""

    def place(self) -> None:
        """Put every copy, which has just been reset, into the state on the board."""


class WorkerCopies:
    """The copies shared out among worker processes, which are forks of this one.

    A command is one byte in a pipe; its answer is empty, or the sentence of what went wrong. A worker leaves when its
    pipe closes, so none outlives this process.
    """

    def __init__(self, sizes: Sizes, make_stepper: Callable[[Board, range], Stepper], count: int) -> None:
        self.board = Board(sizes)
        context = multiprocessing.get_context("fork")
        self._workers: list[tuple[Connection, ForkProcess]] = []
        for k in range(count):
            share = range(sizes.copies * k // count, sizes.copies * (k + 1) // count)
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
        self._command(_RESET)

    def step(self) -> None:
        self._command(_STEP)

    def place(self) -> None:
        """Put every copy, which has just been reset, into the state on the board."""
        self._command(_PLACE)

    def _command(self, word: bytes) -> None:
        for pipe, _ in self._workers:
            with contextlib.suppress(BrokenPipeError):  # the answer will be missing
                pipe.send_bytes(word)
        self._wait()

    def _wait(self) -> None:
        """Read one answer of every worker."""
        failures = [failure for pipe, worker in self._workers if (failure := _answer(pipe, worker))]
        if failures:
            raise UserError(failures[0])


def can_fork() -> bool:
    """Return whether this machine can fork processes."""
    return "fork" in multiprocessing.get_all_start_methods()


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
    pipe: Connection,
    ends_of_the_parent: Sequence[Connection],
    make_stepper: Callable[[Board, range], Stepper],
    board: Board,
    share: range,
) -> None:
    for stop in (signal.SIGINT, signal.SIGTERM):  # the parent stops in its own time, and then closes the pipe
        signal.signal(stop, signal.SIG_IGN)
    for end in ends_of_the_parent:
        end.close()
    os.dup2(2, 1)  # an environment may print, and the command's output stays clean
    torch.set_num_threads(1)
    stepper: Stepper | None = None

    def begin() -> None:
        nonlocal stepper
        stepper = make_stepper(board, share)

    pipe.send_bytes(_failure_of(begin))
    if stepper is None:
        return
    commands = {_RESET: stepper.reset, _STEP: stepper.step, _PLACE: stepper.place}
    with contextlib.suppress(EOFError, ConnectionError):
        while (word := pipe.recv_bytes()) != _LEAVE:
            pipe.send_bytes(_failure_of(commands[word]))


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
