"""Kinds of numbers of a robot: vectors of space, and the numbers of its parts: joints, limbs, scanned points.

A turn or mirror of the plane acts on space about the vertical: z stays. Seen from the body, or from the world, a vector
turns alike, since body and surroundings are mirrored together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.groups import FiniteGroup
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.plane import BODY_NAMES, KIND_MATRICES, PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind


def space(planar: Floats) -> Floats:
    """Return the matrix [3, 3] of space of a matrix [2, 2] of the plane."""
    out = np.eye(3)
    out[:2, :2] = planar
    return out


def axial(planar: Floats) -> Floats:
    """Return how axes of turns transform, [3, 3]: a mirror also reverses the sense of a turn."""
    return np.rint(np.linalg.det(planar)) * space(planar) + 0.0


VECTOR_3D = Kind("3-d vector", 3, is_vector=True)
"""(x, y, z) of a place, a velocity, a force, or of gravity as the body sees it."""
AXIAL_3D = Kind("axial vector", 3, is_vector=True)
"""(x, y, z) of an angular velocity or a torque."""
QUATERNION, QUATERNION_XYZW = Kind("quaternion wxyz", 4, is_vector=True), Kind("quaternion xyzw", 4, is_vector=True)
"""The body's attitude in the world, with the real part first or last."""
ATTITUDE_6D = Kind("attitude of 6", 6)
"""The first two columns of the body's rotation matrix, row after row."""
PLANAR_COMMAND = Kind("planar command", 3)
"""(vx, vy, turning rate) that a robot is told."""
TWIST, INERTIA = Kind("twist", 6), Kind("inertia", 10)
"""MuJoCo's numbers of a body in the world's axes: (turn, shift) of `cvel`, (torque, force) of `cfrc_ext`; `cinert`."""


def _inertia(planar: Floats) -> Floats:
    """Return how (xx, yy, zz, xy, xz, yz), mass times place, and mass transform, [10, 10]."""
    turn, rows, columns = space(planar), [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    unit = np.zeros((6, 3, 3))
    unit[range(6), rows, columns] = unit[range(6), columns, rows] = 1
    return block_diag((turn @ unit @ turn.T)[:, rows, columns].T, turn, 1)


KIND_MATRICES |= {
    VECTOR_3D: space,
    AXIAL_3D: axial,
    QUATERNION: lambda planar: block_diag(1, axial(planar)),
    QUATERNION_XYZW: lambda planar: block_diag(axial(planar), 1),
    ATTITUDE_6D: lambda planar: np.kron(space(planar), planar).astype(np.float64),
    TWIST: lambda planar: block_diag(axial(planar), space(planar)),
    INERTIA: _inertia,
    PLANAR_COMMAND: lambda planar: block_diag(planar, np.linalg.det(planar).round()),
}


@dataclass(frozen=True)
class PartsKind(Kind):
    """Numbers of parts that an element sends to each other: joints, actuators, limbs, points around a body.

    Each element has an orthogonal matrix [width, width] in `moves`.
    """

    parts: tuple[str, ...] = ()  # what each number is called
    moves: tuple[tuple[PlaneElement, tuple[tuple[float, ...], ...]], ...] = ()

    def matrix(self, planar: Floats) -> Floats:
        """Return how the numbers of one item transform under a matrix of the plane that is a symmetry of the body."""
        for element, rows in (*self.moves, (PlaneElement(), np.eye(self.width))):
            if np.allclose(element.matrix, planar, atol=1e-9):
                return np.array(rows)
        known = ", ".join(element.name for element, _ in self.moves)
        if not known:
            raise UserError(f"the body has no symmetry for its {self.name}")
        raise UserError(f"the body has no such symmetry for its {self.name}; it has {known}")


def parts_field(name: str, what: str, parts: Sequence[str], moves: Mapping[PlaneElement, Floats], count: int) -> Field:
    """Return a field of `count` items, each the numbers of all parts."""
    if not parts:
        raise UserError(f"field '{name}' has no {what}; name some")
    if count == 0:
        raise UserError(f"field '{name}' has a history of 0 steps; give 1 or more")
    rows = tuple((element, tuple(map(tuple, matrix.tolist()))) for element, matrix in moves.items())
    return Field(name, PartsKind(what, len(parts), parts=tuple(parts), moves=rows), count)


def points_field(
    name: str, points: Sequence[Sequence[float]] | Floats, elements: Sequence[PlaneElement], count: int = 1
) -> Field:
    """Return a field of one number for each of n points around the body, as of a height scan or rays.

    Args:
        name: of the field.
        points: [n, 2] or [n, 3], where they are seen from the body, m; or the directions of rays.
        elements: those that the body has; the field carries those that send points to points.
        count: how many such pictures: steps of a history.

    Raises:
        UserError: no element sends points to points.
    """
    try:
        places = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError):
        places = np.zeros(0)
    if places.ndim != 2 or places.shape[1] not in (2, 3) or not len(places) or not np.isfinite(places).all():
        raise UserError(f"field '{name}': points have shape {list(places.shape)}; give [n, 2] or [n, 3] finite numbers")
    size, moves, refusal = max(np.abs(places).max(), 1e-9), {}, ""
    for element in elements:
        turn = space(element.matrix)[: places.shape[1], : places.shape[1]]
        gap = np.abs((places @ turn.T)[:, None] - places).max(-1) / size
        matrix = (gap < 1e-3).T.astype(np.float64)
        if (matrix.sum(0) == 1).all():
            moves[element] = matrix
        else:
            k = int(gap.min(1).argmax())
            refusal = refusal or f"the image of point {k} under {element.name} is no point, or several"
    if refusal and not moves:
        raise UserError(f"field '{name}': {refusal}")
    return parts_field(name, "points", [str(k) for k in range(len(places))], moves, count)


