"""Parts of a body (joints, actuators, limbs) by name, and what elements do to their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from esp_cli.bodies import kinds
from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.groups import FiniteGroup
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.plane import BODY_NAMES, PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Field


@dataclass(frozen=True)
class Parts:
    """Some parts of a body, where the numbers of each are, and matrices over all of them.

    Attributes:
        what: what messages call them: "joints".
        places: the numbers of each part, by its name.
        moves: what each element does to the numbers.
    """

    what: str
    places: Mapping[str, slice]
    moves: Mapping[PlaneElement, Floats]

    def field(self, name: str, names: Sequence[str], history: int, width: int = 1) -> Field:
        """Return a field of some parts, in this order, each with `width` numbers of its own.

        Raises:
            UserError: a part is unknown or named twice, or its image is not among them.
        """
        if unknown := next((n for n in names if n not in self.places), None):
            known = ", ".join(map(printable, list(self.places)[:8])) + (", ..." if len(self.places) > 8 else "")
            raise UserError(f"field '{name}': there is no {printable(unknown)} among the {self.what} {known}")
        if len(set(names)) < len(names):
            raise UserError(f"field '{name}' names one of the {self.what} twice")
        spans = [np.r_[self.places[n]] for n in names]
        owner = [printable(n) for n, span in zip(names, spans, strict=True) for _ in span]
        index, moves = np.concatenate(spans) if spans else np.zeros(0, int), {}
        for element, matrix in self.moves.items():
            block = matrix[np.ix_(index, index)]
            if not np.allclose(block.T @ block, np.eye(len(index)), atol=1e-6):
                lost = owner[int(np.abs(block).sum(0).argmin())]
                raise UserError(f"field '{name}': the image of {lost} under {element.name} is not among them")
            moves[element] = np.kron(block, np.eye(width)).astype(np.float64)
        return kinds.parts_field(name, self.what, [part for part in owner for _ in range(width)], moves, history)


def named_parts(what: str, names: Sequence[str], tables: Mapping[str, Any]) -> Parts:
    """Return parts of one number each, with what tables of names say, and their products.

    Args:
        what: what messages call them.
        names: of all of them, in any order.
        tables: by part its image, with "-" where the sign changes; or such tables by element. What is left out of a
            table follows from its partner.

    Raises:
        UserError: a table names none of them, sends two to one, or does not multiply as the elements do.
    """
    if tables and all(isinstance(value, str) for value in tables.values()):
        tables = {"left-right": tables}
    generators = {_element_of(word): _matrix(what, names, table) for word, table in tables.items()}
    group = FiniteGroup.generated_by("the body", list(generators))
    moves: dict[PlaneElement, Floats] = {PlaneElement(): np.eye(len(names))}
    while len(moves) < group.order:
        moves = moves | {g @ h: A @ B for g, A in generators.items() for h, B in moves.items()}
    for g, A in moves.items():
        for h, B in moves.items():
            if not np.array_equal(moves[g @ h], A @ B):
                raise UserError(f"the tables do not multiply as {g.name} and {h.name} do; correct a name or a sign")
    del moves[PlaneElement()]
    return Parts(what, {name: slice(i, i + 1) for i, name in enumerate(names)}, moves)


def _element_of(word: str) -> PlaneElement:
    """Return the element of a robot's word, "left-right", or of the plane's, "flip-x"."""
    found = parse_elements(word, 1)
    if not isinstance(found, tuple) or len(found) != 1 or len(found[0].geometry) != 1 or found[0].orders:
        raise UserError(f"'{word}' is not one turn or mirror; write {', '.join(BODY_NAMES)} or rot60")
    return PlaneElement.of(found[0])


def _matrix(what: str, names: Sequence[str], table: Mapping[str, str]) -> Floats:
    """Return the signed permutation of a table, completed by the partners of those that it names."""
    images = dict(table)
    for part, image in table.items():
        target = image.removeprefix("-")
        images.setdefault(target, image.removesuffix(target) + part)
    matrix = np.zeros((len(names), len(names)))
    for part, image in images.items():
        target = image.removeprefix("-")
        if unknown := next((n for n in (part, target) if n not in names), None):
            raise UserError(f"the mirror names {printable(unknown)}, which is none of the {what}")
        matrix[names.index(target), names.index(part)] = 1.0 if image == target else -1.0
    wrong = np.flatnonzero((np.abs(matrix).sum(0) != 1) | (np.abs(matrix).sum(1) != 1))
    if len(wrong):
        raise UserError(f"the mirror sends none of the {what}, or several, to or from {printable(names[wrong[0]])}")
    return matrix
