"""Prove in the simulator that a match is a symmetry: accelerations of mirrored states are mirrored accelerations.

For random states, controls and forces, M qacc(q, v, u, f) is compared with qacc(M q, M v, M u, M f). The comparison is
its own control: planted mistakes (the sign of a joint pair, a joint that stays with itself) have to show.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from esp_cli.bodies.deriving import BALL, FREE, QPOS_WIDTH, Frame, Match
from esp_cli.bodies.reading import quiet
from esp_cli.symmetry.elements import Floats

EXACT, NEARLY = 1e-5, 0.05
"""Largest gap of a mirror that is exact up to rounding, and of one that holds but for a model's small asymmetry."""
SEEN = 3.0
"""How many times the gap of a planted mistake exceeds the gap without it, where the proof would have seen it."""
_Flag = mujoco.mjtDisableBit
_SMOOTH, _LIMITED, _TOUCHING = int(_Flag.mjDSBL_CONSTRAINT), int(_Flag.mjDSBL_CONTACT), 0


@dataclass(frozen=True)
class Proof:
    """What the simulator says of a match. A gap is a share: 0 is a perfect mirror, 1 no mirror at all.

    Attributes:
        joints: [joints] the root mean square gap of the accelerations of each joint over theirs, without constraints.
        median: of the states' gaps: |difference| / |accelerations|.
        constraints: the same median with limits, friction and equalities.
        contacts: the same median where the robot lies on a floor; None where it cannot move freely, or touches none.
        planted: by joint the smallest gap of mistakes planted there.
        states: how many were compared.
    """

    joints: Floats
    median: float
    constraints: float
    contacts: float | None
    planted: Floats
    states: int

    @property
    def gap(self) -> float:
        """The largest gap of a joint's accelerations."""
        return float(self.joints.max(initial=0))

    @property
    def verdict(self) -> str:
        """Whether the mirror is "exact", "nearly" right, or "broken"."""
        most = max(self.gap, self.constraints, self.contacts or 0.0)
        return "exact" if most <= EXACT else "nearly" if self.gap <= NEARLY else "broken"

    def would_show(self, planted: float) -> bool:
        """Return whether a mistake of this gap can be told from the gap that is there without one."""
        return planted > max(SEEN * self.gap, 2 * EXACT)


def prove(frame: Frame, match: Match, states: int = 48, seed: int = 0) -> Proof:
    """Compare accelerations of states and of their images, and of planted mistakes."""
    model, rng = frame.model, np.random.default_rng(seed)
    samples = [_state(frame, rng) for _ in range(states)]
    with quiet():
        worlds = _Worlds(model)
        with worlds.only(_SMOOTH):
            here = worlds.accelerations(samples)
            joints, median = _gaps(frame, match, here, worlds.accelerations(_images(match, samples)))
            fewer = samples[:12]
            planted = [
                min(_gaps(frame, wrong, here[:12], worlds.accelerations(_images(wrong, fewer)))[0].max(initial=0)
                    for wrong in _mistakes(frame, match, joint))
                for joint in range(model.njnt)
            ]  # fmt: skip
        with worlds.only(_LIMITED):
            _, constraints = worlds.compared(frame, match, samples)
        contacts = None
        lowered = [worlds.lowered(frame, sample) for sample in samples[:24]] if frame.base is not None else []
        lying = [sample for sample in lowered if sample is not None]
        if lying:
            with worlds.only(_TOUCHING):
                _, contacts = worlds.compared(frame, match, lying)
    return Proof(joints, median, constraints, contacts, np.array(planted), states)


Sample = tuple[Floats, Floats, Floats, Floats]
"""qpos, qvel, ctrl and forces on the degrees of freedom."""


def _state(frame: Frame, rng: np.random.Generator) -> Sample:
    """Draw a state: joints within their limits, the base turned about any axis, controls within theirs."""
    model = frame.model
    qpos = model.qpos0.copy()
    for j in range(model.njnt):
        start, kind = model.jnt_qposadr[j], model.jnt_type[j]
        if kind in (FREE, BALL):
            turn = rng.normal(size=4) + (0 if kind == FREE else [4, 0, 0, 0])
            qpos[start + QPOS_WIDTH[kind] - 4 :][:4] = turn / np.linalg.norm(turn)
        else:
            low, high = model.jnt_range[j] if model.jnt_limited[j] else qpos[start] + np.array([-1, 1])
            qpos[start] = rng.uniform(low, high)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(limited[:, None], model.actuator_ctrlrange, [-1, 1]).T
    data = mujoco.MjData(model)
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


