"""The physics engines by name. Adding one is one module and one line in `ENGINES`; it is imported when it is used."""

from __future__ import annotations

from esp_envs.epuck.gl import forget_missing_backend
from esp_envs.epuck.physics import Physics
from esp_envs.epuck.robot import Arena
from esp_envs.installed import load

ENGINES = {
    "mujoco": "esp_envs.epuck.mujoco_engines:MujocoPlanar",
    "mujoco-3d": "esp_envs.epuck.mujoco_engines:MujocoSpatial",
    "pymunk": "esp_envs.epuck.pymunk_engine:PymunkPlanar",
}


def make_physics(name: str, arena: Arena, num_worlds: int, control_period_s: float) -> Physics:
    """Make W worlds in the engine `name`."""
    forget_missing_backend()
    engine: type[Physics] = load(ENGINES[name])
    return engine(arena, num_worlds, control_period_s)
