"""Find where a turn or mirror of a robot's surroundings sends its joints, actuators and limbs, from its model alone.

A model at rest (`qpos0`) is compared with its image. Bodies are matched from the base outwards, by the lines of their
joints and by where their mass is. What a match means for positions, velocities and controls is then linear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import mujoco
import numpy as np
from scipy.optimize import linear_sum_assignment

from esp_cli.bodies.kinds import space
from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats, Indices
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError

LOOSE = 0.1
"""How far a joint's line may be off, as a share of the robot's size, or of the length of its axis, to be matched."""
FAR = 0.25
"""How far a body's middle of mass may be off, as a share of the robot's size, to be matched."""
_APART = 1e6
FREE, BALL, SLIDE, HINGE = range(4)
"""MuJoCo's types of joints."""
QPOS_WIDTH, DOF_WIDTH = (7, 4, 1, 1), (6, 3, 1, 1)
"""Numbers of a joint's position and velocity, by type."""


@dataclass(frozen=True)
class Match:
    """What one element does to a model's state: qpos' = qpos qpos + offset, qvel' = qvel qvel, ctrl' = ctrl ctrl.

    Attributes:
        element: of the plane.
        bodies: [bodies, bodies] where each goes; a column of 0 where it has no image.
        joint: [joints] the image of each joint.
        qpos: [nq, nq].
        offset: [nq]; 0 but for joints whose reference is not 0, and a base away from the origin.
        qvel: [nv, nv].
        ctrl: [nu, nu].
        unmatched: names of actuators that have no image; their rows and columns are 0.
    """

    element: PlaneElement
    bodies: Floats
    joint: Indices
    qpos: Floats
    offset: Floats
    qvel: Floats
    ctrl: Floats
    unmatched: tuple[str, ...]

    @property
    def is_trivial(self) -> bool:
        """Whether no number changes."""
        return all(np.array_equal(x, np.eye(len(x))) for x in (self.qpos, self.qvel, self.ctrl))


class Frame:
    """A model at rest: where its joints and masses are, all seen from the middle of its base.

    Attributes:
        model: the `mujoco.MjModel`.
        base: its first free joint, or None.
        centre: [3], what mirrors and turns leave where it is; z is 0.
        size: largest distance of a joint or mass from their middle, m.
        inertia: [bodies, 3, 3] of each body, along the world's axes.
    """

    def __init__(self, model: Any) -> None:
        self.model, data = model, mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        free = [j for j in range(model.njnt) if model.jnt_type[j] == FREE]
        self.base = free[0] if free else None
        self.moving = [b for b in range(1, model.nbody) if model.body_jntnum[b]]
        self.parent = {b: self.carrier(b) for b in self.moving}
        roots = [b for b in self.moving if self.parent[b] == 0]
        self.centre = data.xpos[model.jnt_bodyid[free[0]] if free else roots].reshape(-1, 3).mean(0)
        self.centre[2] = 0
        self.place = data.xpos - self.centre
        self.anchor, self.axis = data.xanchor - self.centre, data.xaxis.copy()
        self.turned = data.xmat.reshape(-1, 3, 3).copy()
        axes = data.ximat.reshape(-1, 3, 3)
        self.inertia = axes * model.body_inertia[:, None] @ axes.transpose(0, 2, 1)
        self.mass, self.com = self._rigid_parts(data.xipos - self.centre)
        spread = np.concatenate([self.anchor, self.com[self.moving]])
        self.size = max(float(np.linalg.norm(spread - spread.mean(0), axis=1).max()), 1e-6)

    def name(self, kind: str, index: int) -> str:
        """Return the name of a body, joint or actuator, made of its number where it has none."""
        return str(getattr(self.model, kind)(index).name) or f"{kind}{index}"

    def carrier(self, body: int) -> int:
        """Return the moving body that a body hangs on; 0 is the world."""
        parent = self.model.body_parentid[body]
        while parent and not self.model.body_jntnum[parent]:
            parent = self.model.body_parentid[parent]
        return int(parent)

    def _rigid_parts(self, com: Floats) -> tuple[Floats, Floats]:
        """Return [bodies] mass and [bodies, 3] middle of mass of each moving body with all that is fixed to it."""
        mass, moment = np.zeros(self.model.nbody), np.zeros((self.model.nbody, 3))
        for body in range(1, self.model.nbody):
            owner = body if self.model.body_jntnum[body] else self.carrier(body)
            mass[owner] += self.model.body_mass[body]
            moment[owner] += self.model.body_mass[body] * com[body]
        return mass, moment / np.maximum(mass, 1e-12)[:, None]

    @cached_property
    def children(self) -> dict[int, list[int]]:
        """The moving bodies that hang on each moving body, and on the world (0)."""
        return {b: [c for c in self.moving if self.parent[c] == b] for b in (0, *self.moving)}

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


