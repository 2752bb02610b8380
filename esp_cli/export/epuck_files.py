"""The files around an exported policy that drives e-pucks, filled into templates: C, a Webots project, a ROS 2 package.

Untested in Webots, in ROS 2 and on hardware.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from esp_cli.defaults import __version__
from esp_cli.export.c_source import literal, numbers
from esp_cli.export.runtime.esp_epuck import FIELDS, PATIENCE_S
from esp_cli.export.templates import RUNTIME, filled
from esp_envs.epuck.arena import Arena
from esp_envs.errors import UserError

ROS2_PACKAGE = "esp_formation"
_INIT = b'"""An exported policy and the node that drives e-pucks by it."""\n'
_WEBOTS_RELEASE = "R2023b"


def seen_robots(settings: Mapping[str, Any]) -> int:
    """Return how many other robots an observation shows."""
    return min(settings["neighbours"], settings["num_agents"] - 1)


def c_files(description: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the header and the source that build observations from poses and drive the wheels.

    Args:
        description: of an exported policy without memory that drives e-pucks.

    Raises:
        UserError: the policy sees something that poses do not tell.
    """
    robot, settings = description["robot"], description["task"]["settings"]
    fields = [(field["field"], field["index"].partition("..")[0]) for field in description["observation"]]
    names, nearness = {name for name, _ in fields}, settings["sight"] == "nearness"
    if unknown := names - FIELDS:
        raise UserError(f"poses do not tell what this policy sees: {', '.join(sorted(unknown))}")
    body, unit, others = robot["body_radius_m"], settings["goal_sight_m"], seen_robots(settings)
    values = {
        "fields": fields,
        "pairs": numbers([x for option in description["action"].get("options", ()) for x in option["means"]]),
        "sees_bodies": bool({"obstacle", "robots"} & names),
        "nearness": nearness,
        "seen": others,
        "team": others + 1,
        "least_pillars": int("obstacle" in names and not nearness),
        "period": literal(description["task"]["control_period_s"]),
        "patience": literal(PATIENCE_S),
        "pillar_reach": literal(settings["obstacle_radius_m"] + body),
        "robot_reach": literal(2 * body),
        "fading": literal(robot["fading_m"]),
        "goal_unit": None if unit is None else literal(unit),
        "max_speed": literal(robot["max_wheel_speed_rad_s"]),
    }
    return {name: filled(name, **values) for name in ("esp_epuck.h", "esp_epuck.c")}


def project_files(kind: str, policy: Mapping[str, bytes], settings: Mapping[str, Any]) -> dict[str, bytes]:
    """Return a project of Webots or a package of ROS 2 around a policy in Python.

    Args:
        kind: "webots" or "ros2".
        policy: the files of the policy.
        settings: of the task, as an export describes them.
    """
    side, radius = settings["arena_m"], settings["obstacle_radius_m"]
    arena = Arena(side, settings["num_agents"], settings["num_obstacles"], radius)
    pillars = arena.pillars().tolist()
    if kind == "webots":
        folder = "controllers/esp_epuck_webots"
        robots = [(x, y, math.atan2(-y, -x)) for x, y in arena.posts().tolist()]
        numbers_of = {"side": f"{side:g}", "height": f"{1.5 * side:g}", "radius": f"{radius:g}"}
        world = filled("formation.wbt", release=_WEBOTS_RELEASE, pillars=pillars, robots=robots, **numbers_of)
        around = {"worlds/formation.wbt": world}
    else:
        folder = ROS2_PACKAGE
        shown = [round(x, 4) for place in pillars for x in place]
        values = {"package": ROS2_PACKAGE, "version": __version__, "pillars": shown}
        names = {"package.xml": "", "setup.cfg": "", "setup.py": "", "formation.launch.py": "launch/"}
        around = {f"{place}{name}": filled(name, **values) for name, place in names.items()}
        around |= {f"resource/{ROS2_PACKAGE}": b"", f"{ROS2_PACKAGE}/__init__.py": _INIT}
    # Read, not imported: the drivers import what only a robot's machine has.
    drivers = {name: (RUNTIME / name).read_bytes() for name in ("esp_epuck.py", f"esp_epuck_{kind}.py")}
    return {f"{folder}/{name}": content for name, content in {**policy, **drivers}.items()} | around
