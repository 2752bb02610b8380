"""Search a model for its symmetries, and say by joint which property differs most from that of its image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import product

import mujoco
import numpy as np

from esp_cli.bodies.deriving import Match, actuator_shares, derive
from esp_cli.bodies.frame import BALL, HINGE, SLIDE, Frame, image_of_axis, share
from esp_cli.bodies.proof import EXACT, Proof, prove
from esp_cli.bodies.reading import printable
from esp_cli.bodies.touching import shape_images, unlike_contacts
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError

_TURNS = sorted({Fraction(k, n) for n in (2, 3, 4, 5, 6, 8) for k in range(1, n)})
_AXES = sorted({Fraction(k, n) for n in (10, 16, 24) for k in range(n)})
TRIED = tuple(
    dict.fromkeys(
        [PlaneElement(mirrored=True), PlaneElement(Fraction(1, 2), mirrored=True)]
        + [PlaneElement(turn) for turn in _TURNS]
        + [PlaneElement(turn, mirrored=True) for turn in _AXES]
    )
)
"""The elements that a model is searched for: turns by 1/2 to 1/6 and 1/8, and mirrors in lines between them."""

LIMITS = (
    *("range", "stops", "torque range", "force range", "control range", "activation range", "early activation"),
    *("dynamics", "delay", "springyield", "limits or spring"),
)
"""Properties that accelerations show only where a state reaches them."""
_AT_JOINTS = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


@dataclass(frozen=True)
class Difference:
    """The property of a joint that differs most from that of its image."""

    what: str  # "mass", "range", "gain", ...; empty where nothing differs
    share: float  # the difference over the larger of the two; of places, over the robot's size
    shares: Mapping[str, float]  # those of all properties: masses, inertia, limits, gains, damping and others


@dataclass(frozen=True)
class Found:
    """What is known of one element of a model: its match, the proof, and what differs, by joint and of a free base."""

    match: Match
    proof: Proof
    differences: list[Difference] = field(repr=False)
    base: Difference | None = None


def find(frame: Frame, tolerated: float) -> tuple[dict[PlaneElement, Found], dict[str, str]]:
    """Return the elements that a model has, and by name why others do not hold."""
    idle: set[PlaneElement] = set()  # a mirror in the plane of a planar robot
    found: dict[PlaneElement, Found] = {}
    refused: dict[str, str] = {}
    for element in TRIED:
        if any(element @ still in found for still in idle):
            continue
        try:
            frame.stop_if_late()
            match = derive(frame, element)
            if match.is_trivial:
                idle.add(element)
                continue
            proof = prove(frame, match)
            if max(proof.gap, proof.planted.max()) <= 2 * EXACT:
                raise UserError("not covered: no mistake would show in accelerations")
        except UserError as error:
            if element in TRIED[:2] or frame.is_late:
                refused[element.name] = str(error)
            continue
        if lost := [printable(frame.name("actuator", a)) for a in np.flatnonzero(~match.ctrl.any(0)).tolist()]:
            refused[element.name] = f"no image was found of the actuators {', '.join(lost)}"
        elif not proof.gap <= tolerated:  # nor NaN
            worst = printable(frame.name("joint", int(proof.joints.argmax())))
            refused[element.name] = f"accelerations of {worst} differ by {proof.gap:.2g} of their size"
        elif not proof.constraints <= tolerated:
            refused[element.name] = (
                f"with limits, friction and equalities accelerations differ by {proof.constraints:.2g}"
            )
        else:
            differ = differences(frame, match)
            others = *unlike_contacts(frame, match, EXACT), *_unlike_limits(frame, match, differ)
            proof = replace(proof, unlike=(*proof.unlike, *others))
            found[element] = Found(match, proof, differ, None if frame.base is None else differ[frame.base])
    while wrong := _outside(found, idle):
        del found[wrong]
        refused[wrong.name] = "its products with the other symmetries do not hold, or are not tried"
    return found, refused


def _outside(found: Mapping[PlaneElement, Found], idle: set[PlaneElement]) -> PlaneElement | None:
    """Return the element most of whose products are not among them or do something else; of equal ones the last."""
    wrong = Counter[PlaneElement]()
    for (g, first), (h, second) in product(found.items(), repeat=2):
        if (g @ h).is_identity or g @ h in idle:
            continue
        made, there = first.match.qvel @ second.match.qvel, found.get(g @ h)
        if there is None or not np.allclose(there.match.qvel, made, atol=1e-6):
            wrong.update({g, h})
    return max(wrong, key=lambda g: (wrong[g], TRIED.index(g)), default=None)


def differences(frame: Frame, match: Match) -> list[Difference]:
    """Return for each joint what differs most: 0 of a joint that is the exact image of its partner's."""
    found = []
    for i, j in enumerate(match.joint.tolist()):
        shares = _of_joint(frame, match.world, i, j)
        for a in np.flatnonzero(frame.model.actuator_trnid[:, 0] == i):
            if frame.model.actuator_trntype[a] in _AT_JOINTS:
                shares |= _of_actuator(frame, match, int(a))
        what, most = max(shares.items(), key=lambda item: item[1])
        found.append(Difference(what if most > 1e-9 else "", most, shares))
    return found


