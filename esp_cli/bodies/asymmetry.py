"""What of a model is not its own image: by joint, the property that differs most."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from esp_cli.bodies.deriving import Match
from esp_cli.bodies.frame import HINGE, SLIDE, Frame, image_of_axis
from esp_cli.symmetry.elements import Floats


@dataclass(frozen=True)
class Difference:
    """The property of a joint that differs most from that of its image.

    Attributes:
        what: "mass", "range", "gain", ...; empty where nothing differs.
        share: the difference over the larger of the two; of places, over the robot's size.
    """

    what: str
    share: float


def differences(frame: Frame, match: Match) -> list[Difference]:
    """Return for each joint what differs most: 0 of a joint that is the exact image of its partner's."""
    model, R = frame.model, frame.image(match.element)
    found = []
    for i, j in enumerate(match.joint.tolist()):
        shares = _of_joint(frame, R, i, j)
        for a in np.flatnonzero(model.actuator_trnid[:, 0] == i):
            if model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and match.ctrl[:, a].any():
                shares |= _of_actuator(frame, match, int(a))
        what, share = max(shares.items(), key=lambda item: item[1])
        found.append(Difference(what if share > 1e-9 else "", share))
    return found


def _of_joint(frame: Frame, R: Floats, i: int, j: int) -> dict[str, float]:
    model = frame.model
    (b, c), (v, w) = model.jnt_bodyid[[i, j]], model.jnt_dofadr[[i, j]]
    shares = {
        "mass": _share(frame.mass[b], frame.mass[c]),
        "middle of mass": float(np.linalg.norm(R @ frame.com[b] - frame.com[c]) / frame.size),
        "inertia": _share(R @ frame.inertia[b] @ R.T, frame.inertia[c]),
        "damping": _share(model.dof_damping[v], model.dof_damping[w]),
        "armature": _share(model.dof_armature[v], model.dof_armature[w]),
        "friction": _share(model.dof_frictionloss[v], model.dof_frictionloss[w]),
        "stiffness": _share(model.jnt_stiffness[i], model.jnt_stiffness[j]),
    }
    if model.jnt_type[i] in (SLIDE, HINGE):
        axis = image_of_axis(frame, R, i)
        sign = np.copysign(1.0, axis @ frame.axis[j])
        shares["axis"] = float(np.linalg.norm(axis - sign * frame.axis[j]))
        limits = [model.jnt_range[k] * model.jnt_limited[k] - model.qpos0[frame.qpos_of(k)] for k in (i, j)]
        shares["range"] = _share(np.sort(sign * limits[0]), limits[1])
    return shares


def _of_actuator(frame: Frame, match: Match, a: int) -> dict[str, float]:
    model, b = frame.model, int(np.abs(match.ctrl[:, a]).argmax())
    names = {"gain": "gainprm", "bias": "biasprm", "force range": "forcerange", "control range": "ctrlrange"}
    values = {what: getattr(model, f"actuator_{name}")[[a, b]] for what, name in names.items()}
    for what in ("force range", "control range"):
        values[what] = [np.sort(match.ctrl[b, a] * values[what][0]), values[what][1]]
    values["gear"] = np.abs(model.actuator_gear[[a, b]])
    return {what: _share(*pair) for what, pair in values.items()}


def _share(a: Floats | float, b: Floats | float) -> float:
    """Return the largest difference of two numbers or arrays over the largest of their sizes."""
    largest = max(np.abs(a).max(), np.abs(b).max())
    return float(np.abs(np.subtract(a, b)).max() / largest) if largest > 1e-12 else 0.0
