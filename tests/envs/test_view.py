"""The view in space: bodies are where the camera's geometry says, and what draws them is found or named as missing."""

import importlib.util
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

if importlib.util.find_spec("mujoco") is None:
    pytest.skip("needs mujoco", allow_module_level=True)

from esp_envs import Body, Scene
from esp_envs.drawing import BACKGROUND
from esp_envs.epuck import gl
from esp_envs.epuck.robot import BODY_HEIGHT_M, BODY_RADIUS_M
from esp_envs.epuck.view import ELEVATION_DEG, FIELD_OF_VIEW_DEG, WALL_HEIGHT_M, SpacePainter

WINDOW = (-1.0, 1.0, -1.0, 1.0)
RED, BLUE, GREEN = "#d01010", "#1010d0", "#10a010"
ROBOT = Body((0.4, 0.3), BODY_RADIUS_M, RED, heading=0.0, trail=True, model="robot")
TOP = BODY_HEIGHT_M * 1.125
"""Height of the coloured plate on a robot."""
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def painter() -> Iterator[SpacePainter]:
    try:
        opened = gl.open_painter(480)
        painter = opened.__enter__()
    except gl.NoGraphicsError as error:
        pytest.skip(str(error))
    yield painter
    opened.__exit__(None, None, None)


def scene(*bodies: Body, window: tuple[float, float, float, float] = WINDOW) -> Scene:
    return Scene(bodies, window)


def project(painter: SpacePainter, points: object) -> np.ndarray:
    """Return the pixels (column, row) of points [..., 3] of the world, by hand: a pinhole that looks down."""
    eye, angle = painter._eye, math.radians(ELEVATION_DEG)
    x, y, z = np.moveaxis(np.asarray(points, float) - eye.lookat, -1, 0)
    up, ahead = y * math.sin(angle) + z * math.cos(angle), y * math.cos(angle) - z * math.sin(angle)
    scale = 180 / math.tan(math.radians(FIELD_OF_VIEW_DEG / 2)) / (ahead + eye.distance)
    return np.stack([240 + x * scale, 180 - up * scale], -1)


def at(painter: SpacePainter, picture: np.ndarray, x: float, y: float, z: float = 0.0) -> np.ndarray:
    """Return the colour of the pixel in which a point of the world lies."""
    column, row = np.floor(project(painter, [x, y, z])).astype(int)
    return picture[row, column].astype(int)


def is_like(color: np.ndarray, name: str, tolerance: int = 30) -> bool:
    wanted = [int(name[k : k + 2], 16) for k in (1, 3, 5)]
    return bool(np.abs(color - wanted).max() <= tolerance)


def centre_of(picture: np.ndarray, name: str) -> np.ndarray:
    """Return the mean (column, row) of the pixels of a colour."""
    wanted = [int(name[k : k + 2], 16) for k in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(picture.astype(int) - wanted).max(-1) <= 30)
    assert len(rows) > 20
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.parametrize("half", [0.4, 1.0, 6.0])
def test_the_whole_arena_is_in_the_picture_and_fills_it(painter: SpacePainter, half: float) -> None:
    painter.draw(scene(ROBOT, window=(-half, half, -half, half)))
    corners = [(x, y, z) for x in (-half, half) for y in (-half, half) for z in (0.0, WALL_HEIGHT_M)]
    pixels = project(painter, corners)
    assert pixels.min() > 0
    assert (pixels < [480, 360]).all()
    assert np.ptp(pixels[:, 0]) / 480 > 0.85
    assert pixels[:, 0].min() + pixels[:, 0].max() == pytest.approx(480, abs=1)
    assert pixels[:, 1].min() + pixels[:, 1].max() == pytest.approx(360, abs=20), "as high as low, but for the walls"


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.4, 0.3), (-0.8, 0.9), (0.9, -0.85)])
def test_a_robot_is_drawn_where_it_is_and_moves_when_it_moves(painter, place):
    picture = painter.draw(scene(replace(ROBOT, position=place)))
    assert picture.shape == (360, 480, 3)
    assert picture.dtype == np.uint8
    assert centre_of(picture, RED) == pytest.approx(project(painter, [*place, TOP]), abs=1.5)
    moved = painter.draw(scene(replace(ROBOT, position=(-0.5, -0.5))))
    assert centre_of(moved, RED) == pytest.approx(project(painter, [-0.5, -0.5, TOP]), abs=1.5)
    assert is_like(at(painter, moved, *place, TOP), BACKGROUND), "nothing is left where it was"


