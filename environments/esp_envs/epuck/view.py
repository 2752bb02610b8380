"""The view in space: scenes drawn by MuJoCo's renderer, whatever physics they come from.

Nothing is simulated here. A model is built for the looks of a scene's bodies, which are then put where each scene says.
The camera looks along the y axis and down, so x points right as in the view from above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor

from esp_envs.drawing import BACKGROUND, FRAME, GRID, TRAIL_WIDTH, Point, fade, grid_lines, trails
from esp_envs.epuck.robot import AXLE_M, BODY_HEIGHT_M, BODY_RADIUS_M, WHEEL_RADIUS_M
from esp_envs.errors import UserError
from esp_envs.scene import GRID_SPACING, Body, Scene

WALL_HEIGHT_M = 0.03  # lower than a robot, so that the wall nearest to the camera hides none
WALL_WIDTH_M = 0.02
FIELD_OF_VIEW_DEG, ELEVATION_DEG = 40, 60  # the height of the picture, and how far the camera looks down
_DISTANCE, _NEARER = 2.55, 0.19
"""Of the camera from its target, and of that from the middle, against half a wall: the arena takes 96 % of the width,
and is as high as low in the picture, where what is near looks larger."""
_PILLAR_HEIGHT_M = 0.06
_GRID_WIDTH_M = 0.004
_LAYER_M = 0.001  # thickness of what lies flat on the floor
_TRAIL_M, _GOAL_M = 0.004, 0.005  # height of trails and goals over the floor; lower ones would flicker
_LETTER_M = 0.06  # height of letters over the floor
_TRAIL_STEP = 1.0  # shortest straight piece of a trail against the body's radius; finer bends are about a pixel
_DARK, _NOSE, _OUTSIDE = "#2b2b30", "#fafaf7", "#dededa"
_ASPECT = 3 / 4
_MAX_GEOMS = 20_000
_Label, _Line = mujoco.mjtGeom.mjGEOM_LABEL, mujoco.mjtGeom.mjGEOM_LINE
_Mark = tuple[str, float, tuple[int, ...], Point, Point]  # letter, else width of a line in pixels; colour; two ends
# A top that faces the light shows its colour as it is: what is ambient, diffuse and emitted adds up to 1. A side that
# faces away is darker. Shadows would take ten times as long as all the rest.
_MODEL = """<mujoco>
    <visual>
        <global offwidth="{width}" offheight="{height}" fovy="{fovy}"/>
        <quality offsamples="4" numslices="24" numstacks="2"/>
        <headlight ambient="0.25 0.25 0.25" diffuse="0 0 0" specular="0 0 0"/>
    </visual>
    <statistic extent="{extent}"/>
    <asset><material name="matt" emission="0.4" specular="0" shininess="0"/></asset>
    <default><geom material="matt" contype="0" conaffinity="0" mass="0"/></default>
    <worldbody>
        <light type="directional" dir="0 0 -1" diffuse="0.35 0.35 0.35" specular="0 0 0" castshadow="false"/>
        {things}
    </worldbody>
