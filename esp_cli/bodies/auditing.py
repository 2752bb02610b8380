"""Audit a mirror that somebody wrote: which element is each of its copies, and which numbers of it are wrong."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from esp_cli.bodies.body import Body
from esp_cli.bodies.terms import Numbers, map_of
from esp_cli.symmetry.elements import Floats
from esp_envs.errors import UserError
from esp_envs.installed import last_line

_OBS = ("obs", "observations", "observation", "states", "state")
_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Copy:
    """What one copy of a mirror function turned out to be.

    Attributes:
        element: the element that it comes nearest to; "identity" of the first.
        is_involution: whether it undoes itself, as a mirror does.
        wrong: of each wrong number its name, what it takes, and what is right: ("joint_pos.hip", "hip", "-hip").
    """

    element: str
    is_involution: bool
    wrong: tuple[tuple[str, str, str], ...]


def named_function(name: str) -> Callable[..., Any]:
    """Import "module:function", with the working directory first, as for a script.

    Raises:
        UserError: there is none.
    """
    if not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", name):
        raise UserError(
            f"'{name[:80]}' names no function; write module:function, as in symmetry:compute_symmetric_states"
        )
    module, attribute = name.split(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        found = getattr(import_module(module), attribute, None)
    except (Exception, SystemExit) as error:
        raise UserError(f"cannot import the module '{module}': {last_line(error)}") from error
    finally:
        sys.path.remove(str(Path.cwd()))
    if not callable(found):
        raise UserError(f"the module '{module}' has no function '{attribute}'; check the name after the colon")
    return found


def audit(function: Callable[..., Any], body: Body, numbers: Numbers) -> list[Copy]:
    """Compare each copy that a function makes with the body's elements.

    The function is called as rsl_rl calls it, with what it takes of `env`, `obs` and `actions`. It is given unit
    vectors, so that each number of its results tells where it comes from.

    Raises:
        UserError: it fails, returns something else, or is not linear.
    """
    widths = {group: layout.width for group, layout in numbers.groups.items()}
    units = {
        group: torch.eye(max(*widths.values(), numbers.action.width))[:, :width] for group, width in widths.items()
    }
    rows = len(next(iter(units.values())))
    seen, acted = _called(function, numbers, units, torch.eye(rows)[:, : numbers.action.width])
    parts = {"": (acted, numbers.action)} if acted is not None else {}
    parts |= {group: (seen[group], layout) for group, layout in numbers.groups.items() if group in seen}
    if not parts:
        raise UserError("the function returns neither observations nor actions as tensors [copies * rows, width]")
    for group, (made, layout) in parts.items():
        if made.shape[1:] != (layout.width,) or len(made) % rows or not len(made):
            what = f"observations '{group}'" if group else "actions"
            raise UserError(f"the function returns {what} {list(made.shape)}; {rows} rows of {layout.width} were given")
    _check_linear(function, numbers, units, parts, rows)
    wanted = {"identity": {group: np.eye(layout.width) for group, (_, layout) in parts.items()}}
    for element in body.elements:
        wanted[element.name] = {group: map_of(layout, element) for group, (_, layout) in parts.items()}
    found = []
    for copy in range(min(len(made) // rows for made, _ in parts.values())):
        maps = {group: _matrix(made, layout.width, copy, rows) for group, (made, layout) in parts.items()}
        found.append(_judged(maps, wanted, numbers, copy))
    return found


def _matrix(made: Tensor, width: int, copy: int, rows: int) -> Floats:
    """Return the matrix of one copy: image of unit vector j in column j."""
    return made[copy * rows : copy * rows + width].double().numpy().T


def _judged(maps: dict[str, Floats], wanted: dict[str, dict[str, Floats]], numbers: Numbers, copy: int) -> Copy:
    """Return what a copy is, by the element of which most of its numbers are right."""

    def off(name: str) -> int:
        return sum(int((np.abs(maps[g] - wanted[name][g]).max(1) > _TOLERANCE).sum()) for g in maps)

    names = [name for name in wanted if (name == "identity") == (copy == 0)] or list(wanted)
    name = min(names, key=off)
    wrong = []
    for group, made in maps.items():
        right, labels = wanted[name][group], numbers.labels[group]
        places = np.flatnonzero(np.abs(made - right).max(1) > _TOLERANCE)
        wrong += [(labels[k], _words(made[k], labels), _words(right[k], labels)) for k in places]
    involution = all(np.abs(made @ made - np.eye(len(made))).max() < _TOLERANCE for made in maps.values())
    return Copy(name, involution, tuple(wrong))


def _words(row: Floats, labels: tuple[str, ...]) -> str:
    """Return what a number is made of: "-joint_pos.right_hip"."""
    sizes = [(row[k], labels[k]) for k in np.flatnonzero(np.abs(row) > _TOLERANCE)]
    words = [("-" if x < 0 else "") + ("" if abs(abs(x) - 1) < _TOLERANCE else f"{abs(x):.3g} ") + y for x, y in sizes]
    return " + ".join(words[:3]) + (" + ..." if len(words) > 3 else "") or "0"


def _called(
    function: Callable[..., Any], numbers: Numbers, obs: dict[str, Tensor], actions: Tensor
) -> tuple[dict[str, Tensor], Tensor | None]:
    """Call a function as its parameters ask for, and return observations by group and actions."""
    takes = list(inspect.signature(function).parameters)
    first = next(iter(obs))
    given: Any = obs[first].clone()
    if numbers.grouped:
        try:
            from tensordict import TensorDict  # noqa: PLC0415 - an extra
        except ImportError:
            raise UserError("groups of observations are handed over as a TensorDict; pip install tensordict") from None
        given = TensorDict({group: rows.clone() for group, rows in obs.items()}, batch_size=[len(obs[first])])
    terms = {group: [field.name for field in layout.fields] for group, layout in numbers.groups.items()}
    env = SimpleNamespace(observation_manager=SimpleNamespace(active_terms=terms))
    env.unwrapped = env
    values = dict.fromkeys(_OBS, given) | {"env": env, "actions": actions.clone(), "action": actions.clone()}
    known = {name: values[name] for name in takes if name in values}
    try:
        result = function(**known) if known else function(actions.clone())
    except Exception as error:
        raise UserError(
            f"the function raises {last_line(error)}; it was given {', '.join(known) or 'actions'}"
        ) from error
    results = result if isinstance(result, tuple | list) else (result,)
    if len(results) == 1 and (not known or set(known) <= {"actions", "action", "env"}):
        results = (None, results[0])
    seen = results[0]
    groups = {} if seen is None else {first: seen} if isinstance(seen, Tensor) else {g: seen[g] for g in obs}
    acted = results[1] if len(results) > 1 else None
    return groups, acted if isinstance(acted, Tensor) else None


def _check_linear(
    function: Callable[..., Any], numbers: Numbers, units: dict[str, Tensor], parts: dict[str, Any], rows: int
) -> None:
    """Refuse a function whose copies of random rows do not follow from those of unit vectors."""
    generator = torch.Generator().manual_seed(0)
    obs = {group: torch.randn(unit.shape, generator=generator) for group, unit in units.items()}
    acted = torch.randn((rows, numbers.action.width), generator=generator)
    seen, moved = _called(function, numbers, obs, acted)
    for group, (made, layout) in parts.items():
        given, got = (acted, moved) if not group else (obs[group], seen[group])
        for k in range(len(made) // rows):
            matrix = torch.as_tensor(_matrix(made, layout.width, k, rows)).float()
            if got is None or (given @ matrix.T - got[k * rows : (k + 1) * rows]).abs().max() > 1e-3:
                raise UserError("the function is not a linear map of its rows, or not the same map at each call")
