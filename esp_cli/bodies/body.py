"""A robot's body: the symmetries that its model has, and fields of layouts that follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.bodies import kinds
from esp_cli.bodies.asymmetry import Difference, differences
from esp_cli.bodies.deriving import Frame, Match, derive
from esp_cli.bodies.proof import NEARLY, Proof, prove
from esp_cli.bodies.reading import check_size, printable, read_model
from esp_cli.bodies.tables import Moves, by_element, closed, moves_of
from esp_cli.symmetry.elements import Floats
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Field, Kind

_TURNS = [Fraction(k, n) for n in (8, 6, 5, 4, 3, 2) for k in range(1, n)]
_AXES = [Fraction(k, 24) for k in range(24)] + [Fraction(k, n) for n in (10, 16) for k in range(1, n)]
TRIED = tuple(
    dict.fromkeys(
        [PlaneElement(mirrored=True), PlaneElement(Fraction(1, 2), mirrored=True)]
        + [PlaneElement(turn) for turn in sorted(set(_TURNS))]
        + [PlaneElement(turn, mirrored=True) for turn in sorted(set(_AXES))]
    )
)
"""The elements that a model is searched for: turns by 1/2 to 1/8, and mirrors in lines between which such turns lie."""


@dataclass(frozen=True)
class Found:
    """What is known of one element of a model: its match, the proof, and what differs, by joint and of a free base."""

    match: Match
    proof: Proof
    differences: list[Difference] = field(repr=False)
    base: Difference | None = None


class Body:
    """A robot's joints, actuators and limbs, and where each of its symmetries sends them.

    body = Body.from_mjcf("ant.xml")
    body.group  # "d4": left-right, front-back, quarter turns
    observation = layout(body.gravity(), body.spin(), body.positions(), body.velocities())
    symmetry = Symmetry(observation=observation, action=Continuous(layout(body.controls())), group="flip-x")

    Axes as in MuJoCo, ROS and Isaac Lab: x forward, y left, z up. Then `flip-x` is left-right, `flip-y` front-back.

    Args:
        joints: names of the joints, in any order.
        mirror: by joint the joint that it is sent to, with "-" before it where the sign changes:
            {"hip_1": "-hip_4"}; joints that are left out follow from their partners. Or such tables by element:
            {"left-right": {...}, "front-back": {...}}; their products follow.
        limbs: tables alike of limbs, without signs: {"left-right": {"left_foot": "right_foot"}}.

    Attributes:
        joints: names of the joints that are no free base.
        actuators: names of the actuators, which for a body given by names are the joints.
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
        self.joints, self.actuators = tuple(joints), tuple(joints)
        self.found: dict[str, Found] = {}
        self.refused: dict[str, str] = {}
        ends = by_element(limbs or {})
        self.limb_names = tuple(dict.fromkeys(x for table in ends.values() for pair in table.items() for x in pair))
        generators = {
            element: moves_of(self.joints, table, ends.get(element, {}))
            for element, table in by_element(mirror).items()
        }
        self._moves = closed(generators)
        self._at = {name: slice(i, i + 1) for i, name in enumerate(self.joints)}
        self._speed_at, self._control_at = self._at, self._at
        self._numbers: dict[str, int] = {}
        self._idle: set[PlaneElement] = set()

    @classmethod
    def from_mjcf(cls, model: Path | str | Any, root: Path | str | None = None, tolerated: float = NEARLY) -> Body:
        """Find and prove the symmetries of a model.

        Args:
            model: an MJCF file, or a `mujoco.MjModel`.
            root: the folder that holds all its files; by default that of the file.
            tolerated: the largest share by which accelerations of a joint may be off.

        Raises:
            UserError: the file cannot be read, or nothing of the model moves.
        """
        model = read_model(model, root) if isinstance(model, str | Path) else model
        check_size(model)
        return cls._from_model(model, tolerated)

    @classmethod
    def from_file(cls, path: Path | str, root: Path | str | None = None) -> Body:
        """Find and prove the symmetries of an MJCF or URDF file, whichever it is; see `from_mjcf`."""
        return cls._from_model(read_model(path, root), NEARLY)

    @classmethod
    def from_urdf(
        cls, path: Path | str, root: Path | str | None = None, tolerated: float = NEARLY, floating: bool = True
    ) -> Body:
        """Find and prove the symmetries of a URDF file; its first link moves freely unless `floating` is false."""
        return cls._from_model(read_model(path, root, floating), tolerated)

    @classmethod
    def _from_model(cls, model: Any, tolerated: float) -> Body:
        frame = Frame(model)
        inner = [j for j in range(model.njnt) if j != frame.base]
        numbers = {frame.name("joint", j): j for j in inner}
        self = cls(tuple(numbers), {})
        self._numbers = numbers
        self._at = {name: frame.qpos_of(j) for name, j in numbers.items()}
        self._speed_at = {name: frame.dofs_of(j) for name, j in numbers.items()}
        self.actuators = tuple(frame.name("actuator", a) for a in range(model.nu))
        self._control_at = {name: slice(a, a + 1) for a, name in enumerate(self.actuators)}
        self.limb_names = tuple(frame.name("body", b) for b in range(model.nbody))
        for element in TRIED:
            if not any(element @ idle in self._moves for idle in self._idle):
                self._try(frame, element, tolerated)
        self._keep_a_group()
        return self

    def _try(self, frame: Frame, element: PlaneElement, tolerated: float) -> None:
        """Derive and prove one element, and keep it or the reason against it."""
        try:
            match = derive(frame, element)
        except UserError:
            return
        if match.is_trivial:  # a mirror in the plane of a planar robot
            self._idle.add(element)
            return
        proof = prove(frame, match)
        if match.unmatched:
            self.refused[element.name] = f"no image was found of the actuators {', '.join(match.unmatched)}"
        elif proof.gap > tolerated:
            worst = printable(frame.name("joint", int(proof.joints.argmax())))
            self.refused[element.name] = f"accelerations of {worst} differ by {proof.gap:.2g} of their size"
        else:
            differ = differences(frame, match)
            base = None if frame.base is None else differ[frame.base]
            self.found[element.name] = Found(match, proof, differ, base)
            limbs = {self.limb_names[b]: self.limb_names[c] for b, c in enumerate(match.body) if c >= 0}
            self._moves[element] = Moves(match.qpos, match.qvel, match.ctrl, limbs)

    def _keep_a_group(self) -> None:
        """Drop elements that do not multiply as turns and mirrors do."""
        for g in list(self._moves):
            for h in list(self._moves):
                if g not in self._moves or h not in self._moves or (g @ h).is_identity or g @ h in self._idle:
                    continue
                product = self._moves.get(g @ h)
                made = self._moves[g].velocities @ self._moves[h].velocities
                if product is None or not np.allclose(product.velocities, made, atol=1e-6):
                    dropped = max(g, h, key=TRIED.index)
                    del self._moves[dropped]
                    self.found.pop(dropped.name, None)
                    self.refused[dropped.name] = "its products with the other symmetries do not hold"

    @property
    def elements(self) -> tuple[PlaneElement, ...]:
        """The symmetries that the body has, without the identity."""
        return tuple(self._moves)

    @property
    def group(self) -> str:
        """The symmetries as `Symmetry` and `--transforms` read them: "d2", "flip-x"; "c1" where there is none."""
        own = {PlaneElement(), *self._moves}
        for name in ("flip-x", "flip-y", *(f"{kind}{n}" for n in (2, 3, 4, 5, 6, 8) for kind in "cd")):
            if {PlaneElement(), *map(PlaneElement.of, parse_elements(name, 1))} == own:  # type: ignore[arg-type] # finite
                return name
        return ",".join(element.name for element in self._moves) or "c1"

    def rows(self, element: str) -> list[tuple[str, str, int, float, float, Difference]]:
        """Return of each joint of a model, for one of `found`: name, image, sign, gap, planted gap, difference.

        The sign is 0 for ball joints, which turn about three axes.
        """
        one = self.found[element]
        rows = []
        for name in self.joints:
            joint = self._numbers[name]
            image = next(n for n, j in self._numbers.items() if j == one.match.joint[joint])
            block = one.match.qvel[self._speed_at[image], self._speed_at[name]]
            sign = int(np.sign(block[0, 0])) if block.size == 1 else 0
            gaps = float(one.proof.joints[joint]), float(one.proof.planted[joint])
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
        return self._field(name, "positions", "joints", self._at, joints or self.joints, history)

    def velocities(self, joints: Sequence[str] | None = None, history: int = 1, name: str = "velocities") -> Field:
        """Return the field of joint velocities, accelerations or torques, see `positions`."""
        return self._field(name, "velocities", "joints", self._speed_at, joints or self.joints, history)

    def controls(self, actuators: Sequence[str] | None = None, history: int = 1, name: str = "controls") -> Field:
        """Return the field of controls by actuator: targets, or the last action; see `positions`."""
        return self._field(name, "actuators", "actuators", self._control_at, actuators or self.actuators, history)

    def contacts(self, limbs: Sequence[str], width: int = 1, history: int = 1, name: str = "contacts") -> Field:
        """Return the field of numbers by limb: contacts, air times, phases (`width` 2: cosine and sine).

        Raises:
            UserError: a limb is unknown, or its image is not among them.
        """
        moves, limbs = {}, list(limbs)
        for element, move in self._moves.items():
            table = np.zeros((len(limbs), len(limbs)))
            for i, limb in enumerate(limbs):
                image = move.limbs.get(limb)
                if image is None or image not in limbs:
                    known = f"its image under {element.name}, {image}, is not among them" if image else "it is unknown"
                    raise UserError(f"field '{name}': limb {printable(limb)}: {known}; name {self._some_limbs()}")
                table[limbs.index(image), i] = 1
            moves[element] = np.kron(table, np.eye(width)).astype(np.float64)
        return kinds.parts_field(name, "limbs", moves, history)

    def scan(self, points: Sequence[Sequence[float]] | Floats, history: int = 1, name: str = "scan") -> Field:
        """Return the field of a height scan or of rays, see `points_field` and `grid`."""
        return kinds.points_field(name, points, self.elements, history)

    @staticmethod
    def gravity(history: int = 1, name: str = "gravity") -> Field:
        """Return the field of gravity's direction as the body sees it."""
        return Field(name, kinds.VECTOR_3D, history)

    @staticmethod
    def velocity(history: int = 1, name: str = "velocity") -> Field:
        """Return the field of the base's velocity (m/s) or another vector, as the body or the world sees it."""
        return Field(name, kinds.VECTOR_3D, history)

    @staticmethod
    def spin(history: int = 1, name: str = "spin") -> Field:
        """Return the field of the base's angular velocity (rad/s), or of a torque."""
        return Field(name, kinds.AXIAL_3D, history)

    @staticmethod
    def attitude(kind: Kind = kinds.QUATERNION, history: int = 1, name: str = "attitude") -> Field:
        """Return the field of the base's attitude: a quaternion (w, x, y, z), or another kind of attitude."""
        return Field(name, kind, history)

    @staticmethod
    def command(history: int = 1, name: str = "command") -> Field:
        """Return the field of a commanded (vx, vy, turning rate)."""
        return Field(name, kinds.PLANAR_COMMAND, history)

    def check_pose(self, pose: Mapping[str, float], tolerance: float = 1e-3) -> None:
        """Refuse a pose that is not its own image: positions relative to it would not transform as `positions`.

        Args:
            pose: by joint its angle relative to the model's rest; joints that are left out are at rest.
            tolerance: rad or m.

        Raises:
            UserError: a joint's image has another angle.
        """
        angles = np.array([pose.get(joint, 0.0) for joint in self.joints])
        for element in self.elements:
            matrix = self.positions().kind.matrix(element.matrix)  # type: ignore[attr-defined]
            if matrix.shape != (len(angles), len(angles)):
                raise UserError("a pose of ball joints is not a number by joint; leave it out")
            off = np.abs(matrix @ angles - angles)
            if off.max(initial=0) > tolerance:
                joint = printable(self.joints[int(off.argmax())])
                raise UserError(
                    f"the pose is not its own image under {element.name}: {joint} is off by {off.max():.3g}"
                )

    def _some_limbs(self) -> str:
        return ", ".join(map(printable, self.limb_names[:8])) + (", ..." if len(self.limb_names) > 8 else "")

    def _field(
        self, name: str, part: str, what: str, places: Mapping[str, slice], names: Sequence[str], history: int
    ) -> Field:
        """Return a field of some joints or actuators."""
        if unknown := next((n for n in names if n not in places), None):
            known = ", ".join(printable(n) for n in list(places)[:8]) + (", ..." if len(places) > 8 else "")
            raise UserError(
                f"field '{name}': the body has no {printable(str(unknown))} among its {what}; it has {known}"
            )
        if len(set(names)) < len(names):
            raise UserError(f"field '{name}' names one of the {what} twice")
        index = (
            np.concatenate([np.arange(places[n].start, places[n].stop) for n in names]) if names else np.zeros(0, int)
        )
        moves = {}
        for element, move in self._moves.items():
            block = getattr(move, part)[np.ix_(index, index)]
            if not np.allclose(block @ block.T, np.eye(len(index)), atol=1e-6):
                lost = printable(names[self._row(names, places, int(np.abs(block).sum(0).argmin()))])
                raise UserError(f"field '{name}': the image of {lost} under {element.name} is not among its {what}")
            moves[element] = block
        if not moves:
            moves = {PlaneElement(): np.eye(len(index))}
        return kinds.parts_field(name, what, moves, history)

    @staticmethod
    def _row(names: Sequence[str], places: Mapping[str, slice], number: int) -> int:
        ends = np.cumsum([places[n].stop - places[n].start for n in names])
        return int(np.searchsorted(ends, number, side="right"))
