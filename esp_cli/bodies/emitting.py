"""Write the mirrors of a robot as a file that the loops of others import: it needs torch or numpy alone."""

from __future__ import annotations

import pprint
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.bodies import written
from esp_cli.bodies.body import Body
from esp_cli.bodies.terms import Numbers, map_of
from esp_cli.defaults import __version__
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Layout

HOSTS = {
    "rsl_rl": "compute_symmetric_states",
    "isaaclab": "compute_symmetric_states",
    "mjlab": "compute_symmetric_states",
    "skrl": "augment",
    "sb3": "augment",
    "numpy": "mirrored",
}
"""Loops, and the function of the file that they call."""


def emitted(body: Body, numbers: Numbers, model: str) -> str:
    """Return the source of a file with the mirrors of observations and actions, as `written` computes them.

    Args:
        body: of the robot.
        numbers: what its observations and actions are.
        model: the name of the model, for the file.

    Raises:
        UserError: the body has no symmetry.
    """
    if not body.elements:
        raise UserError(f"{model} has no symmetry, so there is no mirror to write")
    data = {
        "MODEL": model,
        "MADE_BY": f"esp mirror {__version__}",
        "ELEMENTS": tuple(element.name for element in body.elements),
        "PROOF": {name: f"{found.proof.verdict}: accelerations agree to {found.proof.gap:.2g} at the worst joint"
                  for name, found in body.found.items()},
        "NUMBERS": numbers.labels,
        "OBSERVATIONS": {group: _moves(body, layout) for group, layout in numbers.groups.items()},
        "ACTIONS": _moves(body, numbers.action),
    }  # fmt: skip
    # names of strangers enter as Python literals alone
    printed = {name: pprint.pformat(value, width=116, compact=True, sort_dicts=False) for name, value in data.items()}
    lines = [f"{name} = {text}" for name, text in printed.items()]
    template = Path(written.__file__).read_text(encoding="utf-8").splitlines()
    return "\n".join("\n".join(lines) if line.endswith("# DATA") else line for line in template) + "\n"


def _moves(body: Body, layout: Layout) -> dict[str, Any]:
    """Return for each element where new numbers come from and with which signs; a matrix where it mixes numbers."""
    return {element.name: _move(layout, element) for element in body.elements}


def _move(layout: Layout, element: PlaneElement) -> dict[str, Any]:
    matrix = map_of(layout, element)
    sign = np.rint(matrix.sum(1)).astype(int)
    if np.count_nonzero(matrix) > len(matrix) or not np.array_equal(np.abs(matrix).max(1), np.abs(sign)):
        return {"matrix": np.round(matrix, 12).tolist(), "sign": [1] * len(matrix)}
    return {"source": np.abs(matrix).argmax(1).tolist(), "sign": sign.tolist()}
