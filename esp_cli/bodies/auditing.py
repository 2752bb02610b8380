"""Audit a mirror that somebody wrote: which element is each of its copies, and which numbers of it are wrong."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from esp_cli.bodies.body import Body
from esp_cli.bodies.numbers import ACTION, Numbers, labels_of, map_of
from esp_cli.symmetry.elements import Floats
from esp_envs.errors import UserError
from esp_envs.installed import last_line

_OBS, _ACTIONS = ("obs", "observations", "observation", "states", "state"), ("actions", "action")
_RANDOM = 8  # random rows, which tell whether the function is linear
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Copy:
    """What one copy of a mirror function turned out to be."""

    element: str  # the element that it comes nearest to; "identity" of the first
    is_involution: bool  # whether it undoes itself, as a mirror does
    unseen: tuple[str, ...]  # groups of observations, or "action", that the function neither takes nor returns
    wrong: tuple[tuple[str, str, str], ...]  # number, what it takes, what is right: ("action.hip", "hip", "-hip")


def audit(function: Callable[..., Any], body: Body, numbers: Numbers) -> list[Copy]:
    """Compare each copy that a function makes with the body's elements.

    The function is called as rsl_rl calls it, with what it takes of `env`, `obs` and `actions`. It is given unit
    vectors, so that each number of its results tells where it comes from; so it has to be linear.
    """
    count = max(layout.width for layout in numbers.values()) + _RANDOM
    noise = torch.Generator().manual_seed(0)
    rows = {}
    for name, layout in numbers.items():
        rows[name] = torch.eye(count)[:, : layout.width]
        rows[name][-_RANDOM:] = torch.randn((_RANDOM, layout.width), generator=noise)
        rows[name][-_RANDOM // 2 :] *= 100  # a function may act otherwise on large numbers
    maps: dict[str, list[Floats]] = {}
    for name, made in _called(function, numbers, rows).items():
        width = numbers[name].width
        if made.shape[1:] != (width,) or len(made) % count or not len(made):
            raise UserError(f"the function returns {name} {list(made.shape)}; {count} rows of {width} were given")
        copies = made.detach().cpu().double().split(count)
        maps[name] = [copy[:width].numpy().T for copy in copies]
        for matrix, copy in zip(maps[name], copies, strict=True):
            if not np.allclose(rows[name][-_RANDOM:].numpy() @ matrix.T, copy[-_RANDOM:].numpy(), atol=1e-3):
                raise UserError(f"the function's {name} are not a linear map of its rows")
    times = {name: len(copies) for name, copies in maps.items()}
    if len({1, *times.values()}) != 2:
        told = " and ".join(f"{name} {many} times" for name, many in times.items())
        raise UserError(f"the function returns the rows of {told}; return all rows, then as many copies of each")
    wanted = {"identity": {name: np.eye(numbers[name].width) for name in maps}}
    wanted |= {element.name: {name: map_of(numbers[name], element) for name in maps} for element in body.elements}
    found = [dict(zip(maps, copy, strict=True)) for copy in zip(*maps.values(), strict=True)]
    return [_judged(copy, wanted, numbers, k == 0) for k, copy in enumerate(found)]


def _judged(maps: dict[str, Floats], wanted: dict[str, dict[str, Floats]], numbers: Numbers, first: bool) -> Copy:
    """Return what a copy is, by the element of which most of its numbers are right."""

    def off(element: str, name: str) -> Any:
        return np.flatnonzero(np.abs(maps[name] - wanted[element][name]).max(1) > _TOLERANCE)

    nearest = min(
        [element for element in wanted if (element == "identity") == first] or list(wanted),
        key=lambda element: sum(len(off(element, name)) for name in maps),
    )
    wrong = []
    for name, made in maps.items():
        labels = labels_of(numbers[name])
        right = wanted[nearest][name]
        wrong += [(labels[k], _words(made[k], labels), _words(right[k], labels)) for k in off(nearest, name)]
    involution = all(np.abs(made @ made - np.eye(len(made))).max() < _TOLERANCE for made in maps.values())
    return Copy(nearest, involution, tuple(name for name in numbers if name not in maps), tuple(wrong))


def _words(row: Floats, labels: list[str]) -> str:
    """Return what a number is made of: "-positions.right_hip"."""
    sizes = [(row[k], labels[k]) for k in np.flatnonzero(np.abs(row) > _TOLERANCE)]
    words = [("-" if x < 0 else "") + ("" if abs(abs(x) - 1) < _TOLERANCE else f"{abs(x):.3g} ") + y for x, y in sizes]
    return " + ".join(words[:3]) + (" + ..." if len(words) > 3 else "") or "0"


def _called(function: Callable[..., Any], numbers: Numbers, rows: dict[str, Tensor]) -> dict[str, Tensor]:
    """Call a function as its parameters ask for, and return observations by group and actions."""
    groups = [name for name in numbers if name != ACTION]
    try:
        takes = inspect.signature(function).parameters
    except (ValueError, TypeError) as error:
        raise UserError(f"{last_line(error)}; give a function of Python that calls it") from None
    terms = {group: [field.name for field in numbers[group].fields] for group in groups}
    env = SimpleNamespace(observation_manager=SimpleNamespace(active_terms=terms))
    env.unwrapped = env
    known = [name for name in takes if name in (*_OBS, *_ACTIONS, "env")]
    if any(one.kind is one.VAR_KEYWORD for one in takes.values()) and ("env" in known or len(takes) == 1):
        known += [name for name in ("env", "obs", "actions") if name not in known]  # as rsl_rl calls it

    def call(seen: Any) -> Any:
        given = dict.fromkeys(_OBS, seen) | dict.fromkeys(_ACTIONS, rows[ACTION].clone()) | {"env": env}
        return function(**{name: given[name] for name in known}) if known else function(rows[ACTION].clone())

    errors = list[BaseException]()
    for seen in _forms(rows, groups):
        try:
            result = call(seen)
            break
        except (Exception, SystemExit) as error:
            errors.append(error)
    else:
        why = last_line(errors[0])
        raise UserError(f"the function raises {why}; it was given {', '.join(known) or ACTION}") from errors[0]
    results = tuple(result) if isinstance(result, tuple | list) else (result,)
    if not (seeing := set(known) & set(_OBS)):
        results = (None, results[-1])
    given, acted = (*results, None)[:2]
    try:
        told = groups if seeing else []
        found = {group: given if isinstance(given, Tensor) else given[group] for group in told}
    except (KeyError, IndexError, TypeError, RuntimeError):
        found = {"": None}
    if not all(isinstance(made, Tensor) for made in found.values()) or (isinstance(given, Tensor) and len(found) > 1):
        expected = f"a tensor, or tensors by group ({', '.join(groups)})"
        raise UserError(f"the function returns {type(given).__name__} as observations; return {expected}")
    if seeing and not set(known) & set(_ACTIONS):
        return found
    if not isinstance(acted, Tensor):
        raise UserError(f"the function returns {type(acted).__name__} as actions; return a tensor")
    return found | {ACTION: acted}


def _forms(rows: dict[str, Tensor], groups: list[str]) -> Iterator[Any]:
    """Yield observations as versions of rsl_rl hand them over: those of a single group as a tensor, all by group."""
    if len(groups) < 2:
        yield rows[groups[0]].clone() if groups else None
    try:
        from tensordict import TensorDict  # noqa: PLC0415 - an extra
    except ImportError:
        if len(groups) < 2:
            return
        raise UserError("groups of observations are handed over as a TensorDict; pip install tensordict") from None
    yield TensorDict({group: rows[group].clone() for group in groups}, batch_size=[len(rows[ACTION])])
