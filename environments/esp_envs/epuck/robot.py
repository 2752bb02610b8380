"""The e-puck: its measures, and how wheel speeds move it.

Measures are those of the Webots model of the first e-puck, on which the paper trained; the wheel and axle of the real
robot differ by 2 to 3 % (wheels of 20.5 mm, an axle of 53 mm).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

BODY_RADIUS_M = 0.037
BODY_HEIGHT_M = 0.045
MASS_KG = 0.16  # body and wheels together
WHEEL_MASS_KG = 0.005
WHEEL_RADIUS_M = 0.020
AXLE_M = 0.052  # distance between the wheels
MAX_WHEEL_SPEED = 6.28  # rad/s; at full speed the robot drives 0.1256 m/s, or spins at 4.83 rad/s
MAX_SPEED_M_S = MAX_WHEEL_SPEED * WHEEL_RADIUS_M
MAX_SPIN_RAD_S = 2 * MAX_SPEED_M_S / AXLE_M
FRICTION = 1.0  # of the wheels on the floor: no wheel pushes harder than this times its share of the weight
GRAVITY_M_S2 = 9.81
DIMENSIONS = {
    "body_radius_m": BODY_RADIUS_M,
    "wheel_radius_m": WHEEL_RADIUS_M,
    "axle_m": AXLE_M,
    "max_wheel_speed_rad_s": MAX_WHEEL_SPEED,
}
"""What the program on a robot has to know."""


def drive(wheels: Array) -> tuple[Array, Array]:
    """Return forward speed (m/s) and turning rate (rad/s, counter-clockwise) of wheels that do not slip.

    Args:
        wheels: [..., 2] left and right wheel speed, rad/s.
    """
    rim = wheels * WHEEL_RADIUS_M
    return (rim[..., 0] + rim[..., 1]) / 2, (rim[..., 1] - rim[..., 0]) / AXLE_M


def chord(wheels: Array, heading: Array, duration_s: float) -> Array:
    """Return the constant velocity (vx, vy, spin), [..., 3], that ends where the arc of these wheels would.

    A robot that drives at speed v and turns at rate w follows an arc; over a time T its end is reached as well along
    the chord: in the direction heading + w T / 2, at the speed v sin(w T / 2) / (w T / 2).

    Args:
        wheels: [..., 2] left and right wheel speed, rad/s.
        heading: [...] at the beginning, rad.
        duration_s: T.
    """
    speed, spin = drive(wheels)
    half_turn = spin * duration_s / 2
    speed = speed * np.sinc(half_turn / np.pi)
    direction = heading + half_turn
    return np.stack([speed * np.cos(direction), speed * np.sin(direction), spin], -1)