def test_the_nose_points_along_the_heading(painter: SpacePainter) -> None:
    for heading in (0.0, math.pi / 2, 2.5):
        picture = painter.draw(scene(Body((0.0, 0.0), 0.3, RED, heading=heading, model="robot")))
        ahead = 0.18 * np.array([math.cos(heading), math.sin(heading)])
        top = TOP * 0.3 / BODY_RADIUS_M
        assert at(painter, picture, *ahead, top).min() > 200
        assert is_like(at(painter, picture, *-ahead, top), RED)


def test_goals_are_rings_on_the_floor_and_pillars_stand(painter: SpacePainter) -> None:
    goal, pillar = Body((-0.5, 0.2), 0.2, GREEN, "ring", model="goal"), Body((0.5, 0.2), 0.2, BLUE, model="pillar")
    picture = painter.draw(scene(goal, pillar))
    for angle in (0.0, 2.0, 4.0):
        rim = (-0.5 + 0.165 * math.cos(angle), 0.2 + 0.165 * math.sin(angle))
        assert is_like(at(painter, picture, *rim), GREEN)
    assert is_like(at(painter, picture, -0.5, 0.2), BACKGROUND)
    assert is_like(at(painter, picture, 0.5, 0.2, 0.06), BLUE)
    side = at(painter, picture, 0.5, 0.0, 0.03)
    assert side[2] > 2 * side[0], "the side is blue as well"
    assert side[2] < 0xD0 - 30, "but away from the light"


def test_walls_surround_the_floor(painter: SpacePainter) -> None:
    picture = painter.draw(scene(ROBOT))
    for x, y in ((1.01, 0.1), (-1.01, 0.1), (0.1, 1.01), (0.1, -1.01)):
        assert is_like(at(painter, picture, x, y, WALL_HEIGHT_M), "#c8c8c0")
    assert is_like(at(painter, picture, 0.9, -0.4), BACKGROUND)


def test_trails_lie_on_the_floor_and_fade_towards_their_beginning(painter: SpacePainter) -> None:
    big = replace(ROBOT, radius=0.1)
    scenes = [scene(replace(big, position=(-0.8 + 0.16 * k, 0.1 * (k > 5)))) for k in range(11)]
    picture = painter.draw(scenes[-1], scenes[:-1])
    old, new = at(painter, picture, -0.56, 0.0), at(painter, picture, 0.4, 0.1)
    assert new[1] < old[1] < 240, "red grows at the cost of green"
    assert new[0] > new[1] + 80
    plain = painter.draw(scenes[-1])
    assert is_like(at(painter, plain, 0.4, 0.1), BACKGROUND), "without a past there is none"
    hidden = [Scene((replace(s.bodies[0], trail=False),), WINDOW) for s in scenes]
    assert np.array_equal(painter.draw(hidden[-1], hidden[:-1]), plain), "a body that leaves no trail has none"
    still = [scenes[-1]] * 5
    assert np.array_equal(painter.draw(still[-1], still), plain), "nor has one that stands still"


def test_other_bodies_and_other_arenas_are_drawn_after_the_first(painter: SpacePainter) -> None:
    painter.draw(scene(ROBOT))
    wide = scene(
        replace(ROBOT, color=BLUE), replace(ROBOT, color=GREEN, position=(3.0, 1.0)), window=(0.0, 4.0, 0.0, 2.0)
    )
    picture = painter.draw(wide)
    assert is_like(at(painter, picture, 0.4 - 0.015, 0.3, TOP), BLUE)
    assert is_like(at(painter, picture, 3.0 - 0.015, 1.0, TOP), GREEN)


def test_two_painters_do_not_draw_into_each_other(painter: SpacePainter) -> None:
    before = painter.draw(scene(ROBOT))
    with gl.open_painter(64) as other:
        small = other.draw(scene(replace(ROBOT, color=BLUE)))
        assert small.shape == (48, 64, 3)
        assert np.array_equal(painter.draw(scene(ROBOT)), before)
        assert np.array_equal(other.draw(scene(replace(ROBOT, color=BLUE))), small)
    assert np.array_equal(painter.draw(scene(ROBOT)), before)


def test_what_cannot_be_drawn_is_told(painter: SpacePainter) -> None:
    with pytest.raises(ValueError, match="model 'tree'"):
        painter.draw(scene(replace(ROBOT, model="tree")))
    with pytest.raises(ValueError, match="model None"):
        painter.draw(scene(replace(ROBOT, model=None)))
    with pytest.raises(ValueError, match="use a real window"):
        painter.draw(scene(ROBOT, window=(0.0, 0.0, 0.0, 1.0)))
    with pytest.raises(ValueError, match="use 16 or more"), gl.open_painter(8):
        pass
    assert painter.draw(scene(ROBOT)).any(), "it draws on"


