"""The view in space: scenes drawn by MuJoCo's renderer, whatever physics they come from.

Nothing is simulated here. A model is built for the looks of a scene's bodies, which are then put where each scene says.
The camera looks along the y axis and down, so x points right as in the view from above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import ImageColor

from esp_envs.drawing import BACKGROUND, FRAME, GRID, TRAIL_WIDTH, fade, grid_lines, trails
from esp_envs.epuck.robot import AXLE_M, BODY_HEIGHT_M, BODY_RADIUS_M, WHEEL_RADIUS_M
from esp_envs.errors import UserError
from esp_envs.scene import GRID_SPACING, Body, Scene

WALL_HEIGHT_M = 0.03  # lower than a robot, so that the wall nearest to the camera hides none
WALL_WIDTH_M = 0.02
_PILLAR_HEIGHT_M = 0.06
_GRID_WIDTH_M = 0.004
_LAYER_M = 0.001  # thickness of what lies flat on the floor
_TRAIL_LAYER_M = 0.75 * _LAYER_M  # above the lines of the grid, below the goals
_LETTER_M = 0.06  # height of letters over the floor
_TRAIL_STEP = 1.0  # shortest straight piece of a trail against the body's radius; finer bends are about a pixel
_DARK, _NOSE, _OUTSIDE = "#2b2b30", "#fafaf7", "#dededa"
_AMBIENT, _DIFFUSE, _GLOW = 0.25, 0.35, 0.4
"""A top that faces the light shows its colour as it is: the three add up to 1; a side that faces away is darker."""
_ASPECT = 3 / 4
_FIELD_OF_VIEW = math.radians(40)
_ELEVATION = math.radians(60)  # how far the camera looks down
_FILLED = 0.96  # share of the picture that the arena may take
_MAX_GEOMS = 20_000
_Box, _Cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
_LYING = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)  # turns a cylinder's axis from z to y

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Where the picture, `width` times `height` pixels, is taken from."""

    target: tuple[float, float, float]  # the point (x, y, 0) in the middle of the picture, m
    distance: float  # of the camera from it, m
    width: int
    height: int

    def project(self, points: ArrayLike) -> _Array:
        """Return the pixels (column, row) of points [..., 3] in the world, m."""
        across, up, ahead = self._seen(points)
        scale = self._focal / (ahead + self.distance)
        return np.stack([self.width / 2 + across * scale, self.height / 2 - up * scale], -1)

    @classmethod
    def facing(cls, window: tuple[float, float, float, float], width: int, height: int) -> Camera:
        """Return the nearest camera that has all of a window and its walls in the picture, as high as low."""
        x_min, x_max, y_min, y_max = window
        rim = WALL_WIDTH_M
        sides = ((x_min - rim, x_max + rim), (y_min - rim, y_max + rim), (0.0, WALL_HEIGHT_M))
        corners = np.array(list(product(*sides)))
        camera = cls(((x_min + x_max) / 2, (y_min + y_max) / 2, 0.0), 1.0, width, height)
        for _ in range(20):  # what is near looks larger, so the middle of the picture is not that of the window
            across, up, ahead = camera._seen(corners)
            needed = np.maximum(abs(across) * 2 / width, abs(up) * 2 / height) * camera._focal / _FILLED - ahead
            camera = replace(camera, distance=float(needed.max()))
            rows = camera.project(corners)[:, 1]
            low = (rows.min() + rows.max()) / 2 - height / 2
            x, y, z = camera.target
            moved = y - low * camera.distance / camera._focal / math.sin(_ELEVATION)
            camera = replace(camera, target=(x, float(moved), z))
        return camera

    @property
    def _focal(self) -> float:
        """Pixels that a length spans from as far away as it is long."""
        return self.height / 2 / math.tan(_FIELD_OF_VIEW / 2)

    def _seen(self, points: ArrayLike) -> tuple[_Array, ...]:
        """Return how far points lie to the right, upwards and ahead of the target as the camera sees it, m."""
        x, y, z = np.moveaxis(np.asarray(points, dtype=np.float64) - self.target, -1, 0)
        down, along = math.sin(_ELEVATION), math.cos(_ELEVATION)
        return x, y * down + z * along, y * along - z * down


