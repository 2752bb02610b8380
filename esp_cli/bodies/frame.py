"""A robot's model at rest: where its joints and masses are."""

from __future__ import annotations

import math
import time
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from esp_cli.symmetry.elements import Floats
from esp_envs.errors import UserError

FREE, BALL, SLIDE, HINGE = range(4)  # MuJoCo's types of joints
QPOS_WIDTH, DOF_WIDTH = (7, 4, 1, 1), (6, 3, 1, 1)  # numbers of a joint's position and velocity, by type


class Frame:
    """A model at rest: where its joints and masses are, all seen from the middle of its base.

    That is the free body on which most joints hang, of equal ones the heaviest. Other free bodies are put there, since
    where they begin is no property of theirs. Without a free body, the base is what alone hangs on the world,
    if it slides and turns there; else the world.

    Mirrors and turns leave `centre` [3] where it is; its z is 0. `axes` [3, 3] are the base's own, in columns: elements
    are told by them. `size` is the largest distance of a joint or mass from their middle, m. `places` [bodies, 2, 3]
    are origin and middle of mass of each body, without what is fixed to it, and `inertia` [bodies, 3, 3] is along the
    world's axes; `mass` [bodies] and `com` [bodies, 3] are those of each moving body with all that is fixed to it.
    `children` are the moving bodies that hang on each moving body, and on the world (0). Looking for symmetries may
    take `seconds` of processor time.
    """

    def __init__(self, model: Any, seconds: float = math.inf) -> None:
        self.model, data = model, mujoco.MjData(model)
        self._seconds, self._until = seconds, time.thread_time() + seconds
        free = [j for j in range(model.njnt) if model.jnt_type[j] == FREE]
        hanging = np.bincount(model.body_rootid[model.jnt_bodyid], minlength=model.nbody)
        free.sort(key=lambda j: (-hanging[model.jnt_bodyid[j]], -model.body_subtreemass[model.jnt_bodyid[j]]))
        for j in free[1:]:
            data.qpos[self.qpos_of(j)][:3] = model.qpos0[self.qpos_of(free[0])][:3]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self.base = free[0] if free else None
        self.moving = [b for b in range(1, model.nbody) if model.body_jntnum[b]]
        self.children = {b: [c for c in self.moving if self.carrier(c) == b] for b in (0, *self.moving)}
        roots = [int(model.jnt_bodyid[free[0]])] if free else self.children[0]
        self.centre = data.xpos[roots].mean(0)
        self.centre[2] = 0
        kinds = set(model.jnt_type[self.joints(roots[0])])
        is_base = bool(free) or (len(roots) == 1 and SLIDE in kinds and bool(kinds & {BALL, HINGE}))
        self.axes = data.xmat[roots[0]].reshape(3, 3).copy() if is_base else np.eye(3)
        self.places = np.stack([data.xpos, data.xipos], 1) - self.centre
        self.anchor, self.axis = data.xanchor - self.centre, data.xaxis.copy()
        self.turned = data.xmat.reshape(-1, 3, 3).copy()
        axes = data.ximat.reshape(-1, 3, 3)
        self.geom_places, self._geom_axes = data.geom_xpos - self.centre, data.geom_xmat.reshape(-1, 3, 3).copy()
        self.inertia = axes * model.body_inertia[:, None] @ axes.transpose(0, 2, 1)
        self.mass, moment = np.zeros(model.nbody), np.zeros((model.nbody, 3))
        np.add.at(self.mass, model.body_weldid, model.body_mass)
        np.add.at(moment, model.body_weldid, model.body_mass[:, None] * (data.xipos - self.centre))
        self.com = moment / np.maximum(self.mass, 1e-12)[:, None]
        spread = np.concatenate([self.anchor, self.com[self.moving]])
        self.size = max(float(np.linalg.norm(spread - spread.mean(0), axis=1).max()), 1e-6)

    @property
    def is_late(self) -> bool:
        """Whether the time is over."""
        return time.thread_time() > self._until

    def stop_if_late(self) -> None:
        """Raise a `UserError` once the time is over."""
        if self.is_late:
            raise UserError(f"not covered: the {self._seconds:g} s for the search were over")

    def name(self, kind: str, index: int) -> str:
        """Return the name of a body, joint or actuator, made of its number where it has none."""
        return str(getattr(self.model, kind)(index).name) or f"{kind}#{index}"

    def properties(self, of: str, *names: str) -> dict[str, Any]:
        """Return arrays of the model that this MuJoCo knows, by name: of="geom", "friction"."""
        return {name: getattr(self.model, f"{of}_{name}") for name in names if hasattr(self.model, f"{of}_{name}")}

    def carrier(self, body: int) -> int:
        """Return the moving body that a body hangs on; 0 is the world."""
        return int(self.model.body_weldid[self.model.body_parentid[body]])

    @cached_property
    def touching(self) -> Any:
        """[geoms, geoms] which may touch each other, as masks, exclusions and pairs of contacts have it."""
        model, body = self.model, self.model.geom_bodyid
        masks = model.geom_contype[:, None] & model.geom_conaffinity
        may = (masks | masks.T) != 0
        for signature in model.exclude_signature:
            one, other = body == signature >> 16, body == signature & 0xFFFF
            may[np.ix_(one, other)] = may[np.ix_(other, one)] = False
        owner = model.body_weldid  # what is fixed to a body moves with it, and touches neither it nor its parent
        parent = np.where(owner > 0, owner[model.body_parentid[owner]], -1)[body]
        owner = owner[body]
        near = (owner[:, None] == owner) | ((parent[:, None] == owner) & (owner > 0))
        may &= ~(near | near.T)
        may[[model.pair_geom1, model.pair_geom2], [model.pair_geom2, model.pair_geom1]] = True
        return may

    @cached_property
    def shapes(self) -> dict[int, list[tuple[int, int, Floats, Floats]]]:
        """By moving body, or the world (0), all that may touch: geom, type, middle [3], squared extent [3, 3].

        Of a plane, the middle is a point over it, above or below `centre`.
        """
        model, found = self.model, dict[int, list[tuple[int, int, Floats, Floats]]]()
        for g in np.flatnonzero(self.touching.any(1)).tolist():
            kind, place, axes = int(model.geom_type[g]), self.geom_places[g], self._geom_axes[g]
            extent = np.diag(model.geom_aabb[g, 3:] ** 2)
            if kind == mujoco.mjtGeom.mjGEOM_PLANE:
                extent, place = np.zeros((3, 3)), axes[:, 2] * (axes[:, 2] @ place + self.size)
            elif kind == mujoco.mjtGeom.mjGEOM_MESH:
                extent = self._extent(int(model.geom_dataid[g]))
            found.setdefault(int(model.body_weldid[model.geom_bodyid[g]]), []).append(
                (g, kind, place, axes @ extent @ axes.T)
            )
        return found

    def _extent(self, mesh: int) -> Floats:
        """Return the second moments [3, 3] of a mesh's convex hull, with which it touches, however it is meshed."""
        start = int(self.model.mesh_vertadr[mesh])
        points = self.model.mesh_vert[start : start + int(self.model.mesh_vertnum[mesh])].astype(np.float64)
        middle, graph = points.mean(0), self.model.mesh_graph[int(self.model.mesh_graphadr[mesh]) :]
        faces = 2 + 3 * int(graph[0] + graph[1])  # where the corners of the hull's faces are
        corners = points[graph[faces : faces + 3 * int(graph[1])].reshape(-1, 3)] - middle  # with it, tetrahedra
        volume, total = np.abs(np.linalg.det(corners)), corners.sum(1)
        volume /= volume.sum()
        spread = np.einsum("f,fvi,fvj->ij", volume, corners, corners) + np.einsum("f,fi,fj->ij", volume, total, total)
        centre = volume @ total / 4
        return spread / 20 + np.outer(centre, middle) + np.outer(middle, centre) + np.outer(middle, middle)

    def qpos_of(self, joint: int) -> slice:
        """Return where the position of a joint is."""
        start = int(self.model.jnt_qposadr[joint])
        return slice(start, start + QPOS_WIDTH[self.model.jnt_type[joint]])

    def dofs_of(self, joint: int) -> slice:
        """Return where the velocity of a joint is."""
        start = int(self.model.jnt_dofadr[joint])
        return slice(start, start + DOF_WIDTH[self.model.jnt_type[joint]])

    def joints(self, body: int) -> list[int]:
        """Return the joints of a body."""
        first = int(self.model.body_jntadr[body])
        return list(range(first, first + int(self.model.body_jntnum[body])))


def image_of_axis(frame: Frame, R: Floats, joint: int) -> Floats:
    """Return R times the axis of a slide; of a hinge, whose axis is that of a turn, with the sign of its sense."""
    sense = np.linalg.det(R) if frame.model.jnt_type[joint] == HINGE else 1.0
    return np.rint(sense) * R @ frame.axis[joint]


def clean(x: Floats) -> Floats:
    """Return numbers with what differs from a whole number by rounding alone made whole."""
    whole = np.rint(x)
    return np.where(np.abs(x - whole) < 1e-9, whole, x) + 0.0


def share(a: Floats | float, b: Floats | float) -> float:
    """Return the largest difference of two numbers or arrays over the largest of their sizes."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)  # switches too
    largest = max(np.abs(a).max(), np.abs(b).max())
    return float(np.abs(a - b).max() / largest) if largest > 1e-12 else 0.0