_MISSING = """
import ctypes, os, sys
load = ctypes.CDLL.__init__
def init(self, name=None, *rest, **named):
    if any(word in str(name) for word in sys.argv[1].split()):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *rest, **named)
ctypes.CDLL.__init__ = init
"""
_DRAW = """
from esp_envs import Body, Scene
from esp_envs.epuck import gl
try:
    with gl.open_painter(64) as painter:
        picture = painter.draw(Scene((Body((0, 0), 0.5, "#ff0000", model="robot"),), (-1, 1, -1, 1)))
        print("drawn", picture[20, 32, 0] > 150 > picture[20, 32, 1])
except gl.NoGraphicsError as error:
    print("not drawn", error)
"""


def run_without(missing: str, script: str, **variables: str) -> str:
    """Run a script in a process of its own for which some libraries are missing; return what it printed."""
    environment = {name: value for name, value in os.environ.items() if name not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    places = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "environments")])}
    done = subprocess.run(
        [sys.executable, "-c", _MISSING + script, missing],
        env=environment | places | variables,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    return done.stdout + done.stderr


@pytest.mark.slow
def test_physics_first_does_not_stop_drawing_later(painter: SpacePainter) -> None:
    physics = "import mujoco; m = mujoco.MjSpec().compile(); mujoco.mj_step(m, mujoco.MjData(m))"
    assert run_without("", physics + _DRAW).startswith("drawn True")


@pytest.mark.slow
def test_without_osmesa_egl_draws() -> None:
    told = run_without("OSMesa", _DRAW)
    if told.startswith("not drawn"):
        pytest.skip("needs a working EGL")
    assert told == "drawn True\n"


@pytest.mark.slow
def test_without_any_library_one_sentence_says_what_to_install() -> None:
    told = run_without("OSMesa EGL", _DRAW)
    assert told.startswith(
        "not drawn nothing here can draw a view in space (osmesa: not installed; egl: not installed); to draw"
    )
    assert "apt-get install libosmesa6" in told
    assert "dnf install mesa-libOSMesa" in told
    assert told.count("\n") == 1


@pytest.mark.slow
def test_a_variable_that_names_a_missing_library_stops_nothing() -> None:
    trap = run_without("OSMesa EGL", "import mujoco", MUJOCO_GL="osmesa")
    assert "AttributeError" in trap, "else there is nothing to guard against"
    assert run_without("OSMesa EGL", _DRAW, MUJOCO_GL="osmesa").startswith("not drawn nothing here can draw")


def test_a_variable_is_forgotten_only_where_its_library_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gl, "is_installed", lambda backend: backend == "egl")
    for value, kept in (("egl", True), ("OSMesa", False), ("glfw", True), ("", True)):
        monkeypatch.setenv("MUJOCO_GL", value)
        gl.forget_missing_backend()
        assert ("MUJOCO_GL" in os.environ) is kept, value
    monkeypatch.delenv("MUJOCO_GL")
    gl.forget_missing_backend()


@pytest.mark.parametrize(("value", "refused"), [("nonsense", True), ("gl", True), ("egl,osmesa", True), ("'egl'", True),
                                                ("disable", False), (" GLFW ", False), ("0", False)])  # fmt: skip
def test_a_variable_that_names_nothing_is_one_sentence(value, refused, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", value)
    with pytest.raises(ValueError, match=r"MUJOCO_GL is .*; set it to .* or unset it") if refused else nullcontext():
        gl.forget_missing_backend()


def test_the_library_that_the_user_names_is_tried_first(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def refuse(backend: str) -> None:
        tried.append(backend)
        raise RuntimeError(f"{backend} is\nbroken")

    monkeypatch.setattr(gl, "is_installed", lambda backend: True)
    monkeypatch.setattr(gl, "_draw_with", refuse)
    for value, order in (("", ["osmesa", "egl"]), ("egl", ["egl", "osmesa"]), ("glfw", ["osmesa", "egl"])):
        tried.clear()
        monkeypatch.setenv("MUJOCO_GL", value)
        with pytest.raises(gl.NoGraphicsError) as refused, gl.open_painter(32):
            pass
        assert tried == order
    assert str(refused.value).endswith("(osmesa: osmesa is broken; egl: egl is broken)"), "installing would not help"


def test_robots_have_their_letters_above_them(painter: SpacePainter) -> None:
    plain, lettered = (painter.draw(scene(replace(ROBOT, name=name))).astype(int) for name in ("", "A"))
    rows, columns = np.nonzero((plain != lettered).any(-1))
    column, row = project(painter, [*ROBOT.position, TOP])
    assert len(rows) > 20
    assert np.hypot(columns.mean() - column, rows.mean() - row) < 30
    assert rows.mean() < row
