"""Mirrors of robots with one mistake each: the audit and the proof find every one, and refuse no right mirror.

A case takes a robot of nine. It draws the order of its joints, of the fields and of a scan's points, and hands the
right map of an element over, then maps with one mistake of each kind. A mistake that happens to be a right map does
not count.
"""

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch

from esp_cli import Body, layout
from esp_cli.bodies.auditing import audit
from esp_cli.bodies.deriving import Match
from esp_cli.bodies.frame import Frame
from esp_cli.bodies.kinds import grid
from esp_cli.bodies.numbers import ACTION, Numbers, map_of
from esp_cli.bodies.proof import prove
from esp_cli.bodies.walking import quadruped
from tests.bodies.models import QUADRUPED, biped, legged
from tests.bodies.test_fields import anymal
from tests.torture.record import Part

HISTORY = 3
_FILES = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
_HEXAPOD = legged([(0.2 * np.cos(a), 0.2 * np.sin(a), np.degrees(a)) for a in np.arange(6) * np.pi / 3])
MODELS: dict[str, Callable[[], mujoco.MjModel]] = {
    **{
        name: lambda name=name: mujoco.MjModel.from_xml_path(str(_FILES / f"{name}.xml"))
        for name in ("ant", "humanoid", "swimmer", "walker2d")
    },
    **{
        name: lambda text=text: mujoco.MjModel.from_xml_string(text)
        for name, text in {
            "biped": biped(), "four legs": QUADRUPED, "six legs": _HEXAPOD, "quadruped": quadruped()
        }.items()
    },
}  # fmt: skip
ROBOTS = (*MODELS, "anymal")


class Mirrors(Part):
    """Robots with a right mirror and wrong ones.

    Attributes:
        counts: wrong mirrors by robot and kind of mistake.
    """

    def __init__(self, scratch: Path, seed: int) -> None:
        self.seed, self._kept = seed, dict[str, tuple[Frame | None, Body]]()
        self.counts: dict[tuple[str, str], int] = {}

    def run(self, number: int) -> str | None:
        rng, name = random.Random(f"{self.seed} {number}"), ROBOTS[number % len(ROBOTS)]
        frame, body = self._robot(name)
        element, numbers = rng.choice(body.elements), _numbers(body, rng)
        right = [(map_of(numbers["policy"], e), map_of(numbers[ACTION], e)) for e in body.elements]
        chosen = right[body.elements.index(element)]
        if wrong := _wrong(*chosen, body, numbers):
            return f"{name} {element.name}: the right mirror is refused: {wrong[0]}"
        for kind, *maps in mistakes(*chosen, numbers, rng):
            if any(np.array_equal(maps[0], seen) and np.array_equal(maps[1], acted) for seen, acted in right):
                continue
            self._add(name, kind)
            if not _wrong(*maps, body, numbers):
                return f"{name} {element.name}: a wrong {kind} is taken"
        if frame is not None:
            for kind, match in misplaced(body.found[element.name].match, frame, rng):
                self._add(name, kind)
                if prove(frame, match).verdict != "broken":
                    return f"{name} {element.name}: the simulator proves a wrong {kind}"
        return None

    def _add(self, robot: str, kind: str) -> None:
        self.done += 1
        self.counts[robot, kind] = self.counts.get((robot, kind), 0) + 1

    def _robot(self, name: str) -> tuple[Frame | None, Body]:
        if name not in self._kept:
            model = MODELS[name]() if name in MODELS else None
            self._kept[name] = (None, anymal()) if model is None else (Frame(model), Body.from_mjcf(model))
        return self._kept[name]


def _numbers(body: Body, rng: random.Random) -> Numbers:
    order = rng.sample(body.joints, len(body.joints))
    points = grid((1, 1) if body.group in ("d4", "c4") else (2, 1), 0.5).tolist()
    fields = [body.velocity(), body.spin(), body.gravity(), body.attitude(), body.positions(order, history=HISTORY)]
    if body.group != "d6":  # a grid does not turn by sixths
        fields.append(body.scan(rng.sample(points, len(points))))
    return {"policy": layout(*rng.sample(fields, len(fields))), ACTION: layout(body.positions(order))}


def _wrong(seen: np.ndarray, acted: np.ndarray, body: Body, numbers: Numbers) -> list[tuple[str, str, str]]:
    L, K = torch.tensor(seen).float(), torch.tensor(acted).float()

    def function(obs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.cat([obs, obs @ L.T]), torch.cat([actions, actions @ K.T])

    return [row for copy in audit(function, body, numbers) for row in copy.wrong]


def mistakes(
    seen: np.ndarray, acted: np.ndarray, numbers: Numbers, rng: random.Random
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    places, count = numbers["policy"].slices(), len(acted)
    joints, (k, other) = places["positions"], rng.sample(range(count), 2)

    def changed(part: slice, block: np.ndarray) -> np.ndarray:
        out = seen.copy()
        out[part, part] = block
        return out

    def swapped(rows: np.ndarray) -> np.ndarray:
        out = rows.copy()
        out[[k, other]] = out[[other, k]]
        return out

    sign = np.where(np.arange(count) == k, -1, 1)[:, None]
    own = seen[joints, joints]
    yield "sign of an action", seen, acted * sign
    yield "sign of a position", changed(joints, own * np.tile(sign, (HISTORY, 1))), acted
    yield "pair of actions", seen, swapped(acted)
    yield "pair of positions", changed(joints, swapped(own)), acted
    yield "order of actions", seen, np.roll(acted, 1, 0)
    yield "order of positions", changed(joints, np.roll(own, 1, 0)), acted
    yield "step of a history", changed(joints, np.roll(own, count, 0)), acted
    for name, kind in (("spin", "axial as polar"), ("velocity", "polar as axial"), ("gravity", "polar as axial")):
        from_other = places["velocity" if name == "spin" else "spin"]
        yield kind, changed(places[name], seen[from_other, from_other]), acted
    attitude = places["attitude"]
    yield "order of a quaternion", changed(attitude, np.roll(seen[attitude, attitude], 1, (0, 1))), acted
    if "scan" in places:
        scan = places["scan"]
        yield "rows of a scan", changed(scan, np.roll(seen[scan, scan], rng.randrange(1, 4), 0)), acted


def misplaced(match: Match, frame: Frame, rng: random.Random) -> Iterator[tuple[str, Match]]:
    """Yield the kind of a mistake and where joints and actuators go with it, for the simulator."""
    hinges = [k for k in range(frame.model.njnt) if frame.model.jnt_type[k] == mujoco.mjtJoint.mjJNT_HINGE]
    moved = frame.model.jnt_dofadr[rng.choice(hinges)]
    qvel, ctrl = match.qvel.copy(), match.ctrl.copy()
    qvel[moved] *= -1
    ctrl[rng.randrange(len(ctrl))] *= -1
    yield "sign of a joint's velocity", replace(match, qvel=qvel)
    yield "sign of an actuator", replace(match, ctrl=ctrl)
    if len(ctrl) > 1:
        yield "order of actuators", replace(match, ctrl=np.roll(match.ctrl, 1, 0))