class SpacePainter:
    """Draws scenes whose bodies say what they are models of, `size` pixels wide and 3/4 as high; see `open_painter`."""

    camera: Camera
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
        self._add_trails(self._renderer.scene, scene, trail)
        _add_letters(self._renderer.scene, scene)
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
        self.camera = Camera.facing(scene.window, *self._size)
        self._eye = mujoco.MjvCamera()
        self._eye.azimuth, self._eye.elevation = 90, -math.degrees(_ELEVATION)
        self._eye.lookat[:], self._eye.distance = self.camera.target, self.camera.distance
        return mujoco.Renderer(model, self._size[1], self._size[0], _MAX_GEOMS)

    def _add_trails(self, geoms: mujoco.MjvScene, scene: Scene, trail: Sequence[Scene]) -> None:
        """Lay the ways that bodies have come on the floor, fading towards their beginnings."""
        for body, path in trails(scene, trail):
            points = np.array(_thinned(path, body.radius * _TRAIL_STEP))
            half = body.radius * TRAIL_WIDTH / 2
            for k, (start, end) in enumerate(pairwise(points)):
                length = math.dist(start, end)
                if length == 0.0:
                    continue
                levels = np.array([*fade(body.color, (k + 1) / (len(points) - 1)), 255], dtype=np.float32)
                color = levels / np.float32(255)
                along = (end - start) / length
                left = np.array([-along[1], along[0]])
                # Two triangles take a tenth of the time of a box. They are longer than the way by a width, so that
                # no gap shows where it bends.
                reach = np.array([length + 2 * half, 2 * half, 0.0])
                _add_triangle(geoms, start - half * (along + left), along, left, reach, color)
                _add_triangle(geoms, end + half * (along + left), -along, -left, reach, color)


def _add_letters(geoms: mujoco.MjvScene, scene: Scene) -> None:
    """Write the letter of each robot above it, while there is room for one more shape."""
    for body in scene.bodies:
        if body.name and body.heading is not None and geoms.ngeom < geoms.maxgeom:
            geom, place = geoms.geoms[geoms.ngeom], np.array([*body.position, _LETTER_M])
            rest = np.ones(3), place, np.eye(3).ravel(), np.ones(4, dtype=np.float32)
            mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_LABEL, *rest)
            geom.label = body.name
            geoms.ngeom += 1


def _add_triangle(
    geoms: mujoco.MjvScene, corner: _Array, along: _Array, left: _Array, reach: _Array, color: NDArray[np.float32]
) -> None:
    """Lay a right-angled triangle on the floor, if there is room for one more shape."""
    if geoms.ngeom == geoms.maxgeom:
        return
    geom = geoms.geoms[geoms.ngeom]
    turn = np.array([along[0], left[0], 0.0, along[1], left[1], 0.0, 0.0, 0.0, 1.0])
    place = np.array([*corner, _TRAIL_LAYER_M])
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_TRIANGLE, reach, place, turn, color)
    geom.emission, geom.specular = _GLOW, 0.0
    geoms.ngeom += 1


def _thinned(path: Sequence[tuple[float, float]], step: float) -> list[tuple[float, float]]:
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
    spec = mujoco.MjSpec()
    view = spec.visual
    view.global_.offwidth, view.global_.offheight = width, height
    view.global_.fovy = math.degrees(_FIELD_OF_VIEW)
    view.quality.offsamples, view.quality.numslices, view.quality.numstacks = 4, 24, 2
    view.headlight.ambient, view.headlight.diffuse, view.headlight.specular = [_AMBIENT] * 3, [0.0] * 3, [0.0] * 3
    spec.stat.extent = max(x_max - x_min, y_max - y_min)
    spec.add_material(name="matt", emission=_GLOW, specular=0.0, shininess=0.0)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=[0.0, 0.0, -1.0],
        ambient=[0.0] * 3,
        diffuse=[_DIFFUSE] * 3,
        specular=[0.0] * 3,
        castshadow=False,  # shadows would take ten times as long as all the rest
    )
    _add_arena(spec.worldbody, scene.window)
    for body in scene.bodies:
        if body.model not in _BUILDERS:
            raise UserError(f"no body of the model {body.model!r} is known in space; use {', '.join(_BUILDERS)}")
        _BUILDERS[body.model](spec.worldbody.add_body(mocap=True), body)
    return spec.compile()