def grid(size: tuple[float, float], resolution: float, ordering: str = "xy") -> Floats:
    """Return the points [n, 2] of a grid of a size, m, around the body, in the order of Isaac Lab's grid pattern.

    Points are `resolution` m apart; "xy" lets x run fastest, "yx" y. Another ordering, or no point, is a UserError.
    """
    fits = len(size) == 2 and 0 < resolution < np.inf and np.isfinite(size).all() and min(size) >= 0
    if ordering not in ("xy", "yx") or not fits:
        raise UserError(
            f"grid({size}, {resolution}, {ordering!r}) is none; give two sizes, a resolution and 'xy' or 'yx'"
        )
    if any(abs(s / resolution - round(s / resolution)) > 1e-6 for s in size):
        raise UserError(f"grid({size}, {resolution}): no mirror keeps points that miss the edge; give multiples of it")
    x, y = (np.linspace(-s / 2, s / 2, round(s / resolution) + 1) for s in size)
    X, Y = np.meshgrid(x, y, indexing="xy" if ordering == "xy" else "ij")
    return np.stack([X.ravel(), Y.ravel()], -1)


@dataclass(frozen=True)
class Parts:
    """Some parts of a body, where the numbers of each are, and matrices over all of them."""

    what: str  # what messages call them: "joints"
    places: Mapping[str, slice]  # the numbers of each part, by its name
    moves: Mapping[PlaneElement, Floats]  # what each element does to the numbers

    def field(self, name: str, names: Sequence[str], history: int, width: int = 1) -> Field:
        """Return a field of some parts, in this order, each with `width` numbers; their images must be among them."""
        names = _listed(f"field '{name}'", names)
        if unknown := next((n for n in names if n not in self.places), None):
            known = ", ".join(map(printable, list(self.places)[:8])) + (", ..." if len(self.places) > 8 else "")
            raise UserError(f"field '{name}': there is no {printable(unknown)} among the {self.what} {known}")
        if width < 1:
            raise UserError(f"field '{name}' has {width} numbers of each; give a width of 1 or more")
        spans = [np.r_[self.places[n]] for n in names]
        owner = [printable(n) for n, span in zip(names, spans, strict=True) for _ in span]
        index, moves = np.concatenate(spans) if spans else np.zeros(0, int), {}
        for element, matrix in self.moves.items():
            block = matrix[np.ix_(index, index)]
            if not np.allclose(block.T @ block, np.eye(len(index)), atol=1e-6):
                k = int(np.abs(block).sum(0).argmin())
                rows = np.flatnonzero(matrix[:, index[k]])  # none where it has no image at all
                images = [printable(n) for n, span in self.places.items() if set(np.r_[span]) & set(rows)]
                missing = f", {images[0]}, is not among them; add it" if images else " is not among them"
                raise UserError(f"field '{name}': the image of {owner[k]} under {element.name}{missing}")
            moves[element] = np.kron(block, np.eye(width)).astype(np.float64)
        return parts_field(name, self.what, [part for part in owner for _ in range(width)], moves, history)


def named_parts(what: str, names: Sequence[str] | None, tables: Mapping[str, Any]) -> Parts:
    """Return parts of one number each, by default those of the tables, with what tables say, and their products.

    A table, or one by element, holds by part its image, with "-" where the sign changes, or follows from its partner.
    """
    if not isinstance(tables, Mapping) or (tables and all(isinstance(value, str) for value in tables.values())):
        tables = {"left-right": tables}
    if names is None:
        named = [pair for table in tables.values() if isinstance(table, Mapping) for pair in table.items()]
        names = list(dict.fromkeys(name for pair in named for name in pair))
    names = _listed(f"the list of {what}", names)
    elements = {word: _element_of(word) for word in tables}
    generators = {elements[word]: _matrix(what, names, table, elements[word]) for word, table in tables.items()}
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


def _listed(who: str, names: Sequence[str]) -> list[str]:
    """Return names as a list, which is refused where one is no text or stands twice."""
    if isinstance(names, str) or not isinstance(names, Iterable) or not all(isinstance(n, str) for n in names):
        raise UserError(f"{who} is given {names!r}; give a list of names")
    if twice := next((n for n, times in Counter(names).items() if times > 1), None):
        raise UserError(f"{who} names {printable(twice)} twice; name it once")
    return list(names)


def _element_of(word: str) -> PlaneElement:
    """Return the element of a robot's word, "left-right", or of the plane's, "flip-x"."""
    found = parse_elements(word, 1)
    if not isinstance(found, tuple) or len(found) != 1 or len(found[0].geometry) != 1 or found[0].orders:
        raise UserError(f"'{word}' is not one turn or mirror; write {', '.join(BODY_NAMES)} or rot60")
    return PlaneElement.of(found[0])


def _matrix(what: str, names: Sequence[str], table: Mapping[str, str], element: PlaneElement) -> Floats:
    """Return the signed permutation of a table; where the element undoes itself, partners complete it."""
    if not isinstance(table, Mapping) or not all(isinstance(n, str) for pair in table.items() for n in pair):
        raise UserError(f"the mirror of the {what} is {table!r}; give by name the name of its image")
    images = dict(table)
    for part, image in table.items() if (element @ element).is_identity else ():
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
