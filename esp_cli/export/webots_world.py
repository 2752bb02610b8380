"""A Webots world with the team of an exported policy. Untested in Webots."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from esp_envs.epuck.arena import Arena

CONTROLLER = "esp_epuck_webots"
_RELEASE = "R2023b"
_PROTOS = f"https://raw.githubusercontent.com/cyberbotics/webots/{_RELEASE}/projects"
_HEAD = f"""#VRML_SIM {_RELEASE} utf8

EXTERNPROTO "{_PROTOS}/objects/floors/protos/RectangleArena.proto"
EXTERNPROTO "{_PROTOS}/robots/gctronic/e-puck/protos/E-puck.proto"

WorldInfo {{
  title "Formation change"
  basicTimeStep 10
}}
Viewpoint {{
  orientation 0 1 0 1.5708
  position 0 0 HEIGHT
}}
Background {{
  skyColor [ 0.9 0.9 0.9 ]
}}
DirectionalLight {{
  ambientIntensity 1
  direction 0.3 0.2 -1
}}
RectangleArena {{
  floorSize SIDE SIDE
  wallHeight 0.05
}}
"""
_PILLAR = """DEF PILLAR{index} Solid {{
  translation {x:.4f} {y:.4f} 0.05
  children [
    Shape {{
      appearance PBRAppearance {{
        baseColor 0.44 0.44 0.44
        metalness 0
      }}
      geometry Cylinder {{
        height 0.1
        radius {radius:g}
      }}
    }}
  ]
  name "pillar{index}"
  boundingObject Cylinder {{
    height 0.1
    radius {radius:g}
  }}
}}
"""
_ROBOT = """DEF ROBOT{index} E-puck {{
  translation {x:.4f} {y:.4f} 0
  rotation 0 0 1 {turn:.4f}
  name "epuck{index}"
  controller "{controller}"
  supervisor TRUE
}}
"""


def world_file(settings: Mapping[str, Any]) -> bytes:
    """Return the world that the task's settings describe: robots on their posts that look to the middle, and pillars.

    Args:
        settings: of the task, as an export describes them.
    """
    side, radius = settings["arena_m"], settings["obstacle_radius_m"]
    arena = Arena(side, settings["num_agents"], settings["num_obstacles"], radius)
    text = _HEAD.replace("HEIGHT", f"{1.5 * side:g}").replace("SIDE", f"{side:g}")
    for index, (x, y) in enumerate(arena.pillars().tolist()):
        text += _PILLAR.format(index=index, x=x, y=y, radius=radius)
    for index, (x, y) in enumerate(arena.posts().tolist()):
        text += _ROBOT.format(index=index, x=x, y=y, turn=math.atan2(-y, -x), controller=CONTROLLER)
    return text.encode()
