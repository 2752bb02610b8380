"""What elements do to the parts of a body that is given by names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.groups import FiniteGroup
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError

NAMES = {"left-right": "flip-x", "front-back": "flip-y", "half-turn": "rot180", "quarter-turn": "rot90"}
"""What a robot that faces x calls elements."""


@dataclass(frozen=True)
class Moves:
    """What one element does to a body: matrices over positions, velocities, actuators; the image of each limb."""

    positions: Floats
    velocities: Floats
    actuators: Floats
    limbs: dict[str, str]


def element_of(word: str) -> PlaneElement:
    """Return the element of a robot's word, "left-right", or of a plane's, "flip-x".

    Raises:
        UserError: it is neither.
    """
    found = parse_elements(NAMES.get(word, word), 1)
    if not isinstance(found, tuple) or len(found) != 1 or len(found[0].geometry) != 1 or found[0].orders:
        raise UserError(f"'{word}' is not one turn or mirror; write {', '.join(NAMES)} or rot60")
    return PlaneElement.of(found[0])


def by_element(tables: Mapping[str, Any]) -> dict[PlaneElement, Mapping[str, str]]:
    """Return tables by element; one table alone is that of left-right."""
    if all(isinstance(value, str) for value in tables.values()):
        return {element_of("left-right"): tables} if tables else {}
    return {element_of(word): table for word, table in tables.items()}


def moves_of(joints: Sequence[str], table: Mapping[str, str], limbs: Mapping[str, str]) -> Moves:
    """Return what a table of names says, completed by the partners of those that it names."""
    images = dict(table)
    for joint, image in table.items():
        images.setdefault(image.lstrip("-"), image[: len(image) - len(image.lstrip("-"))] + joint)
    matrix = np.zeros((len(joints), len(joints)))
    for joint, image in images.items():
        sign, target = (-1.0, image[1:]) if image.startswith("-") else (1.0, image)
        for name in (joint, target):
            if name not in joints:
                raise UserError(f"the mirror names {printable(name)}, which is none of the joints")
        matrix[joints.index(target), joints.index(joint)] = sign
    if not np.array_equal(np.abs(matrix).sum(0), np.ones(len(joints))) or not (np.abs(matrix).sum(1) == 1).all():
        lost = next(j for j, into, out in zip(joints, np.abs(matrix).sum(1), np.abs(matrix).sum(0), strict=True)
                    if into != 1 or out != 1)  # fmt: skip
        raise UserError(f"the mirror sends no joint, or several, to or from {printable(lost)}; name each once")
    ends = dict(limbs) | {image: limb for limb, image in limbs.items() if image not in limbs}
    return Moves(matrix, matrix, matrix, ends)


def closed(generators: dict[PlaneElement, Moves]) -> dict[PlaneElement, Moves]:
    """Return all products of some elements, with what they do.

    Raises:
        UserError: two products of one element do different things.
    """
    if not generators:
        return {}
    group = FiniteGroup.generated_by("the body", list(generators))
    size = len(next(iter(generators.values())).positions)
    limbs = {x: x for move in generators.values() for x in move.limbs}
    moves = {PlaneElement(): Moves(np.eye(size), np.eye(size), np.eye(size), limbs)}
    while len(moves) < group.order:
        for g, made in generators.items():
            for h, before in list(moves.items()):
                matrix = made.positions @ before.positions
                ends = {x: made.limbs.get(y, y) for x, y in before.limbs.items()}
                moves.setdefault(g @ h, Moves(matrix, matrix, matrix, ends))
    for g, first in moves.items():
        for h, second in moves.items():
            if not np.array_equal(moves[g @ h].positions, first.positions @ second.positions):
                raise UserError(f"the tables do not multiply as {g.name} and {h.name} do; correct a joint or a sign")
    del moves[PlaneElement()]
    return moves
