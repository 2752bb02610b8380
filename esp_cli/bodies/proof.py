"""Prove in the simulator that a match is a symmetry: accelerations of mirrored states are mirrored accelerations.

For random states, controls and forces, M qacc(q, v, u, f) is compared with qacc(M q, M v, M u, M f). The comparison is
its own control: planted mistakes (the sign of a joint pair, a joint that stays with itself) have to show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from esp_cli.bodies.deriving import Match
from esp_cli.bodies.frame import BALL, FREE, Frame
from esp_cli.bodies.reading import printable
from esp_cli.symmetry.elements import Floats

EXACT, NEARLY = 1e-5, 0.05  # largest gap of a mirror exact up to rounding, and but for a model's small asymmetry
SEEN = 3.0  # how many times the gap of a planted mistake exceeds the gap without it, where the proof would have seen it
NO_MIRROR = (mujoco.mjtSensor.mjSENS_USER, mujoco.mjtSensor.mjSENS_PLUGIN)
"""Kinds of sensors of which nobody knows what their readings mean."""
_STATES, _LYING, _PLANTED = 48, 24, 12  # states that are compared, that are laid on the floor, and for each mistake
_NO_CONSTRAINTS, _NO_SENSORS, _NO_CONTACTS = (
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in ("CONSTRAINT", "SENSOR", "CONTACT")
)
_NO_LIMITS = int(mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS) | _NO_CONTACTS
_PARTS: tuple[list[int], ...] = ([3, 5], [2], [], [])
"""Where (roll, pitch) and yaw begin behind (x, y, z) in the degrees of freedom of a joint, by its type."""
Sample = tuple[Floats, Floats, Floats, Floats]  # qpos, qvel, ctrl and forces on the degrees of freedom


@dataclass(frozen=True)
class Proof:
    """What the simulator says of a match. A gap is a share: 0 is a perfect mirror, 1 no mirror at all.

    Attributes:
        joints: [joints] the root mean square gap of the accelerations of each joint over theirs, without constraints;
            of a free or ball joint the worst of (x, y, z), with gravity, (roll, pitch) and yaw, each over its own
            size; of a model with equalities, as of closed loops and mimic joints, the larger of those with and without.
        planted: [joints] the smallest gap of mistakes planted at each.
        median: of the states' gaps: |difference| / |accelerations|.
        constraints: the same median with limits, friction and equalities.
        contacts: the same median where the robot lies on a floor; None where it cannot move freely, or touches none.
        worst: the largest gap of a state with any of these.
        sensors: by name, the gap of a sensor's readings, turned as fits best, from those of its image, the sensor of
            its kind that fits best: a share of their own spread, without constraints.
        unlike: what is not as that of its image, or not covered, though no state need show it: shapes and contacts,
            limits of joints, tendons and actuators, sampling of sensors.
        unjudged: kinds of sensors that are not compared: they show nothing without constraints, as those of touch, or
            attitudes, or are of `NO_MIRROR`.
    """

    joints: Floats
    planted: Floats
    median: float
    constraints: float
    contacts: float | None
    worst: float
    sensors: Mapping[str, float]
    unjudged: tuple[str, ...]
    unlike: tuple[str, ...]

    @property
    def gap(self) -> float:
        """The largest gap of a joint's accelerations."""
        return float(self.joints.max(initial=0))

    @property
    def broken_sensors(self) -> list[str]:
        """Sensors that no sensor is the image of, the worst first."""
        return sorted((name for name, gap in self.sensors.items() if gap > NEARLY), key=lambda n: -self.sensors[n])

    @property
    def verdict(self) -> str:
        """Whether the mirror is "exact", "nearly" right, right but for "broken sensors", or "broken"."""
        if not self.gap <= NEARLY:  # nor NaN
            return "broken"
        most = np.max([self.gap, self.worst, *self.sensors.values()])  # may be NaN
        is_exact = most <= EXACT and not self.unlike
        return "broken sensors" if self.broken_sensors else "exact" if is_exact else "nearly"

    @property
    def summary(self) -> dict[str, Any]:
        """The verdict and all gaps, as JSON takes them."""
        gaps = {name: value for name, value in vars(self).items() if name not in ("joints", "planted")}
        return {"verdict": self.verdict, "gap": self.gap, **gaps, "smallest_planted": float(self.planted.min())}

    def would_show(self, planted: float) -> bool:
        """Return whether a mistake of this gap can be told from the gap that is there without one."""
        return planted > max(SEEN * self.gap, 2 * EXACT)

    def __str__(self) -> str:
        contact = "" if self.contacts is None else f", in contact to {self.contacts:.2g}"
        if self.worst > EXACT >= max(self.constraints, self.contacts or 0.0):
            contact += f", but in one state to {self.worst:.2g}"
        if worst := max(self.sensors, key=self.sensors.__getitem__, default=None):
            contact += f", sensors to {self.sensors[worst]:.2g} ({worst})"
        return (
            f"accelerations agree to {self.gap:.2g} at the worst joint, {self.median:.2g} in the median, with limits "
            f"and friction to {self.constraints:.2g}{contact}; the least planted mistake is off by "
            f"{self.planted.min():.2g}"
        )