</mujoco>"""


class SpacePainter:
    """Draws scenes whose bodies say what they are models of, `size` pixels wide and 3/4 as high; see `open_painter`."""

    note: str | None = None

    def __init__(self, size: int) -> None:
        if size < 16:
            raise UserError(f"cannot draw on {size} pixels; use 16 or more")
        self._size = size, round(size * _ASPECT)
        self._looks: object = None
        self._renderer: mujoco.Renderer | None = None

    def draw(self, scene: Scene, trail: Sequence[Scene] = ()) -> NDArray[np.uint8]:
        """Draw one scene, whose window is the floor between the walls; see `esp_envs.scene.Painter`."""
        looks = scene.window, [(body.model, body.radius, body.color) for body in scene.bodies]
        if self._renderer is None or looks != self._looks:
            self._renderer, self._looks = self._build(scene), looks
        for k, body in enumerate(scene.bodies):
            half = (body.heading or 0.0) / 2
            self._data.mocap_pos[k, :2] = body.position
            self._data.mocap_quat[k] = math.cos(half), 0, 0, math.sin(half)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._eye)
        self._mark(self._renderer.scene, scene, trail)
        picture: NDArray[np.uint8] = self._renderer.render()
        return picture

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _build(self, scene: Scene) -> mujoco.Renderer:
        """Make the model, camera and renderer for scenes that look like this one."""
        model = model_of(scene, *self._size)  # first, so that what cannot be drawn changes nothing
        self.close()
        self._model, self._data = model, mujoco.MjData(model)
        x_min, x_max, y_min, y_max = scene.window
        half = max(x_max - x_min, y_max - y_min) / 2 + WALL_WIDTH_M
        self._eye = mujoco.MjvCamera()
        self._eye.azimuth, self._eye.elevation = 90, -ELEVATION_DEG
        self._eye.lookat[:] = (x_min + x_max) / 2, (y_min + y_max) / 2 - _NEARER * half, 0.0
        self._eye.distance = _DISTANCE * half + WALL_HEIGHT_M
        return mujoco.Renderer(model, self._size[1], self._size[0], _MAX_GEOMS)

    def _mark(self, geoms: mujoco.MjvScene, scene: Scene, trail: Sequence[Scene]) -> None:
        """Write letters above robots and lay the ways of bodies on the floor, while there is room for more shapes."""
        scale = self._size[0] / (scene.window[1] - scene.window[0])  # pixels per metre, nearly
        named = [body for body in scene.bodies if body.name and body.heading is not None]
        marks: list[_Mark] = [(body.name, 1.0, (255, 255, 255), body.position, body.position) for body in named]
        for body, path in trails(scene, trail):
            points, width = _thinned(path, body.radius * _TRAIL_STEP), body.radius * TRAIL_WIDTH * scale
            for k, ends in enumerate(pairwise(points), 1):
                marks.append(("", width, fade(body.color, k / (len(points) - 1)), *ends))
        for letter, width, color, start, end in marks[: geoms.maxgeom - geoms.ngeom]:
            geom, rgba = geoms.geoms[geoms.ngeom], np.array([*color, 255], np.float32) / np.float32(255)
            mujoco.mjv_initGeom(geom, _Label, np.ones(3), np.array([*start, _LETTER_M]), np.eye(3).ravel(), rgba)
            geom.label = letter
            if not letter:
                mujoco.mjv_connector(geom, _Line, width, np.array([*start, _TRAIL_M]), np.array([*end, _TRAIL_M]))
            geoms.ngeom += 1


def _thinned(path: Sequence[Point], step: float) -> list[Point]:
    kept = [path[0]]
    for point in path[1:-1]:
        if math.dist(point, kept[-1]) >= step:
            kept.append(point)
    return [*kept, path[-1]]


def model_of(scene: Scene, width: int, height: int) -> mujoco.MjModel:
    """Build floor, walls, light, and one mocap body per body of the scene, in their order."""
    x_min, x_max, y_min, y_max = scene.window
    if x_max <= x_min or y_max <= y_min:
        raise UserError(f"cannot draw the window {scene.window}; use a real window")
    things = _arena(scene)
    for body in scene.bodies:
        if body.model not in _SOLIDS:
            raise UserError(f"no body of the model {body.model!r} is known in space; use {', '.join(_SOLIDS)}")
        things.append(f'<body mocap="true">{"".join(_SOLIDS[body.model](body))}</body>')
    extent = max(x_max - x_min, y_max - y_min)
    named = {"width": width, "height": height, "fovy": FIELD_OF_VIEW_DEG, "extent": extent}
    return mujoco.MjModel.from_xml_string(_MODEL.format(things="".join(things), **named))


def _arena(scene: Scene) -> list[str]:
    x_min, x_max, y_min, y_max = scene.window
    x, y, half_x, half_y = (x_min + x_max) / 2, (y_min + y_max) / 2, (x_max - x_min) / 2, (y_max - y_min) / 2
    far, line, wall, middle = 20 * max(half_x, half_y), _GRID_WIDTH_M / 2, WALL_WIDTH_M / 2, WALL_HEIGHT_M / 2
    down, beside = grid_lines(x_min, x_max, GRID_SPACING), grid_lines(y_min, y_max, GRID_SPACING)
    things = [
        _geom("box", (far, far, _LAYER_M), (x, y, -3 * _LAYER_M), _OUTSIDE),
        _geom("box", (half_x, half_y, _LAYER_M), (x, y, -_LAYER_M), BACKGROUND),
        *(_geom("box", (line, half_y, _LAYER_M), (place, y, -_LAYER_M / 2), GRID) for place in down),
        *(_geom("box", (half_x, line, _LAYER_M), (x, place, -_LAYER_M / 2), GRID) for place in beside),
    ]
    for side in (-1, 1):
        things += [
            _geom("box", (wall, half_y, middle), (x + side * (half_x + wall), y, middle), FRAME),
            _geom("box", (half_x + WALL_WIDTH_M, wall, middle), (x, y + side * (half_y + wall), middle), FRAME),
        ]
    return things


def _robot(body: Body) -> list[str]:
    radius, scale = body.radius, body.radius / BODY_RADIUS_M
    height, wheel, axle = BODY_HEIGHT_M * scale, WHEEL_RADIUS_M * scale, AXLE_M * scale
    plate = height / 8
    belt = (height - 2 * plate) * 0.55
    return [
        _cylinder(radius * 0.62, height / 2 - plate, height / 2, _DARK),
        _cylinder(radius, (height - belt) / 2, (height + belt) / 2, _DARK),
        _cylinder(radius * 0.94, plate / 2, height + plate / 2, body.color),
        _geom("box", (radius * 0.4, radius * 0.11, plate / 2), (radius * 0.55, 0, height + plate), _NOSE),
        *(
            _geom("cylinder", (wheel, wheel * 0.15), (0, y, wheel), _DARK, 'zaxis="0 1 0"')
            for y in (-axle / 2, axle / 2)
        ),
    ]


def _pillar(body: Body) -> list[str]:
    return [_cylinder(body.radius, _PILLAR_HEIGHT_M / 2, _PILLAR_HEIGHT_M / 2, body.color)]


def _goal(body: Body) -> list[str]:
    inner = _cylinder(body.radius * 0.65, _GOAL_M, _LAYER_M, BACKGROUND)
    return [_cylinder(body.radius, _GOAL_M, 0, body.color), inner]


_SOLIDS = {"robot": _robot, "pillar": _pillar, "goal": _goal}


def _cylinder(radius: float, half: float, height: float, color: str) -> str:
    return _geom("cylinder", (radius, half), (0, 0, height), color)


def _geom(shape: str, size: Sequence[float], at: Sequence[float], color: str, turn: str = "") -> str:
    size_, at_ = " ".join(map(str, size)), " ".join(map(str, at))
    red, green, blue = (level / 255 for level in ImageColor.getrgb(color)[:3])
    return f'<geom type="{shape}" size="{size_}" pos="{at_}" rgba="{red} {green} {blue} 1" {turn}/>'
