"""What the numbers of observations and actions are, for files that are written and functions that are audited.

def numbers(body):  # in a module of yours: --numbers my_robot:numbers
joints = ["left_hip", "right_hip"]
return {
"policy": layout(body.spin(), body.gravity(), body.positions(joints)),
"action": layout(body.positions(joints)),
}
"""

from __future__ import annotations

from esp_cli.bodies.body import Body
from esp_cli.bodies.kinds import PartsKind
from esp_cli.symmetry.elements import Element, Floats
from esp_cli.symmetry.plane import PlaneElement
from esp_cli.symmetry.representation import layout_operator
from esp_envs.errors import UserError
from esp_envs.installed import import_function
from esp_envs.spec import Layout, layout

ACTION = "action"
"""The name of the actions among groups of observations."""
Numbers = dict[str, Layout]
"""Layouts of the groups of an observation, by name, and of the action under "action"."""


def numbers_of(body: Body, name: str | None) -> Numbers:
    """Return what a function "module:function" says; without one, the numbers of Isaac Lab's velocity tasks.

    Raises:
        UserError: there is no such function, or it returns something else.
    """
    if name is None:
        joints = [body.positions(), body.velocities(), body.positions(name="actions")]
        seen = layout(body.velocity(), body.spin(), body.gravity(), body.command(), *joints)
        return {"policy": seen, ACTION: layout(body.positions(name="actions"))}
    told = import_function(name)(body)
    if not isinstance(told, dict) or not all(isinstance(part, Layout) for part in told.values()) or ACTION not in told:
        raise UserError(
            f"{name} returns {type(told).__name__}; return layouts of observations by name, and of 'action'"
        )
    return told


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
