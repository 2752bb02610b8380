"""What the numbers of observations and actions are, for files that are written and functions that are audited.

def numbers(body):  # in a module of yours: --order my_robot:numbers
joints = ["left_hip", "right_hip"]
return {
"policy": layout(body.spin(), body.gravity(), body.positions(joints)),
"action": layout(body.positions(joints)),
}
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from esp_cli.bodies.body import Body
from esp_cli.bodies.kinds import PartsKind
from esp_cli.files.opening import read_regular
from esp_cli.symmetry.elements import Element, Floats
from esp_cli.symmetry.plane import PlaneElement
from esp_cli.symmetry.representation import layout_operator
from esp_envs.errors import UserError
from esp_envs.installed import import_function, last_line
from esp_envs.spec import Layout, layout

_MOST_BYTES = 1 << 20
ACTION = "action"  # the name of the actions among groups of observations
Numbers = dict[str, Layout]  # layouts of the groups of an observation, by name, and of the action under "action"


def numbers_of(body: Body, order: str | None) -> Numbers:
    """Return what a function "module:function" says, or the numbers of Isaac Lab's velocity tasks.

    `order` is that function, or a file of joint names in the simulator's order, one a line; else it is the model's.
    """
    if order is None or ":" not in order or Path(order).exists():
        names = None if order is None else _lines(Path(order))
        actions = body.positions(names, name="actions")
        joints = [body.positions(names), body.velocities(names), actions]
        seen = layout(body.velocity(), body.spin(), body.gravity(), body.command(), *joints)
        return {"policy": seen, ACTION: layout(actions)}
    function = import_function(order)
    try:
        told = function(body)
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise UserError(f"{order} raises {last_line(error)}; it was given the body") from error
    if not isinstance(told, dict) or not all(isinstance(part, Layout) for part in told.values()) or ACTION not in told:
        raise UserError(
            f"{order} returns {type(told).__name__}; return layouts of observations by name, and of 'action'"
        )
    return told


def _lines(path: Path) -> list[str]:
    """Return the joint names of a file, one a line."""
    with suppress(UnicodeDecodeError):
        lines = (read_regular(path, _MOST_BYTES) or b"").decode("utf-8-sig").splitlines()
        if names := [line.strip() for line in lines if line.strip()]:
            return names
    raise UserError(f"{path} is no list of joints; write their names in your simulator's order, one a line")


def map_of(numbers: Layout, element: PlaneElement) -> Floats:
    """Return the matrix [D, D] of an element on rows of a layout."""
    return layout_operator(numbers, [Element.of(element)]).matrix[0]


def labels_of(numbers: Layout) -> list[str]:
    """Return what each number is called: "positions.left_hip", "spin[2]"."""
    labels = []
    for field in numbers.fields:
        if isinstance(field.kind, PartsKind):
            labels += [f"{field.name}.{part}" for part in field.kind.parts * field.count]
        else:
            labels += [f"{field.name}[{k}]" for k in range(field.width)]
    return labels