def prove(frame: Frame, match: Match, seed: int = 0) -> Proof:
    """Compare accelerations of states and of their images, and of planted mistakes."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(frame.model)
    samples = [_state(frame, data, rng) for _ in range(_STATES)]
    here, there = (_accelerations(frame, data, some, _NO_CONSTRAINTS) for some in (samples, _images(match, samples)))

    def mistaken(wrong: Match) -> float:
        seen = _accelerations(frame, data, _images(wrong, samples[:_PLANTED]), _NO_CONSTRAINTS | _NO_SENSORS)
        return float(_gaps(frame, wrong, here[:_PLANTED], seen)[0].max())

    def compared(states: list[Sample], disabled: int) -> tuple[Floats, Floats]:
        """Return the gaps of joints and of states without what the flags disable."""
        pair = (_accelerations(frame, data, some, disabled | _NO_SENSORS) for some in (states, _images(match, states)))
        return _gaps(frame, match, *pair)

    joints, free = _gaps(frame, match, here, there)
    if frame.model.neq:
        joints = np.maximum(joints, compared(samples, _NO_LIMITS)[0])
    planted = [min(mistaken(wrong) for wrong in _mistakes(frame, match, joint)) for joint in range(frame.model.njnt)]
    lying = [low for sample in samples[:_LYING] if (low := _lowered(frame, data, sample)) is not None]
    cases = [(samples, _NO_CONTACTS), (samples, 0), (lying, 0)]
    held = [compared(states, disabled)[1] for states, disabled in cases if states]
    median, *medians = (float(np.median(gaps)) for gaps in (free, *held))
    worst = float(np.concatenate(held).max())
    sensors, unjudged, unlike = _sensors(frame, here, there)
    unmet = ("contacts with the world (not covered: no state has any)",)
    unlike += unmet * (frame.base is not None and 0 in frame.shapes and not lying)
    off = np.flatnonzero(frame.model.eq_active0 == 0).tolist()
    unlike += tuple(f"{printable(frame.name('equality', k))} (not covered: it is switched off)" for k in off)
    lain = medians[2] if lying else None
    return Proof(joints, np.array(planted), median, medians[0], lain, worst, sensors, unjudged, unlike)


def _state(frame: Frame, data: Any, rng: np.random.Generator) -> Sample:
    """Draw a state: joints within their limits, the base turned about any axis, controls within theirs."""
    frame.stop_if_late()
    model = frame.model
    qpos = model.qpos0.copy()
    for j, kind in enumerate(model.jnt_type):
        where = frame.qpos_of(j)
        if kind in (FREE, BALL):
            turn = rng.normal(size=4) + (0 if kind == FREE else [4, 0, 0, 0])
            qpos[where][-4:] = turn / np.linalg.norm(turn)
        else:
            qpos[where] = rng.uniform(*(model.jnt_range[j] if model.jnt_limited[j] else qpos[where] + [-1, 1]))
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited[:, None], model.actuator_ctrlrange, [-1, 1]).T
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    force, column = rng.normal(size=model.nv), np.zeros(model.nv)
    for k, unit in enumerate(np.eye(model.nv)):  # about 10 rad/s2 at each joint, light or heavy
        mujoco.mj_mulM(model, data, column, unit)
        force[k] *= 10 * column[k]
    for start in model.jnt_dofadr[model.jnt_type == FREE]:
        force[start : start + 6] = 0  # a robot is not held in the air
    return qpos, rng.normal(size=model.nv), rng.uniform(low, high), force


def _images(match: Match, samples: Sequence[Sample]) -> list[Sample]:
    return [
        (match.qpos @ q + match.offset, match.qvel @ v, match.ctrl @ u, match.qvel @ force)
        for q, v, u, force in samples
    ]


def _accelerations(frame: Frame, data: Any, samples: Sequence[Sample], disabled: int) -> Floats:
    """Return qacc and readings of sensors [states, nv + numbers of sensors] without what the flags disable.

    Actuators with dynamics or a delay act as they do once they have followed their controls.
    """
    model, found = frame.model, []
    before, delays = model.opt.disableflags, model.actuator_delay.copy()
    model.opt.disableflags, model.actuator_delay[:] = before | disabled, 0
    try:
        for sample in samples:
            frame.stop_if_late()
            data.qpos[:], data.qvel[:], data.ctrl[:], data.qfrc_applied[:] = sample
            data.act[:] = np.repeat(data.ctrl, model.actuator_actnum)
            data.qacc_warmstart[:] = 0
            mujoco.mj_forward(model, data)
            found.append(np.r_[data.qacc, data.sensordata])
    finally:
        model.opt.disableflags, model.actuator_delay[:] = before, delays
    return np.stack(found)


def _gaps(frame: Frame, match: Match, here: Floats, there: Floats) -> tuple[Floats, Floats]:
    """Return the gap of each joint, and that of each state, of what `_accelerations` returns."""
    here, there = here[:, : frame.model.nv], there[:, : frame.model.nv]
    wanted = here @ match.qvel.T
    wrong, size = np.square(wanted - there), np.square(wanted)
    least = max(1e-12 * size.mean(), 1e-24)
    joints = np.zeros(frame.model.njnt)
    for j, kind in enumerate(frame.model.jnt_type):
        span = frame.dofs_of(j)
        floor = max(1e-6 * size[:, span].mean(), least)  # a part that hardly moves shows rounding alone
        for dofs in np.split(np.r_[span], _PARTS[kind]):
            gap = np.sqrt(wrong[:, dofs].mean() / max(size[:, dofs].mean(), floor))
            joints[j] = np.maximum(joints[j], gap)  # NaN stays
    return joints, np.sqrt(wrong.sum(1) / np.maximum(size.sum(1), 1e-24))


def _sensors(frame: Frame, here: Floats, there: Floats) -> tuple[dict[str, float], tuple[str, ...], tuple[str, ...]]:
    """Return the gap of each sensor by its name, the kinds that are not judged, and what is unlike; see `Proof`."""
    model, alike = frame.model, dict[tuple[int, int], list[int]]()
    for s, (kind, width) in enumerate(zip(model.sensor_type.tolist(), model.sensor_dim.tolist(), strict=True)):
        alike.setdefault((kind, width), []).append(s)
    found, unjudged, unlike = dict[str, float](), set[str](), list[str]()
    how = frame.properties("sensor", "interval", "delay", "noise", "cutoff")
    for (kind, width), some in alike.items():
        index = model.nv + model.sensor_adr[some][:, None] + np.arange(width)
        # readings [sensors, states, width] are compared up to where their zero is
        own, other = (np.moveaxis(x[:, index] - x[:, index].mean(0), 0, 1) for x in (here, there))
        size, there_size = (np.square(x).sum((1, 2)) for x in (own, other))
        for k, s in enumerate(some):
            if width not in (1, 3) or kind in NO_MIRROR or not size[k] > 1e-18:
                unjudged.add(mujoco.mjtSensor(kind).name.removeprefix("mjSENS_").lower())
                continue
            # the turn that fits best leaves |x|^2 + |y|^2 - 2 (the sum of the singular values of x'y)
            fit = np.linalg.svd(np.einsum("si,nsj->nij", own[k], other), compute_uv=False).sum(-1)
            left = np.sqrt(np.maximum(size[k] + there_size - 2 * fit, 0) / size[k])
            name = printable(model.sensor(s).name or f"sensor {s}")
            found[name] = float(left.min())
            images = np.array(some)[left <= max(left.min(), EXACT)]
            unlike += [
                f"{what} of {name}" for what, x in how.items() if not any(np.array_equal(x[s], x[i]) for i in images)
            ]
    return found, tuple(sorted(unjudged)), tuple(unlike)


def _mistakes(frame: Frame, match: Match, joint: int) -> Iterator[Match]:
    """Yield matches with one mistake at a joint: a wrong sign of it and its partner, and both kept in place."""
    partner = int(match.joint[joint])
    pair = sorted({joint, partner})
    q, v = [np.r_[frame.qpos_of(j)] for j in pair], [np.r_[frame.dofs_of(j)] for j in pair]
    qpos, qvel = match.qpos.copy(), match.qvel.copy()
    for matrix, rows in [*((qpos, x) for x in q), *((qvel, x) for x in v)]:
        matrix[rows[-3:]] *= -1  # of quaternions, only the part that is an axis
    yield replace(match, qpos=qpos, qvel=qvel)
    if partner != joint and match.joint[partner] == joint:
        qpos, qvel = match.qpos.copy(), match.qvel.copy()
        qpos[np.concatenate(q)], qvel[np.concatenate(v)] = qpos[np.concatenate(q[::-1])], qvel[np.concatenate(v[::-1])]
        yield replace(match, qpos=qpos, qvel=qvel)


def _lowered(frame: Frame, data: Any, sample: Sample) -> Sample | None:
    """Return a state with the base so low that the robot just touches something; None where it never does."""
    if frame.base is None:
        return None
    height = frame.qpos_of(frame.base).start + 2

    def touches(place: float) -> int:
        frame.stop_if_late()
        data.qpos[:] = sample[0]
        data.qpos[height] = place
        mujoco.mj_fwdPosition(data.model, data)
        return int(data.ncon)

    start, reach = float(sample[0][height]), 4 * frame.size
    # a robot that begins high finds a floor at the middle of what stands in the world
    stands = sorted((float(frame.geom_places[g, 2]) for g, *_ in frame.shapes.get(0, [])), reverse=True)
    high, own = start + reach, touches(start + reach)
    low = next((z for z in (start - reach, *stands) if z < start and touches(z) > own), None)
    if low is None:
        return None
    for _ in range(math.ceil(math.log2((high - low) / reach * 500))):
        middle = (high + low) / 2
        high, low = (high, middle) if touches(middle) > own else (middle, low)
    qpos = sample[0].copy()
    qpos[height] = low
    return (qpos, *sample[1:])
