"""Kinds of numbers of a robot: vectors of space, and the numbers of its joints, limbs and scanned points.

A turn or mirror of the plane acts on space about the vertical: z stays. Seen from the body, or from the world, a vector
turns alike, since body and surroundings are mirrored together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.plane import KIND_MATRICES, PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind

_ROUNDING = 1e-9


def space(planar: Floats) -> Floats:
    """Return the matrix [3, 3] of space of a matrix [2, 2] of the plane."""
    out = np.eye(3)
    out[:2, :2] = planar
    return out


def axial(planar: Floats) -> Floats:
    """Return how axes of turns transform, [3, 3]: a mirror also reverses the sense of a turn."""
    return np.rint(np.linalg.det(planar)) * space(planar) + 0.0


def _quaternion(planar: Floats, real: int) -> Floats:
    out = np.zeros((4, 4))
    axis = [i for i in range(4) if i != real]
    out[real, real], out[np.ix_(axis, axis)] = 1, axial(planar)
    return out


def _command(planar: Floats) -> Floats:
    out = axial(planar)
    out[:2, :2] = planar
    return out


VECTOR_3D = Kind("3-d vector", 3, is_vector=True)
"""(x, y, z) of a place, a velocity, a force, or of gravity as the body sees it."""
AXIAL_3D = Kind("axial vector", 3, is_vector=True)
"""(x, y, z) of an angular velocity or a torque."""
QUATERNION = Kind("quaternion wxyz", 4, is_vector=True)
"""(w, x, y, z) of the body's attitude in the world."""
QUATERNION_XYZW = Kind("quaternion xyzw", 4, is_vector=True)
"""The same with the real part last."""
ATTITUDE_6D = Kind("attitude of 6", 6)
"""The first two columns of the body's rotation matrix, row after row."""
PLANAR_COMMAND = Kind("planar command", 3)
"""(vx, vy, turning rate) that a robot is told."""

KIND_MATRICES |= {
    VECTOR_3D: space,
    AXIAL_3D: axial,
    QUATERNION: lambda planar: _quaternion(planar, 0),
    QUATERNION_XYZW: lambda planar: _quaternion(planar, 3),
    ATTITUDE_6D: lambda planar: np.kron(space(planar), planar).astype(np.float64),
    PLANAR_COMMAND: _command,
}


@dataclass(frozen=True)
class PartsKind(Kind):
    """Numbers of parts that an element sends to each other: joints, actuators, limbs, points around a body.

    Attributes:
        moves: elements, each with its orthogonal matrix [width, width].
        owner: what messages call the whole: "the body".
    """

    moves: tuple[tuple[PlaneElement, tuple[tuple[float, ...], ...]], ...] = ()
    owner: str = "the body"

    def matrix(self, planar: Floats) -> Floats:
        """Return how the numbers of one item transform under a matrix of the plane.

        Raises:
            UserError: the body has no such symmetry.
        """
        for element, rows in self.moves:
            if np.allclose(element.matrix, planar, atol=_ROUNDING):
                return np.array(rows)
        if np.allclose(planar, np.eye(2), atol=_ROUNDING):
            return np.eye(self.width)
        known = ", ".join(element.name for element, _ in self.moves) or "none"
        raise UserError(f"{self.owner} has no such symmetry for its {self.name}; it has {known}")


def parts_field(name: str, what: str, moves: dict[PlaneElement, Floats], count: int, owner: str = "the body") -> Field:
    """Return a field of `count` items, each the numbers of all parts."""
    width = len(next(iter(moves.values()))) if moves else 0
    if not width:
        raise UserError(f"field '{name}' has no {what}; name some")
    rows = tuple((element, tuple(map(tuple, matrix.tolist()))) for element, matrix in moves.items())
    kind = PartsKind(what, width, moves=rows, owner=owner)
    KIND_MATRICES[kind] = kind.matrix
    return Field(name, kind, count)


def points_field(
    name: str, points: Sequence[Sequence[float]] | Floats, elements: Sequence[PlaneElement], count: int = 1
) -> Field:
    """Return a field of one number for each of n points around the body, as of a height scan or rays.

    Args:
        name: of the field.
        points: [n, 2] or [n, 3], where they are seen from the body, m; or the directions of rays.
        elements: those that the body has; each must send points to points.
        count: how many such pictures: steps of a history.

    Raises:
        UserError: a point's image is no point.
    """
    places = np.asarray(points, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] not in (2, 3) or not len(places) or not np.isfinite(places).all():
        raise UserError(f"field '{name}': points have shape {list(places.shape)}; give [n, 2] or [n, 3] finite numbers")
    size = max(np.abs(places).max(), 1e-9)
    moves = {}
    for element in elements:
        turn = element.matrix if places.shape[1] == 2 else space(element.matrix)
        gap = np.abs((places @ turn.T)[:, None] - places[None]).max(-1) / size
        image = gap.argmin(1)
        if gap.min(1).max() > 1e-3 or len(set(image.tolist())) < len(image):
            k = int(gap.min(1).argmax())
            raise UserError(f"field '{name}': the image of point {k} under {element.name} is no point of it")
        moves[element] = np.zeros((len(places), len(places)))
        moves[element][image, np.arange(len(places))] = 1
    return parts_field(name, "points", moves, count)


def grid(size: tuple[float, float], resolution: float, ordering: str = "xy") -> Floats:
    """Return the points [n, 2] of a grid around the body, in the order of Isaac Lab's grid pattern.

    Args:
        size: extent along x and y, m.
        resolution: between points, m.
        ordering: "xy" lets x run fastest, "yx" y.

    Raises:
        UserError: another ordering, or no point.
    """
    if ordering not in ("xy", "yx") or resolution <= 0 or min(size) < 0:
        raise UserError(f"grid({size}, {resolution}, {ordering!r}) is none; give sizes, a resolution and 'xy' or 'yx'")
    x, y = (np.linspace(-s / 2, s / 2, round(s / resolution) + 1) for s in size)
    X, Y = np.meshgrid(x, y, indexing="xy" if ordering == "xy" else "ij")
    return np.stack([X.ravel(), Y.ravel()], -1)
