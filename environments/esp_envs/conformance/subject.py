"""The task under test, the two ways to break a promise, and how results are compared."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from esp_envs.base import Environment, Observation, Step

MakeWorlds = Callable[[int, Sequence[int]], Environment]
WORLDS, SEEDS = 5, (3, 7)


class Broken(ValueError):  # noqa: N818 - it is a finding, not an error of the program
    """A task does not keep a promise; the message says what happens instead."""


class NotAsked(ValueError):  # noqa: N818
    """A promise does not concern a task; the message says why."""


@dataclass(frozen=True)
class Subject:
    """A task to check.

    `align` gives the second environment the chance that the first has drawn in advance, at a step of its episode.
    """

    make: MakeWorlds  # makes the worlds, given E and the seeds
    rounding: float = 0.0  # how far a step from a restored state may differ, where physics is finer than float32
    align: Callable[[Environment, Environment, int], None] | None = None
    deadline: float = math.inf  # at which `time.monotonic` promises about many steps stop looking

    def worlds(self, num_envs: int = WORLDS, seeds: Sequence[int] = SEEDS) -> Environment:
        """Make E worlds for each seed."""
        return self.make(num_envs, seeds)

    def steps(self, count: int) -> Iterator[int]:
        """Count steps, up to the deadline."""
        return itertools.takewhile(lambda _: time.monotonic() < self.deadline, range(count))


def tensors_of(step: Step) -> list[Tensor]:
    """Return every tensor of a step."""
    final = [] if step.final is None else parts_of(step.final)
    return [*parts_of(step.next), step.reward, *step.metrics.values(), *final, step.terminated, step.truncated]


def equal(a: Tensor, b: Tensor) -> bool:
    """Return whether two tensors are equal bit for bit; NaN equals NaN."""
    return a.shape == b.shape and bool(((a == b) | ((a != a) & (b != b))).all())  # noqa: PLR0124


def same_step(a: Step, b: Step, where: tuple[slice | Tensor, ...] = ()) -> bool:
    """Return whether two steps are equal bit for bit, in the worlds that `where` selects."""
    if (a.final is None) != (b.final is None) or a.metrics.keys() != b.metrics.keys():
        return False
    return all(equal(x[where], y[where]) for x, y in zip(tensors_of(a), tensors_of(b), strict=True))


def parts_of(observation: Observation) -> list[Tensor]:
    """Return what an observation consists of."""
    parts = (observation.obs, observation.state, observation.action_mask, observation.alive)
    return [part for part in parts if part is not None]


def same_observation(a: Observation, b: Observation, where: tuple[Tensor, ...] = ()) -> bool:
    """Return whether two observations are equal bit for bit, in the worlds that `where` selects."""
    return all(equal(x[where], y[where]) for x, y in zip(parts_of(a), parts_of(b), strict=True))


def nearly(a: Sequence[Tensor], b: Sequence[Tensor], bound: float) -> bool:
    """Return whether tensors agree within `bound`; bit for bit where it is 0."""
    return len(a) == len(b) and all(
        bool((((x.float() - y.float()).abs() <= bound) | (x == y) | (x.isnan() & y.isnan())).all())
        for x, y in zip(a, b, strict=True)
    )


def require_method(env: Environment, method: str, otherwise: str) -> None:
    """Ask nothing of a task that lacks an optional method."""
    if not env.has(method):
        raise NotAsked(otherwise)


def require_refusal(call: Callable[..., object], given: object, otherwise: str) -> None:
    """Raise `Broken` unless a call with this argument raises a ValueError."""
    try:
        call(given)
    except ValueError:
        return
    raise Broken(otherwise)


def require(holds: bool, otherwise: str) -> None:
    """Raise `Broken` with a sentence unless something holds."""
    if not holds:
        raise Broken(otherwise)


def require_equal(what: str, got: object, expected: object) -> None:
    """Raise `Broken` unless something is as expected."""
    require(got == expected, f"{what} is {got}, expected {expected}")
