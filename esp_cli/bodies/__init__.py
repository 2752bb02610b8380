"""Robots: the symmetries of a body, derived from its model and proven in its simulator, for layouts and loops."""

from esp_cli.bodies.body import Body
from esp_cli.bodies.kinds import (
    ATTITUDE_6D,
    AXIAL_3D,
    PLANAR_COMMAND,
    QUATERNION,
    QUATERNION_XYZW,
    VECTOR_3D,
    grid,
    points_field,
)
from esp_cli.bodies.proof import Proof
from esp_cli.bodies.reading import read_model

__all__ = [
    "ATTITUDE_6D",
    "AXIAL_3D",
    "PLANAR_COMMAND",
    "QUATERNION",
    "QUATERNION_XYZW",
    "VECTOR_3D",
    "Body",
    "Proof",
    "grid",
    "points_field",
    "read_model",
]