def derive(frame: Frame, element: PlaneElement) -> Match:
    """Find what an element does to a model.

    Raises:
        UserError: the model at rest is far from being its own image; it names a joint or body without an image.
    """
    R = space(element.matrix)
    com = frame.com[frame.moving]
    gaps = np.linalg.norm((com @ R.T)[:, None] - com, axis=-1).min(1)
    if gaps.max() > FAR * frame.size:
        raise UserError(
            f"no mass is where that of {frame.name('body', frame.moving[int(gaps.argmax())])} would come to lie"
        )
    bodies, joints = _matched(frame, R)
    if not joints:
        every = range(frame.model.njnt)
        lost = [i for i in every if min(_joint_gap(frame, R, i, j) for j in every) >= _APART]
        part = (
            f"no joint is like the image of {frame.name('joint', lost[0])}"
            if lost
            else "its bodies hang together otherwise"
        )
        raise UserError(part)
    qpos, offset, qvel = _state_maps(frame, R, joints)
    ctrl, unmatched = _control_map(frame, qvel)
    joint = np.array([joints[j] for j in range(frame.model.njnt)])
    return Match(element, _all_bodies(frame, R, bodies), joint, qpos, offset, qvel, ctrl, unmatched)


def _matched(frame: Frame, R: Floats) -> tuple[dict[int, int], dict[int, int]]:
    """Return the image of each moving body, and of each joint; nothing where there is none."""
    mirrored, total = np.linalg.det(R) < 0, max(frame.mass.sum(), 1e-12)

    @cache
    def cost(b: int, c: int) -> tuple[float, tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
        """Return how badly c is the image of b with all that hangs on them, and the pairs of joints and bodies."""
        own, pairs = _assigned(frame.joints(b), frame.joints(c), lambda i, j: _joint_gap(frame, R, i, j))
        own += abs(frame.mass[b] - frame.mass[c]) / total
        off = float(np.linalg.norm(R @ frame.com[b] - frame.com[c])) / frame.size if frame.mass[b] else 0.0
        own += off if off <= FAR else _APART
        # of two legs on one line, as in a planar walker, a mirror exchanges them
        own += 1e-9 * (b == c and mirrored)
        hanging, below = _assigned(frame.children[b], frame.children[c], lambda x, y: cost(x, y)[0])
        return own + hanging, tuple(pairs), tuple(below)

    worst, waiting = _assigned(frame.children[0], frame.children[0], lambda x, y: cost(x, y)[0])
    if worst >= _APART:
        return {}, {}
    bodies, joints = {0: 0}, dict[int, int]()
    while waiting:
        b, c = waiting.pop()
        bodies[b] = c
        joints |= dict(cost(b, c)[1])
        waiting += cost(b, c)[2]
    return bodies, joints


def _assigned(rows: Sequence[int], columns: Sequence[int], cost: Any) -> tuple[float, list[tuple[int, int]]]:
    """Return the least sum of costs of pairs of two lists, and the pairs."""
    if len(rows) != len(columns):
        return _APART, []
    table = np.array([[min(cost(i, j), _APART) for j in columns] for i in rows]).reshape(len(rows), len(columns))
    places = linear_sum_assignment(table)
    return float(table[places].sum()), [(rows[i], columns[j]) for i, j in zip(*places, strict=True)]


def _joint_gap(frame: Frame, R: Floats, i: int, j: int) -> float:
    """Return how far joint j is from the image of joint i, in sizes of the robot and lengths of the axis."""
    kind = frame.model.jnt_type[i]
    if kind != frame.model.jnt_type[j]:
        return _APART
    apart = R @ frame.anchor[i] - frame.anchor[j]
    if kind == FREE and frame.base in (i, j):
        return 0.0 if i == j else _APART
    gap = 0.0
    if kind in (SLIDE, HINGE):
        axis = image_of_axis(frame, R, i)
        gap = float(np.linalg.norm(axis - np.copysign(1, axis @ frame.axis[j]) * frame.axis[j]))
        apart = apart - (apart @ frame.axis[j]) * frame.axis[j] if kind == HINGE else np.zeros(3)
    off = float(np.linalg.norm(apart)) / frame.size
    return _APART if max(gap, off) > LOOSE else gap + off


def image_of_axis(frame: Frame, R: Floats, joint: int) -> Floats:
    """Return R times the axis of a slide; of a hinge, whose axis is that of a turn, with the sign of its sense."""
    sense = np.linalg.det(R) if frame.model.jnt_type[joint] == HINGE else 1.0
    return np.rint(sense) * R @ frame.axis[joint]


def _state_maps(frame: Frame, R: Floats, joints: dict[int, int]) -> tuple[Floats, Floats, Floats]:
    """Return the maps of qpos, with its offset, and of qvel."""
    model, det = frame.model, np.rint(np.linalg.det(R))
    qpos, qvel = np.zeros((model.nq, model.nq)), np.zeros((model.nv, model.nv))
    fixed, moved = model.qpos0.copy(), model.qpos0.copy()  # a state, and its image
    for i, j in joints.items():
        kind = model.jnt_type[i]
        into, out, into_v, out_v = frame.qpos_of(j), frame.qpos_of(i), frame.dofs_of(j), frame.dofs_of(i)
        if kind in (SLIDE, HINGE):
            sign = np.copysign(1.0, image_of_axis(frame, R, i) @ frame.axis[j])
            qpos[into, out], qvel[into_v, out_v] = sign, sign
            continue
        local = frame.turned[model.jnt_bodyid[j]].T @ R @ frame.turned[model.jnt_bodyid[i]]
        turn = np.eye(4)
        turn[1:, 1:] = det * local
        if kind == FREE:
            # the body's own image seen in the world: R Rot Rot0^-1 R^-1 Rot0'
            turn[1:, 1:] = det * R
            turn = _times(model.qpos0[into][3:]) @ turn @ _times(_conjugate(model.qpos0[out][3:]))
            qpos[into, out][:3, :3], qpos[into, out][3:, 3:] = R, turn
            qvel[into_v, out_v][:3, :3], qvel[into_v, out_v][3:, 3:] = R, det * local
            fixed[out][:3], moved[into][:3] = frame.centre, frame.centre
        else:
            qpos[into, out], qvel[into_v, out_v] = turn, det * local
            fixed[out], moved[into] = 0, 0
    offset = moved - qpos @ fixed
    for start in model.jnt_qposadr[model.jnt_type == FREE]:
        offset[start + 3 : start + 7] = 0
    return _clean(qpos), _clean(offset), _clean(qvel)


def _times(q: Floats) -> Floats:
    """Return the matrix M with M p = p q, of quaternions (w, x, y, z)."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def _conjugate(q: Floats) -> Floats:
    return q * [1, -1, -1, -1]


def _clean(x: Floats) -> Floats:
    """Return numbers with what differs from a whole number by rounding alone made whole."""
    whole = np.rint(x)
    return np.where(np.abs(x - whole) < 1e-9, whole, x) + 0.0


def _control_map(frame: Frame, qvel: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Return the map of controls, and the names of actuators that have no image.

    An actuator pulls with a moment [nv] on the degrees of freedom; its image pulls with the image of it.
    """
    model = frame.model
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    moment = np.zeros((model.nu, model.nv))
    if model.nu:
        mujoco.mju_sparse2dense(
            moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
        )
    scale = np.abs(moment).max(axis=1, initial=0)
    unit = moment / np.where(scale > 0, scale, 1)[:, None]
    image, ctrl = unit @ qvel.T, np.zeros((model.nu, model.nu))
    types = np.column_stack([model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype])
    gaps = np.abs(image[:, None] - np.stack([unit, -unit])[:, None]).max(-1, initial=0)
    gap = gaps.min(0) + _APART * (types[:, None] != types).any(-1)
    gap += 0.1 * np.abs(np.subtract.outer(scale, scale)) / max(scale.max(initial=0), 1e-12)
    mirrored = [a for a in range(model.nu) if scale[a] > 0]
    unmatched = {a for a in range(model.nu) if scale[a] == 0}
    for a, b in zip(*linear_sum_assignment(gap[np.ix_(mirrored, mirrored)]), strict=True):
        i, j = mirrored[a], mirrored[b]
        if gap[i, j] > 3 * LOOSE:
            unmatched.add(i)
        else:
            ctrl[j, i] = 1.0 if gaps[0, i, j] <= gaps[1, i, j] else -1.0
    return ctrl, tuple(printable(frame.name("actuator", a)) for a in sorted(unmatched))


def _all_bodies(frame: Frame, R: Floats, moved: dict[int, int]) -> Floats:
    """Return [bodies, bodies] where each goes, fixed ones to the nearest that is fixed to their carrier's image."""
    count = frame.model.nbody
    where = np.zeros((count, count))
    for b in range(count):
        if b in moved:
            where[moved[b], b] = 1
            continue
        carrier = moved[frame.carrier(b)]
        like = [c for c in range(1, count) if c not in moved and frame.carrier(c) == carrier]
        gaps = [float(np.linalg.norm(R @ frame.place[b] - frame.place[c])) / frame.size for c in like]
        if gaps and min(gaps) < LOOSE:
            where[like[int(np.argmin(gaps))], b] = 1
    return where