def _gaps(frame: Frame, match: Match, here: Floats, there: Floats) -> tuple[Floats, float]:
    """Return the gap of each joint, and the median of the states' gaps, of accelerations [states, nv]."""
    wanted, model = here @ match.qvel.T, frame.model
    wrong, size = np.square(wanted - there), np.square(wanted)
    joints = np.zeros(model.njnt)
    total = max(size.mean(), 1e-24)
    for j in range(model.njnt):
        where = frame.dofs_of(j)
        joints[j] = np.sqrt(wrong[:, where].mean() / max(size[:, where].mean(), 1e-12 * total))
    states = np.sqrt(wrong.sum(1) / np.maximum(size.sum(1), 1e-24))
    return joints, float(np.median(states))


def _mistakes(frame: Frame, match: Match, joint: int) -> Iterator[Match]:
    """Yield matches with one mistake at a joint: a wrong sign of it and its partner, and both kept in place."""
    partner = int(match.joint[joint])
    pair = sorted({joint, partner})
    q, v = [np.r_[frame.qpos_of(j)] for j in pair], [np.r_[frame.dofs_of(j)] for j in pair]
    qpos, qvel = match.qpos.copy(), match.qvel.copy()
    for rows_q, rows_v in zip(q, v, strict=True):
        # of quaternions, only the part that is an axis
        qpos[rows_q[-3:] if len(rows_q) > 1 else rows_q] *= -1
        qvel[rows_v[-3:] if len(rows_v) > 1 else rows_v] *= -1
    yield replace(match, qpos=qpos, qvel=qvel)
    if partner != joint and match.joint[partner] == joint:
        qpos, qvel = match.qpos.copy(), match.qvel.copy()
        qpos[np.concatenate(q)], qvel[np.concatenate(v)] = qpos[np.concatenate(q[::-1])], qvel[np.concatenate(v[::-1])]
        yield replace(match, qpos=qpos, qvel=qvel)


class _Worlds:
    """A model to take accelerations from, with a floor to lie on."""

    def __init__(self, model: Any) -> None:
        self.model, self.data = model, mujoco.MjData(model)

    @contextmanager
    def only(self, disabled: int) -> Iterator[None]:
        """Leave out what the flags disable."""
        before = self.model.opt.disableflags
        self.model.opt.disableflags = before | disabled
        try:
            yield
        finally:
            self.model.opt.disableflags = before

    def accelerations(self, samples: Sequence[Sample]) -> Floats:
        """Return qacc [states, nv]."""
        return np.stack([self._forward(sample).qacc.copy() for sample in samples])

    def compared(self, frame: Frame, match: Match, samples: Sequence[Sample]) -> tuple[Floats, float]:
        """Return the gaps of some states, see `_gaps`."""
        there = self.accelerations(_images(match, samples))
        return _gaps(frame, match, self.accelerations(samples), there)

    def lowered(self, frame: Frame, sample: Sample) -> Sample | None:
        """Return a state with the base so low that the robot just touches something, or None where it never does."""
        qpos, others = sample[0], sample[1:]
        height = int(self.model.jnt_qposadr[frame.base]) + 2
        high, low = qpos.copy(), qpos.copy()
        high[height] += 4 * frame.size
        low[height] -= 4 * frame.size
        own = self._touches(high)
        if self._touches(low) <= own:
            return None
        for _ in range(10):
            middle = (high + low) / 2
            high, low = (high, middle) if self._touches(middle) > own else (middle, low)
        return (low, *others)

    def _touches(self, qpos: Floats) -> int:
        self.data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self.model, self.data)
        return int(self.data.ncon)

    def _forward(self, sample: Sample) -> Any:
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:], self.data.qfrc_applied[:] = sample
        self.data.qacc_warmstart[:] = 0
        mujoco.mj_forward(self.model, self.data)
        return self.data
