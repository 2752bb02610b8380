"""A robot's body: the symmetries that its model has, and fields of layouts that follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, SupportsFloat

import mujoco
import numpy as np

from esp_cli.bodies import kinds
from esp_cli.bodies.finding import Difference, Found, find
from esp_cli.bodies.frame import Frame
from esp_cli.bodies.kinds import Parts, named_parts
from esp_cli.bodies.proof import NEARLY
from esp_cli.bodies.reading import MOST_BODIES, MOST_MOVING, printable, quiet, read_model
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind, Layout

SECONDS = 50.0  # processor time within which the search of a model ends
_OF_A_BASE = {
    "positions": {"place": slice(0, 3), "attitude": slice(3, 7)},
    "velocities": {"velocity": slice(0, 3), "spin": slice(3, 6)},
}
"""Where MuJoCo's state has a base that moves freely and is first, by what the rest is called."""


class Body:
    """A robot's joints, actuators and limbs, and where each of its symmetries sends them.

    body = Body.from_mjcf("ant.xml")
    body.group  # "d4": left-right, front-back, quarter turns
    observation = layout(body.gravity(), body.spin(), body.positions(), body.velocities())
    symmetry = Symmetry(observation=observation, action=Continuous(layout(body.controls())), group="flip-x")

    Axes are those of the base, as in MuJoCo, ROS and Isaac Lab: x forward, y left, z up. Then `flip-x` is left-right,
    `flip-y` front-back. Where the base is turned at rest, vectors are those that the body sees.

    Args:
        joints: names of the joints, in any order.
        mirror: by joint the joint that it is sent to, with "-" before it where the sign changes:
            {"hip_1": "-hip_4"}; joints that are left out follow from their partners. Or such tables by element:
            {"left-right": {...}, "front-back": {...}}; their products follow.
        limbs: tables alike of limbs, without signs: {"left-right": {"left_foot": "right_foot"}}.

    Attributes:
        joints: names of the joints that are no free base.
        actuators: names of the actuators, which for a body given by names are the joints.
        limbs: names of the bodies of a model.
        elements: the symmetries that the body has, without the identity.
        found: of a model, what is known of each element that holds, by its name.
        refused: of a model, elements that nearly hold, each with the reason why they do not.

    Raises:
        UserError: a table names no joint, or sends two joints to one.
    """

    def __init__(
        self,
        joints: Sequence[str],
        mirror: Mapping[str, str] | Mapping[str, Mapping[str, str]],
        limbs: Mapping[str, str] | Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        named = named_parts("joints", joints, mirror)
        self._numbers: dict[str, int] = {}
        self._is_free = False  # whether it has a base that moves freely
        self._stateless = "a body that is given by names has no state; make it of a model"  # why `state` has no layout
        self._is_turned = False  # whether the base's axes at rest are not the world's
        self.found: dict[str, Found] = {}
        self.refused: dict[str, str] = {}
        self._set(named, named, named, named_parts("limbs", None, limbs or {}))

    def _set(self, positions: Parts, velocities: Parts, controls: Parts, limbs: Parts) -> None:
        self._positions, self._velocities, self._controls, self._limbs = positions, velocities, controls, limbs
        self.joints, self.actuators, self.limbs = tuple(positions.places), tuple(controls.places), tuple(limbs.places)
        self.elements = tuple(positions.moves)

    @classmethod
    def from_mjcf(
        cls,
        model: Path | str | Any,
        root: Path | str | None = None,
        tolerated: float = NEARLY,
        seconds: float = SECONDS,
    ) -> Body:
        """Find and prove the symmetries of a model.

        Args:
            model: an MJCF or URDF file, or a `mujoco.MjModel`.
            root: the folder that holds all its files; by default that of the file.
            tolerated: the largest share by which accelerations of a joint may be off.
            seconds: of processor time, after which elements that are left are refused as not covered.

        Raises:
            UserError: the file cannot be read, or nothing of the model moves.
        """
        model = read_model(model, root) if isinstance(model, str | Path) else model
        if not isinstance(model, mujoco.MjModel):
            raise UserError(f"a model is given as {type(model).__name__}; give the path of a file, or a mujoco.MjModel")
        return cls._from_model(model, tolerated, seconds)

    @classmethod
    def from_urdf(
        cls,
        path: Path | str,
        root: Path | str | None = None,
        tolerated: float = NEARLY,
        floating: bool = True,
        seconds: float = SECONDS,
    ) -> Body:
        """Find and prove the symmetries of a URDF file; its first link moves freely unless `floating` is false."""
        return cls._from_model(read_model(path, root, floating, urdf_only=True), tolerated, seconds)

    @classmethod
    @quiet()
    def _from_model(cls, model: Any, tolerated: float, seconds: float) -> Body:
        if not 0 < model.nv <= MOST_MOVING or model.nu > MOST_MOVING or model.nbody > MOST_BODIES:
            raise UserError(
                f"the model has {model.nv} degrees of freedom, {model.nu} actuators and {model.nbody} bodies; give one "
                f"robot, with 1 to {MOST_MOVING} degrees of freedom and at most {MOST_MOVING} actuators and "
                f"{MOST_BODIES} bodies"
            )
        if np.any(getattr(model, "actuator_ctrlnum", 1) != 1):
            raise UserError("the model has actuators of no or several controls; give one with a control for each")
        self, frame = cls([], {}), Frame(model, seconds)
        names = {frame.name("joint", j): j for j in range(model.njnt) if j != frame.base}
        controls = {frame.name("actuator", a): slice(a, a + 1) for a in range(model.nu)}
        limbs = {frame.name("body", b): slice(b, b + 1) for b in range(model.nbody)}
        if len(names) + len(controls) + len(limbs) < model.njnt - (frame.base is not None) + model.nu + model.nbody:
            raise UserError("a joint, actuator or body without a name is called as another is; give each a name")
        found, self.refused = find(frame, tolerated)
        self.found = {element.name: one for element, one in found.items()}
        matches = {element: one.match for element, one in found.items()}
        self._set(
            Parts("joints", {n: frame.qpos_of(j) for n, j in names.items()}, {g: m.qpos for g, m in matches.items()}),
            Parts("joints", {n: frame.dofs_of(j) for n, j in names.items()}, {g: m.qvel for g, m in matches.items()}),
            Parts("actuators", controls, {g: m.ctrl for g, m in matches.items()}),
            Parts("limbs", limbs, {g: m.bodies for g, m in matches.items()}),
        )
        self._numbers = names
        self._is_free = frame.base is not None
        self._is_turned = not np.allclose(frame.axes, np.eye(3), atol=1e-6)
        first = 0 if frame.base is None else frame.qpos_of(frame.base).start
        shifted = [n for n in names if any(np.any(m.offset[frame.qpos_of(names[n])]) for m in matches.values())]
        self._stateless = (
            "the free joint is not the first of the model, so its state has no layout"
            if first
            else f"{printable(shifted[0])} has a reference that is not its image's, so its state has no layout"
            if shifted
            else "the base does not begin over the origin, so its state has no layout; leave x and y of its pos out"
            if any(np.any(m.offset) for m in matches.values())
            else ""
        )
        return self

    @property
    def group(self) -> str:
        """The symmetries as `Symmetry` and `--transforms` read them: "d2", "flip-x"; "c1" where there is none."""
        own = {PlaneElement(), *self.elements}
        for name in ("flip-x", "flip-y", *(f"{kind}{n}" for n in (2, 3, 4, 5, 6, 8) for kind in "cd")):
            if {PlaneElement(), *map(PlaneElement.of, parse_elements(name, 1))} == own:  # type: ignore[arg-type] # finite
                return name
        return ",".join(element.name for element in self.elements) or "c1"

    @property
    def not_covered(self) -> dict[str, str]:
        """Those of `refused` that may hold, since nobody looked, or nothing would have shown."""
        return {name: reason for name, reason in self.refused.items() if reason.startswith("not covered")}

    def unseen(self, element: str) -> list[str]:
        """Return the joints of a model at which no mistake in an element would show in accelerations."""
        would_show = self.found[element].proof.would_show
        return [joint for joint, _, _, _, planted, _ in self.rows(element) if not would_show(planted)]

    def rows(self, element: str) -> list[tuple[str, str, int, float, float, Difference]]:
        """Return of each joint of a model, for one of `found`: name, image, sign, gap, planted gap, difference.

        The sign is 0 for ball joints, which turn about three axes.
        """
        one, rows = self.found[element], []
        names = {j: name for name, j in self._numbers.items()}
        for name, joint in self._numbers.items():
            image = names[int(one.match.joint[joint])]
            block = one.match.qvel[self._velocities.places[image], self._velocities.places[name]]
            gaps = float(one.proof.joints[joint]), float(one.proof.planted[joint])
            sign = int(np.sign(block[0, 0])) if block.size == 1 else 0
            rows.append((name, image, sign, *gaps, one.differences[joint]))
        return rows

    def positions(self, joints: Sequence[str] | None = None, history: int = 1, name: str = "positions") -> Field:
        """Return the field of joint positions, relative to `qpos0` or to another pose that is its own image.

        Args:
            joints: in the order of the numbers; by default the model's.
            history: how many steps, one after the other.
            name: of the field.

        Raises:
            UserError: a joint is unknown, or its image is not among them.
        """
        return self._positions.field(name, self.joints if joints is None else joints, history)

    def velocities(self, joints: Sequence[str] | None = None, history: int = 1, name: str = "velocities") -> Field:
        """Return the field of joint velocities, accelerations or torques, see `positions`."""
        return self._velocities.field(name, self.joints if joints is None else joints, history)

    def controls(self, actuators: Sequence[str] | None = None, history: int = 1, name: str = "controls") -> Field:
        """Return the field of controls by actuator: targets, or the last action; see `positions`."""
        return self._controls.field(name, self.actuators if actuators is None else actuators, history)

    def contacts(self, limbs: Sequence[str], width: int = 1, history: int = 1, name: str = "contacts") -> Field:
        """Return the field of numbers by limb: contacts, air times, phases (`width` 2: cosine and sine).

        Raises:
            UserError: a limb is unknown, or its image is not among them.
        """
        return self._limbs.field(name, limbs, history, width)

    def scan(self, points: Sequence[Sequence[float]] | Floats, history: int = 1, name: str = "scan") -> Field:
        """Return the field of a height scan or of rays, see `points_field` and `grid`."""
        return kinds.points_field(name, points, self.elements, history)

    @staticmethod
    def gravity(history: int = 1, name: str = "gravity") -> Field:
        """Return the field of gravity's direction as the body sees it."""
        return Field(name, kinds.VECTOR_3D, history)

    @staticmethod
    def velocity(history: int = 1, name: str = "velocity") -> Field:
        """Return the field of the base's velocity (m/s) or another vector, as the body sees it.

        Where the base's axes at rest are the world's, also as the world sees it.
        """
        return Field(name, kinds.VECTOR_3D, history)

    @staticmethod
    def spin(history: int = 1, name: str = "spin") -> Field:
        """Return the field of the base's angular velocity (rad/s), or of a torque."""
        return Field(name, kinds.AXIAL_3D, history)

    def attitude(self, kind: Kind = kinds.QUATERNION, history: int = 1, name: str = "attitude") -> Field:
        """Return the field of the base's attitude: a quaternion (w, x, y, z), or another kind of attitude.

        Raises:
            UserError: the base's axes at rest are not the world's.
        """
        if self._is_turned:
            raise UserError("the base is turned at rest, so attitudes do not follow; leave its quat or euler out")
        return Field(name, kind, history)

    @staticmethod
    def command(history: int = 1, name: str = "command") -> Field:
        """Return the field of a commanded (vx, vy, turning rate)."""
        return Field(name, kinds.PLANAR_COMMAND, history)

    def state(self) -> Layout:
        """Return the layout of MuJoCo's qpos and qvel: `simulated` of a task, whose states checks can pair.

        Raises:
            UserError: the body is not that of a model, its free joint is not the first, its base begins off the origin
                so that images of places shift, or a joint's reference is not that of its image.
        """
        if self._stateless:
            raise UserError(self._stateless)
        fields = []
        for name, joints in (("positions", self._positions), ("velocities", self._velocities)):
            if self._is_free:
                base = Parts("base's", _OF_A_BASE[name], joints.moves)
                fields += [base.field(part, [part], 1) for part in base.places]
            if self.joints:
                fields.append(joints.field(name, self.joints, 1))
        return Layout(tuple(fields))

    def check_pose(self, pose: Mapping[str, float], tolerance: float = 1e-3) -> None:
        """Refuse a pose that is not its own image: positions relative to it would not transform as `positions`.

        Args:
            pose: by joint its angle relative to `qpos0`; joints that are left out are at rest. No ball joints.
            tolerance: rad or m.

        Raises:
            UserError: a joint's image has another angle, or a name is none of a joint.
        """
        places = {joint: self._velocities.places[joint].start for joint in self.joints}
        for element, matrix in self._velocities.moves.items():
            angles = np.zeros(len(matrix))
            for joint, angle in pose.items():
                if joint not in places or not isinstance(angle, SupportsFloat) or not np.isfinite(angle):
                    raise UserError(f"the pose has {printable(joint)} at {angle}; give joints of it finite angles")
                angles[places[joint]] = angle
            off = np.abs(matrix @ angles - angles)
            if off.max(initial=0) > tolerance:
                joint = next(printable(name) for name, start in places.items() if start == off.argmax())
                raise UserError(
                    f"the pose is not its own image under {element.name}: {joint} is off by {off.max():.3g}"
                )
