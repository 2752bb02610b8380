"""Find where a turn or mirror of a robot's surroundings sends its joints, actuators and limbs, from its model alone.

A model at rest (`qpos0`) is compared with its image. Bodies are matched from the base outwards, by the lines of their
joints and by where their mass is. What a match means for positions, velocities and controls is then linear.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import cache, partial
from typing import Any

import mujoco
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from esp_cli.bodies.frame import BALL, FREE, HINGE, SLIDE, Frame, clean, image_of_axis, share
from esp_cli.bodies.kinds import space
from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats, Indices
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError

LOOSE = 0.1  # how far a matched joint's line may be off, as a share of the robot's size, or of its axis' length
FAR = 0.25  # how far a body's middle of mass may be off, as a share of the robot's size, to be matched
_APART = 1e6
_UNLIKE = 0.01  # gap of actuators of other gain, bias or ranges, which are matched where there is no better
_SLOWER = 0.05  # share by which time constants and delays of an actuator may be off its image's


@dataclass(frozen=True)
class Match:
    """What one element does to a model's state: qpos' = qpos qpos + offset, qvel' = qvel qvel, ctrl' = ctrl ctrl."""

    element: PlaneElement
    world: Floats  # [3, 3] what it does to the world at rest
    bodies: Floats  # [bodies, bodies] where each goes; a column of 0 where it has no image
    joint: Indices  # [joints] the image of each joint
    qpos: Floats  # [nq, nq]
    offset: Floats  # [nq]; 0 but for joints whose reference is not 0, and a base away from the origin
    qvel: Floats  # [nv, nv]
    ctrl: Floats  # [nu, nu]; rows and columns of 0 where an actuator has no image
    tendons: Floats  # [tendons, tendons]; a column of 0 where one has no image

    @property
    def is_trivial(self) -> bool:
        """Whether no number changes."""
        return all(np.array_equal(x, np.eye(len(x))) for x in (self.qpos, self.qvel, self.ctrl))


def derive(frame: Frame, element: PlaneElement) -> Match:
    """Find what an element does to a model; an error names the joint or body that is without an image at rest."""
    R = clean(frame.axes @ space(element.matrix) @ frame.axes.T)
    com = frame.com[frame.moving]
    gaps = np.linalg.norm((com @ R.T)[:, None] - com, axis=-1).min(1)
    if gaps.max() > FAR * frame.size:
        lost = printable(frame.name("body", frame.moving[int(gaps.argmax())]))
        raise UserError(f"no mass is where that of {lost} would come to lie")
    bodies, joints = _matched(frame, R)
    if not joints:
        every = range(frame.model.njnt)
        alone = next((i for i in every if min(_joint_gap(frame, R, i, j) for j in every) >= _APART), None)
        if alone is None:
            raise UserError("its bodies hang together otherwise")
        raise UserError(f"no joint is like the image of {printable(frame.name('joint', alone))}")
    qpos, offset, qvel = _state_maps(frame, R, joints)
    every_body = _all_bodies(frame, R, bodies)
    ctrl, tendons = _pulled_maps(frame, every_body, qpos, offset, qvel)
    joint = np.array([joints[j] for j in range(frame.model.njnt)])
    return Match(element, R, every_body, joint, qpos, offset, qvel, ctrl, tendons)


def _matched(frame: Frame, R: Floats) -> tuple[dict[int, int], dict[int, int]]:
    """Return the image of each moving body, and of each joint; nothing where there is none."""
    mirrored, total = np.linalg.det(R) < 0, max(frame.mass.sum(), 1e-12)

    @cache
    def cost(b: int, c: int) -> tuple[float, tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
        """Return how badly c is the image of b with all that hangs on them, and the pairs of joints and bodies."""
        frame.stop_if_late()
        off = float(np.linalg.norm(R @ frame.com[b] - frame.com[c])) / frame.size if frame.mass[b] else 0.0
        if off > FAR:
            return _APART, (), ()
        own, pairs = _assigned(frame.joints(b), frame.joints(c), lambda i, j: _joint_gap(frame, R, i, j))
        own += abs(frame.mass[b] - frame.mass[c]) / total + off
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
    if kind == FREE:  # of like bodies, the one that begins where the image does
        starts = [frame.model.qpos0[frame.qpos_of(k)][:3] - frame.centre for k in (i, j)]
        return 1e-6 * float(np.linalg.norm(R @ starts[0] - starts[1])) / frame.size
    gap = 0.0
    if kind in (SLIDE, HINGE):
        axis = image_of_axis(frame, R, i)
        gap = float(np.linalg.norm(axis - np.copysign(1, axis @ frame.axis[j]) * frame.axis[j]))
        apart = apart - (apart @ frame.axis[j]) * frame.axis[j] if kind == HINGE else np.zeros(3)
    off = float(np.linalg.norm(apart)) / frame.size
    return _APART if max(gap, off) > LOOSE else gap + off


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
        fixed[out][-4:], moved[into][-4:] = 0, 0
        if kind == BALL:
            qpos[into, out], qvel[into_v, out_v] = block_diag(1, det * local), det * local
            continue
        # the body's own image, seen in the world: R Rot Rot0^-1 R^-1 Rot0'
        turn = _times(model.qpos0[into][3:]) @ block_diag(1, det * R) @ _times(model.qpos0[out][3:] * [1, -1, -1, -1])
        qpos[into, out], qvel[into_v, out_v] = block_diag(R, turn), block_diag(R, det * local)
        fixed[out][:3], moved[into][:3] = frame.centre, frame.centre
    return clean(qpos), clean(moved - qpos @ fixed), clean(qvel)


def _times(q: Floats) -> Floats:
    """Return the matrix M with M p = p q, of quaternions (w, x, y, z)."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def _pulls(frame: Frame, qpos: Floats) -> Floats:
    """Return how actuators, then tendons, pull at each degree of freedom, [nu + tendons, nv]: by how they shorten."""
    data = mujoco.MjData(frame.model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(frame.model, data)
    columns = []
    for data.qvel[:] in np.eye(frame.model.nv):
        mujoco.mj_fwdVelocity(frame.model, data)
        columns.append(np.r_[data.actuator_velocity, data.ten_velocity])
    return np.stack(columns, 1)


def _pulled_maps(frame: Frame, bodies: Floats, qpos: Floats, offset: Floats, qvel: Floats) -> tuple[Floats, Floats]:
    """Return the maps of controls and of tendons, by their pull at rest and in another pose."""
    model, rest, other = frame.model, frame.model.qpos0, frame.model.qpos0.copy()
    mujoco.mj_integratePos(model, other, 0.3 * np.random.default_rng(0).normal(size=model.nv), 1.0)
    here = np.hstack([_pulls(frame, q) @ qvel.T for q in (rest, other)])
    there = np.hstack([_pulls(frame, qpos @ q + offset) for q in (rest, other)])
    tendons = _images(here[model.nu :], there[model.nu :], lambda *_: {})
    on_body = model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY  # pulls where it touches, as adhesion does
    held = np.eye(model.nbody)[model.actuator_trnid[:, 0] * on_body] * on_body[:, None]
    if idle := [a for a in range(model.nu) if not (on_body[a] or np.abs(here[a]).max() > 1e-9)]:
        names = ", ".join(printable(frame.name("actuator", a)) for a in idle)
        raise UserError(f"not covered: in no pose that was looked at does anything pull of the actuators {names}")
    turned = np.where((model.actuator_gaintype == 0) & (model.actuator_gainprm[:, 0] < 0), -1.0, 1.0)[:, None]
    here, there = (turned * x[: model.nu] * ~on_body[:, None] for x in (here, there))
    ctrl = _images(np.hstack([here, held @ bodies.T]), np.hstack([there, held]), partial(actuator_shares, model))
    return ctrl, tendons


def _images(here: Floats, there: Floats, unlike: Callable[[int, int, float], dict[str, float]]) -> Floats:
    """Return the signed map [n, n] of what pulls, image `here` [n, k] to `there`, for those that are least `unlike`."""
    scales = [np.abs(x).max(axis=1, initial=0) for x in (here, there)]
    unit, other = (x / np.where(s > 1e-9, s, np.inf)[:, None] for x, s in zip((here, there), scales, strict=True))
    gaps = np.stack([cdist(unit, x, "chebyshev") for x in (other, -other)])
    gaps += 0.1 * np.abs(np.subtract.outer(*scales)) / max(scales[0].max(initial=0), 1e-12)
    gaps[1] += 1e-9  # two that pull one joint opposite ways: each has an image of its own sense
    for back, a, b in np.argwhere(gaps <= 3 * LOOSE):
        shares = unlike(a, b, -1.0 if back else 1.0)
        gaps[back, a, b] += _UNLIKE * sum(shares.values())
        gaps[back, a, b] += _APART * any(shares.get(what, 0) > _SLOWER for what in ("kind", "dynamics", "delay"))
    found, gap = np.zeros((len(here),) * 2), gaps.min(0)
    for a, b in zip(*linear_sum_assignment(gap), strict=True):
        if gap[a, b] <= 3 * LOOSE:
            found[b, a] = 1.0 if gaps[0, a, b] <= gaps[1, a, b] else -1.0
    return found


def actuator_shares(model: Any, a: int, b: int, sign: float) -> dict[str, float]:
    """Return by property how far actuator b is from the image of a, whose control it takes with a sign."""
    gains = model.actuator_gainprm
    # a gain of the other sign turns the control, not the force
    turned = -1.0 if (gains[a, 0] * gains[b, 0] < 0) and model.actuator_gaintype[a] == 0 else 1.0
    kinds = np.stack([model.actuator_gaintype, model.actuator_biastype, model.actuator_dyntype])
    values: dict[str, Any] = {"kind": kinds[:, [a, b]].T, "gain": [turned * gains[a], gains[b]]}
    values["dynamics"] = model.actuator_dynprm[[a, b]] * bool(model.actuator_dyntype[a])
    for what, name in (("bias", "biasprm"), ("early activation", "actearly"), ("delay", "delay")):
        values[what] = getattr(model, f"actuator_{name}")[[a, b]]
    for what, name in (("force range", "force"), ("control range", "ctrl"), ("activation range", "act")):
        limits = getattr(model, f"actuator_{name}range") * getattr(model, f"actuator_{name}limited")[:, None]
        values[what] = [np.sort(sign * (turned if name == "force" else 1.0) * limits[a]), limits[b]]
    values["gear"] = np.abs(model.actuator_gear[[a, b]])
    return {what: share(*pair) for what, pair in values.items()}


def _all_bodies(frame: Frame, R: Floats, moved: dict[int, int]) -> Floats:
    """Return [bodies, bodies] where each goes, fixed ones each to its own that is fixed to their carrier's image."""
    count, name = frame.model.nbody, partial(frame.name, "body")
    where = np.zeros((count, count))
    where[list(moved.values()), list(moved)] = 1
    fixed = [b for b in range(count) if b not in moved]
    for carrier, image in moved.items():
        own, other = ([b for b in fixed if frame.carrier(b) == on] for on in (carrier, image))
        gaps = np.abs((frame.places[own] @ R.T)[:, None] - frame.places[other]).max((-1, -2)) / frame.size
        for i, k in np.argwhere(gaps < LOOSE):  # of some at one place, those whose names are alike
            frame.stop_if_late()
            gaps[i, k] += 1e-6 * (1 - SequenceMatcher(None, name(own[i]), name(other[k])).ratio())
        for i, k in zip(*linear_sum_assignment(gaps), strict=True):
            where[other[k], own[i]] = gaps[i, k] < LOOSE
    return where
