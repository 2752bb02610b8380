"""Write the mirrors of a robot as a file that the loops of others import: it needs torch or numpy alone."""

from __future__ import annotations

import pprint
from collections.abc import Mapping, Sequence
from copy import copy
from importlib.abc import Loader
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import cast

import numpy as np

from esp_cli.bodies import proven, written
from esp_cli.bodies.body import Body
from esp_cli.bodies.kinds import PartsKind
from esp_cli.bodies.numbers import ACTION, Numbers, labels_of, map_of
from esp_cli.defaults import __version__
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.plane import PlaneElement
from esp_cli.symmetry.representation import Operator
from esp_envs.errors import UserError

HOSTS = dict.fromkeys(("rsl_rl", "isaaclab", "mjlab"), "compute_symmetric_states")
HOSTS |= {"skrl": "augment", "sb3": "augment", "numpy": "mirrored"}
"""Loops, and the function of the file that they call."""


def carried(body: Body, numbers: Numbers) -> Body:
    """Return the body with those elements alone that all numbers carry: a scan may carry fewer than the body has."""
    kinds = [field.kind for layout in numbers.values() for field in layout.fields]
    moves = [dict(kind.moves) for kind in kinds if isinstance(kind, PartsKind)]
    own = copy(body)
    own.elements = tuple(element for element in body.elements if all(element in by for by in moves))
    if body.elements and not own.elements:
        raise UserError(f"the numbers carry no element of {body.group} together; leave a field of points out")
    own.found = {element.name: body.found[element.name] for element in own.elements if element.name in body.found}
    return own


def emitted(body: Body, numbers: Numbers, model: str) -> str:
    """Return the source of a file with the mirrors of a model's observations and actions, as `written` has them."""
    return _filled(written, _data(body, numbers, model, body.elements))


def mirror_of(body: Body, numbers: Numbers, group: str | None = None) -> ModuleType:
    """Return what an `emitted` file would be once imported, without one: ELEMENTS, `mirrored`, `augment` and others.

    Its `group` are the elements that leave your reward alone, such as "left-right"; by default all that the body has
    and the numbers carry. A body without a symmetry, or without an element of the group, is a UserError.
    """
    body = carried(body, numbers)
    wanted = body.elements
    if group is not None:
        parsed = parse_elements(group, 1)
        if not isinstance(parsed, tuple) or any(element.orders for element in parsed):
            raise UserError(
                f"'{group}' is no list of turns and mirrors; write some of {', '.join(g.name for g in wanted)}"
            )
        wanted = tuple(element for element in map(PlaneElement.of, parsed) if element != PlaneElement())
        if missing := [element.name for element in wanted if element not in body.elements]:
            raise UserError(f"the body has no {missing[0]}; its group is {body.group}")
    module = module_from_spec(written.__spec__)
    cast("Loader", written.__spec__.loader).exec_module(module)
    vars(module).update(_data(body, numbers, "the body", wanted))
    return module


def _data(body: Body, numbers: Numbers, model: str, elements: Sequence[PlaneElement]) -> dict[str, object]:
    """Return the values of what `written` leaves open."""
    if not elements:
        late = next((f"; {reason}" for reason in body.not_covered.values()), "")
        raise UserError(f"{model} has no symmetry that was found, so there is no mirror to write{late}")
    moves = {
        name: {element.name: _move(map_of(layout, element)) for element in elements} for name, layout in numbers.items()
    }
    return {
        "MODEL": model,
        "MADE_BY": f"esp mirror {__version__}",
        "ELEMENTS": tuple(element.name for element in elements),
        "PROOF": {name: _proven(body, name) for name in body.found},
        "NUMBERS": {name: labels_of(layout) for name, layout in numbers.items()},
        "ACTIONS": moves.pop(ACTION),
        "OBSERVATIONS": moves,
    }


def _proven(body: Body, element: str) -> str:
    unseen = ", ".join(body.unseen(element))
    return f"accelerations agree to {body.found[element].proof.gap:.2g}" + f"; not covered: {unseen}" * bool(unseen)


def proof(body: Body, numbers: Numbers, file: str) -> str:
    """Return the source of tests for an `emitted` file of a name, with a row of each group and its images."""
    recorded, generator = {}, np.random.default_rng(0)
    for name, layout in numbers.items():
        row = generator.standard_normal(layout.width).round(3)
        images = {element.name: (map_of(layout, element) @ row).round(12).tolist() for element in body.elements}
        recorded[name] = {"row": row.tolist(), **images}
    return _filled(proven, {"MIRROR": file, "RECORDED": recorded})


def _filled(module: ModuleType, data: Mapping[str, object]) -> str:
    """Return the source of a module with its data; names of strangers enter as Python literals alone."""
    lines = [
        f"{name} = {pprint.pformat(value, width=110, compact=True, sort_dicts=False)}" for name, value in data.items()
    ]
    template = Path(str(module.__file__)).read_text(encoding="utf-8").splitlines()
    return "\n".join("\n".join(lines) if line.endswith("# DATA") else line for line in template) + "\n"


def _move(matrix: Floats) -> tuple[list[list[int]], list[list[float]]]:
    """Return where new numbers come from and times what, in as many terms as the widest sum has: mostly one."""
    terms = Operator.of_block(np.round(matrix, 12))
    factor = terms.weight[0].T.tolist()
    return terms.source[0].T.tolist(), [[int(x) if x == int(x) else x for x in times] for times in factor]
