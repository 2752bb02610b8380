"""What of a model is not its own image: by joint, the property that differs most."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from esp_cli.bodies.deriving import HINGE, SLIDE, Frame, Match, image_of_axis
from esp_cli.bodies.kinds import space
from esp_cli.symmetry.elements import Floats

_ACTUATOR = {"gain": "actuator_gainprm", "bias": "actuator_biasprm", "force range": "actuator_forcerange"}


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
    R = space(match.element.matrix)
    image = np.abs(match.ctrl).argmax(0) if len(match.ctrl) else np.zeros(0, int)
    found = []
    for i, j in enumerate(match.joint):
        shares = _of_body(frame, R, i, int(j)) | _of_joint(frame, R, i, int(j))
        for a in np.flatnonzero(frame.model.actuator_trnid[:, 0] == i):
            if frame.model.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and np.abs(match.ctrl[:, a]).any():
                shares |= _of_actuator(frame.model, int(a), int(image[a]), float(match.ctrl[image[a], a]))
        what, share = max(shares.items(), key=lambda item: item[1])
        found.append(Difference(what if share > 1e-9 else "", float(share)))
    return found


def _of_body(frame: Frame, R: Floats, i: int, j: int) -> dict[str, float]:
    model = frame.model
    b, c = model.jnt_bodyid[[i, j]]
    inertia = frame.inertia[[b, c]]
    return {
        "mass": _share(frame.mass[b], frame.mass[c]),
        "middle of mass": float(np.linalg.norm(R @ frame.com[b] - frame.com[c]) / frame.size),
        "inertia": _share(R @ inertia[0] @ R.T, inertia[1]),
    }


def _of_joint(frame: Frame, R: Floats, i: int, j: int) -> dict[str, float]:
    model = frame.model
    v, w = model.jnt_dofadr[[i, j]]
    shares = {
        "damping": _share(model.dof_damping[v], model.dof_damping[w]),
        "armature": _share(model.dof_armature[v], model.dof_armature[w]),
        "friction": _share(model.dof_frictionloss[v], model.dof_frictionloss[w]),
        "stiffness": _share(model.jnt_stiffness[i], model.jnt_stiffness[j]),
    }
    if model.jnt_type[i] in (SLIDE, HINGE):
        axis = image_of_axis(frame, R, i)
        sign = np.copysign(1.0, axis @ frame.axis[j])
        shares["axis"] = float(np.linalg.norm(axis - sign * frame.axis[j]))
        limits = [model.jnt_range[k] * model.jnt_limited[k] - model.qpos0[model.jnt_qposadr[k]] for k in (i, j)]
        shares["range"] = _share(np.sort(sign * limits[0]), limits[1])
    return shares


def _of_actuator(model: Any, a: int, b: int, sign: float) -> dict[str, float]:
    shares = {what: _share(getattr(model, name)[a], getattr(model, name)[b]) for what, name in _ACTUATOR.items()}
    shares["force range"] = _share(np.sort(sign * model.actuator_forcerange[a]), model.actuator_forcerange[b])
    shares["control range"] = _share(np.sort(sign * model.actuator_ctrlrange[a]), model.actuator_ctrlrange[b])
    shares["gear"] = _share(np.abs(model.actuator_gear[a]), np.abs(model.actuator_gear[b]))
    return shares


def _share(a: Floats | float, b: Floats | float) -> float:
    """Return the largest difference of two numbers or arrays over the largest of their sizes."""
    largest = max(np.abs(a).max(), np.abs(b).max())
    return float(np.abs(np.subtract(a, b)).max() / largest) if largest > 1e-12 else 0.0