def _add_arena(world: mujoco.MjsBody, window: tuple[float, float, float, float]) -> None:
    x_min, x_max, y_min, y_max = window
    x, y = (x_min + x_max) / 2, (y_min + y_max) / 2
    half_x, half_y, half_wall = (x_max - x_min) / 2, (y_max - y_min) / 2, WALL_WIDTH_M / 2
    far = 20 * max(half_x, half_y)
    _add(world, _Box, [far, far, _LAYER_M], [x, y, -3 * _LAYER_M], _OUTSIDE)
    _add(world, _Box, [half_x, half_y, _LAYER_M], [x, y, -_LAYER_M], BACKGROUND)
    line = _GRID_WIDTH_M / 2
    for place in grid_lines(x_min, x_max, GRID_SPACING):
        _add(world, _Box, [line, half_y, _LAYER_M], [place, y, -_LAYER_M / 2], GRID)
    for place in grid_lines(y_min, y_max, GRID_SPACING):
        _add(world, _Box, [half_x, line, _LAYER_M], [x, place, -_LAYER_M / 2], GRID)
    middle = WALL_HEIGHT_M / 2
    for side in (-1, 1):
        _add(world, _Box, [half_wall, half_y, middle], [x + side * (half_x + half_wall), y, middle], FRAME)
        long = half_x + WALL_WIDTH_M
        _add(world, _Box, [long, half_wall, middle], [x, y + side * (half_y + half_wall), middle], FRAME)


def _add_robot(place: mujoco.MjsBody, body: Body) -> None:
    scale = body.radius / BODY_RADIUS_M
    height, wheel = BODY_HEIGHT_M * scale, WHEEL_RADIUS_M * scale
    plate = height / 8
    belt = (height - 2 * plate) * 0.55
    _add(place, _Cylinder, [body.radius * 0.62, height / 2 - plate, 0], [0, 0, height / 2], _DARK)
    _add(place, _Cylinder, [body.radius, (height - belt) / 2, 0], [0, 0, (height + belt) / 2], _DARK)
    _add(place, _Cylinder, [body.radius * 0.94, plate / 2, 0], [0, 0, height + plate / 2], body.color)
    _add(
        place, _Box, [body.radius * 0.4, body.radius * 0.11, plate / 2], [body.radius * 0.55, 0, height + plate], _NOSE
    )
    for side in (-1, 1):
        beside = side * (AXLE_M / 2 * scale)
        _add(place, _Cylinder, [wheel, wheel * 0.15, 0], [0, beside, wheel], _DARK, _LYING)


def _add_pillar(place: mujoco.MjsBody, body: Body) -> None:
    _add(place, _Cylinder, [body.radius, _PILLAR_HEIGHT_M / 2, 0], [0, 0, _PILLAR_HEIGHT_M / 2], body.color)


def _add_goal(place: mujoco.MjsBody, body: Body) -> None:
    _add(place, _Cylinder, [body.radius, _LAYER_M, 0], [0, 0, 0], body.color)
    _add(place, _Cylinder, [body.radius * 0.65, _LAYER_M, 0], [0, 0, _LAYER_M], BACKGROUND)


_BUILDERS = {"robot": _add_robot, "pillar": _add_pillar, "goal": _add_goal}


def _add(
    place: mujoco.MjsBody,
    shape: mujoco.mjtGeom,
    size: list[float],
    at: list[float],
    color: str,
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
) -> None:
    rgba = [*(level / 255 for level in ImageColor.getrgb(color)[:3]), 1.0]
    place.add_geom(
        type=shape, size=size, pos=at, quat=quat, rgba=rgba, material="matt", contype=0, conaffinity=0, mass=0
    )
