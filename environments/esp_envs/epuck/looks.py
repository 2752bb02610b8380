"""What robots, pillars, goals and the arena look like in space: a MuJoCo model to draw, not to simulate."""

from __future__ import annotations

import math

import mujoco
from PIL import ImageColor

from esp_envs.drawing import BACKGROUND, FRAME, GRID
from esp_envs.epuck.robot import AXLE_M, BODY_HEIGHT_M, BODY_RADIUS_M, WHEEL_RADIUS_M
from esp_envs.errors import UserError
from esp_envs.scene import GRID_SPACING, Body, Scene

WALL_HEIGHT_M = 0.03
"""Lower than a robot, so that the wall nearest to the camera hides none."""
WALL_WIDTH_M = 0.02
_PILLAR_HEIGHT_M = 0.06
_GRID_WIDTH_M = 0.004
_LAYER_M = 0.001
"""Thickness of what lies flat on the floor."""
TRAIL_LAYER_M = 0.75 * _LAYER_M
"""Height of trails: above the lines of the grid, below the goals."""
_DARK, _NOSE, _OUTSIDE = "#2b2b30", "#fafaf7", "#dededa"
_AMBIENT, _DIFFUSE, GLOW = 0.25, 0.35, 0.4
"""A top that faces the light shows its colour as it is: the three add up to 1; a side that faces away is darker."""

_Box = mujoco.mjtGeom.mjGEOM_BOX
_Cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
_LYING = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
"""Turns a cylinder's axis from z to y."""


def model_of(scene: Scene, width: int, height: int, field_of_view: float) -> mujoco.MjModel:
    """Build floor, walls, light, and one mocap body per body of the scene, in their order.

    Args:
        scene: its window is the floor between the walls, m.
        width: of the picture, pixels.
        height: of the picture, pixels.
        field_of_view: of the camera from bottom to top, rad.

    Raises:
        UserError: the window is empty, or a body has an unknown model or none.
    """
    x_min, x_max, y_min, y_max = scene.window
    if x_max <= x_min or y_max <= y_min:
        raise UserError(f"cannot draw the window {scene.window}; use a real window")
    spec = mujoco.MjSpec()
    view = spec.visual
    view.global_.offwidth, view.global_.offheight = width, height
    view.global_.fovy = math.degrees(field_of_view)
    view.quality.offsamples, view.quality.numslices, view.quality.numstacks = 4, 24, 2
    view.headlight.ambient, view.headlight.diffuse, view.headlight.specular = [_AMBIENT] * 3, [0.0] * 3, [0.0] * 3
    spec.stat.extent = max(x_max - x_min, y_max - y_min)
    spec.add_material(name="matt", emission=GLOW, specular=0.0, shininess=0.0)
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
    """Add the floor with grid lines as in the view from above, and walls around it."""
    x_min, x_max, y_min, y_max = window
    x, y = (x_min + x_max) / 2, (y_min + y_max) / 2
    half_x, half_y, half_wall = (x_max - x_min) / 2, (y_max - y_min) / 2, WALL_WIDTH_M / 2
    far = 20 * max(half_x, half_y)
    _add(world, _Box, [far, far, _LAYER_M], [x, y, -3 * _LAYER_M], _OUTSIDE)
    _add(world, _Box, [half_x, half_y, _LAYER_M], [x, y, -_LAYER_M], BACKGROUND)
    line = _GRID_WIDTH_M / 2
    for k in range(math.ceil(x_min / GRID_SPACING), math.floor(x_max / GRID_SPACING) + 1):
        _add(world, _Box, [line, half_y, _LAYER_M], [k * GRID_SPACING, y, -_LAYER_M / 2], GRID)
    for k in range(math.ceil(y_min / GRID_SPACING), math.floor(y_max / GRID_SPACING) + 1):
        _add(world, _Box, [half_x, line, _LAYER_M], [x, k * GRID_SPACING, -_LAYER_M / 2], GRID)
    middle = WALL_HEIGHT_M / 2
    for side in (-1, 1):
        _add(world, _Box, [half_wall, half_y, middle], [x + side * (half_x + half_wall), y, middle], FRAME)
        long = half_x + WALL_WIDTH_M
        _add(world, _Box, [long, half_wall, middle], [x, y + side * (half_y + half_wall), middle], FRAME)


def _add_robot(place: mujoco.MjsBody, body: Body) -> None:
    """Add an e-puck on two wheels: a dark case under a plate of the body's colour, with a nose mark."""
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
    """Add a ring on the floor."""
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
    """Add one geom that touches nothing."""
    rgba = [*(level / 255 for level in ImageColor.getrgb(color)[:3]), 1.0]
    place.add_geom(
        type=shape, size=size, pos=at, quat=quat, rgba=rgba, material="matt", contype=0, conaffinity=0, mass=0
    )
