"""What the numbers of an observation and an action are, as a simulator orders them: a JSON file to layouts.

{"joints": ["left_hip", "right_hip"],
"observations": {"policy": ["base_lin_vel", "joint_pos", {"term": "contacts", "names": ["left_foot", "right_foot"]}]}}
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from esp_cli.bodies import kinds
from esp_cli.bodies.body import Body
from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Element, Floats
from esp_cli.symmetry.plane import PlaneElement
from esp_cli.symmetry.representation import layout_operator
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind, Layout

_DEFAULT = [
    "base_lin_vel",
    "base_ang_vel",
    "projected_gravity",
    "velocity_commands",
    "joint_pos",
    "joint_vel",
    "actions",
]
"""The terms of Isaac Lab's velocity tasks on flat ground."""
_SPACE = {
    "base_lin_vel": kinds.VECTOR_3D,
    "base_ang_vel": kinds.AXIAL_3D,
    "projected_gravity": kinds.VECTOR_3D,
    "velocity_commands": kinds.PLANAR_COMMAND,
    "command": kinds.PLANAR_COMMAND,
    "vector": kinds.VECTOR_3D,
    "axial": kinds.AXIAL_3D,
    "quaternion": kinds.QUATERNION,
    "quaternion_xyzw": kinds.QUATERNION_XYZW,
    "attitude_6d": kinds.ATTITUDE_6D,
    "planar": Kind.VECTOR,
    "scalar": Kind.SCALAR,
    "pseudoscalar": Kind.PSEUDOSCALAR,
}
_JOINTS = {"joint_pos": "positions", "joint_vel": "velocities", "joint_torque": "velocities"}
TERMS = (*_SPACE, *_JOINTS, "actions", "contacts", "height_scan")
"""What a term may be."""


@dataclass(frozen=True)
class Numbers:
    """Layouts of the groups of an observation, by name, and of the action; names of single numbers for messages."""

    groups: dict[str, Layout]
    action: Layout
    labels: dict[str, tuple[str, ...]]
    grouped: bool


def read_numbers(body: Body, path: Path | None) -> Numbers:
    """Read what a file says of the numbers; without one, they are those of Isaac Lab's velocity tasks.

    Raises:
        UserError: the file is no such JSON, a term is unknown, or the body cannot mirror it.
    """
    told: dict[str, Any] = {}
    if path is not None:
        try:
            told = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise UserError(f"{path} is not JSON: {error}") from None
        except OSError as error:
            raise UserError(f"{path} cannot be read: {error.strerror}") from None
    if not isinstance(told, dict) or (wrong := set(told) - {"joints", "actions", "observations"}):
        wrong_key = f"'{sorted(wrong)[0][:40]}'" if isinstance(told, dict) else "something else"
        raise UserError(f"{path} holds {wrong_key}; it may hold joints, actions and observations")
    joints = _names(told.get("joints", body.joints), "joints")
    acted = _names(told.get("actions", joints), "actions")
    given = told.get("observations", _DEFAULT)
    groups = given if isinstance(given, dict) else {"policy": given}
    labels: dict[str, tuple[str, ...]] = {}
    layouts = {}
    for group, terms in groups.items():
        if not isinstance(terms, list) or not terms:
            raise UserError(f"observations '{group[:40]}' are no list of terms; write for example {_DEFAULT[:3]}")
        made = [_term(body, term, joints, acted) for term in terms]
        layouts[group] = Layout(tuple(field for field, _ in made))
        labels[group] = tuple(f"{field.name}.{part}" for field, parts in made for part in parts)
    field, parts = _acted(body, acted, "action", 1)
    labels[""] = tuple(f"action.{part}" for part in parts)
    return Numbers(layouts, Layout((field,)), labels, isinstance(given, dict))


def map_of(layout: Layout, element: PlaneElement) -> Floats:
    """Return the matrix [D, D] of an element on rows of a layout."""
    return layout_operator(layout, [Element.of(element)]).matrix[0]


def _names(given: object, what: str) -> Sequence[str]:
    if not isinstance(given, list | tuple) or not given or not all(isinstance(x, str) for x in given):
        raise UserError(f'\'{what}\' is no list of names; write for example ["left_hip", "right_hip"]')
    return given


def _term(body: Body, given: object, joints: Sequence[str], acted: Sequence[str]) -> tuple[Field, Sequence[str]]:
    """Return the field of a term, and what its numbers are called.

    Raises:
        UserError: it is none.
    """
    told: dict[str, Any] = {"term": given} if isinstance(given, str) else given if isinstance(given, dict) else {}
    term, history = told.get("term"), told.get("history", 1)
    name, count, width = told.get("name", term), told.get("count", 1), told.get("width", 1)
    if term not in TERMS or not isinstance(name, str):
        raise UserError(f"'{str(given)[:60]}' is no term; a term is {', '.join(TERMS)}")
    if not all(isinstance(x, int) and 0 < x <= 10_000 for x in (history, count, width)):
        raise UserError(f"term '{name[:40]}': history, count and width are whole numbers from 1")
    if term in _SPACE:
        kind = _SPACE[term]
        parts = [f"{k}" for k in range(count * kind.width)] if kind.width != 3 else [*"xyz"] * count
        return Field(name, kind, count * history), [*parts] * history
    if term == "actions":
        return _acted(body, acted, name, history)
    if term == "contacts":
        limbs = _names(told.get("names"), "names")
        parts = [f"{printable(limb)}{f'[{k}]' if width > 1 else ''}" for limb in limbs for k in range(width)]
        return body.contacts(limbs, width, history, name), parts * history
    if term == "height_scan":
        points = told.get("points")
        if points is None:
            size, resolution = told.get("size", (1.6, 1.0)), told.get("resolution", 0.1)
            points = kinds.grid(size, resolution, told.get("ordering", "xy"))
        field = body.scan(points, history, name)
        return field, [f"{k}" for k in range(field.width)]
    names = _names(told.get("names", joints), "names")
    field = getattr(body, _JOINTS[term])(names, history, name)
    return field, _parts(names, field, history)


def _acted(body: Body, names: Sequence[str], name: str, history: int) -> tuple[Field, Sequence[str]]:
    """Return the field of actions: by joint, or by actuator where the names are theirs alone."""
    by_joint = all(x in body.joints for x in names)
    field = body.positions(names, history, name) if by_joint else body.controls(names, history, name)
    return field, _parts(names, field, history)


def _parts(names: Sequence[str], field: Field, history: int) -> list[str]:
    if field.item_width == len(names):
        return [printable(name) for name in names] * history
    return [f"{k}" for k in range(field.width)]