def _unlike_limits(frame: Frame, match: Match, differ: list[Difference]) -> list[str]:
    """Return the limits of joints, actuators and tendons that are not as those of their images."""
    told = [("joint", j, one.shares) for j, one in enumerate(differ)]
    pulling = [a for a, kind in enumerate(frame.model.actuator_trntype) if kind not in _AT_JOINTS]
    told += [("actuator", a, _of_actuator(frame, match, a)) for a in pulling]
    told += [("tendon", t, _of_tendon(frame, match, t)) for t in range(frame.model.ntendon)]
    return [
        f"{what} of {printable(frame.name(kind, k))}"
        for kind, k, shares in told
        for what in LIMITS
        if shares.get(what, 0.0) > EXACT
    ]


def _of_joint(frame: Frame, R: Floats, i: int, j: int) -> dict[str, float]:
    model = frame.model
    (b, c), (v, w) = model.jnt_bodyid[[i, j]], model.jnt_dofadr[[i, j]]
    shares = {
        "mass": share(frame.mass[b], frame.mass[c]),
        "middle of mass": float(np.linalg.norm(R @ frame.com[b] - frame.com[c]) / frame.size),
        "geometry": max((gap for *_, gap in shape_images(frame, R, b, c)), default=0.0),
        "inertia": share(R @ frame.inertia[b] @ R.T, frame.inertia[c]),
        "damping": share(model.dof_damping[v], model.dof_damping[w]),
        "armature": share(model.dof_armature[v], model.dof_armature[w]),
        "friction": share(model.dof_frictionloss[v], model.dof_frictionloss[w]),
        "stiffness": share(model.jnt_stiffness[i], model.jnt_stiffness[j]),
    }
    limited = model.jnt_limited[[i, j]]
    stops = [np.r_[model.jnt_solref[k], model.jnt_solimp[k], model.jnt_margin[k]] for k in (i, j)]
    shares["stops"] = share(*stops) if limited.any() else 0.0
    shares |= {what: share(x[i], x[j]) for what, x in frame.properties("jnt", "springyield").items()}
    if model.jnt_type[i] == BALL:
        shares["range"] = share(*model.jnt_range[[i, j]] * limited[:, None])
    if model.jnt_type[i] in (SLIDE, HINGE):
        axis = image_of_axis(frame, R, i)
        sign = np.copysign(1.0, axis @ frame.axis[j])
        shares["axis"] = float(np.linalg.norm(axis - sign * frame.axis[j]))
        limits = [model.jnt_range[k] * model.jnt_limited[k] - model.qpos0[frame.qpos_of(k)] for k in (i, j)]
        shares["range"] = share(np.sort(sign * limits[0]), limits[1])
        torques = [model.jnt_actfrcrange[k] * model.jnt_actfrclimited[k] for k in (i, j)]
        shares["torque range"] = share(np.sort(sign * torques[0]), torques[1])
    return shares


def _of_tendon(frame: Frame, match: Match, t: int) -> dict[str, float]:
    """Return how far limits and spring of a tendon are from those of its image; of one without, from none."""
    model, image, rest = frame.model, match.tendons[:, t], frame.model.tendon_length0[:, None]
    u, sign, limited = int(np.abs(image).argmax()), image.sum(), model.tendon_limited[:, None]
    slack = (model.tendon_lengthspring - rest) * (model.tendon_stiffness != 0)[:, None]
    ranges = [
        (model.tendon_range - rest) * limited,
        slack,
        model.tendon_actfrcrange * model.tendon_actfrclimited[:, None],
    ]
    stops = [np.column_stack([model.tendon_solref_lim, model.tendon_solimp_lim, model.tendon_margin]) * limited]
    stops += frame.properties("tendon", "springyield").values()
    shares = [share(np.sort((sign or 1.0) * x[t]), x[u] * abs(sign)) for x in ranges]
    return {"limits or spring": max(*shares, *(share(x[t], x[u] * abs(sign)) for x in stops))}


def _of_actuator(frame: Frame, match: Match, a: int) -> dict[str, float]:
    b = int(np.abs(match.ctrl[:, a]).argmax())
    return actuator_shares(frame.model, a, b, match.ctrl[b, a])
