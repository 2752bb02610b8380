"""The e-puck: its measures, how wheel speeds move it, and its arena.

Measures are those of the Webots model of the first e-puck, on which the paper trained; the wheel and axle of the real
robot differ by 2 to 3 % (wheels of 20.5 mm, an axle of 53 mm).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from esp_envs.errors import UserError

Array = NDArray[np.float64]

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
POST_CLEARANCE_M = 0.013  # air between a wall and the body of a robot on its post
PILLAR_RING = 0.4  # distance of the pillars from the middle, as a share of half a side
DIMENSIONS = {
    "body_radius_m": BODY_RADIUS_M,
    "wheel_radius_m": WHEEL_RADIUS_M,
    "axle_m": AXLE_M,
    "max_wheel_speed_rad_s": MAX_WHEEL_SPEED,
}
"""What the program on a robot has to know."""


def drive(wheels: Array) -> tuple[Array, Array]:
    """Return speed (m/s) and turning rate (rad/s, counter-clockwise) of wheels [..., 2] (rad/s) that do not slip."""
    rim = wheels * WHEEL_RADIUS_M
    return (rim[..., 0] + rim[..., 1]) / 2, (rim[..., 1] - rim[..., 0]) / AXLE_M


def chord(wheels: Array, heading: Array, duration_s: float) -> Array:
    """Return the constant velocity (vx, vy, spin), [..., 3], that ends where the arc of wheels [..., 2] (rad/s) would.

    A robot that drives at speed v and turns at rate w follows an arc; over a time T its end is reached as well along
    the chord: in the direction heading + w T / 2, at the speed v sin(w T / 2) / (w T / 2).
    """
    speed, spin = drive(wheels)
    half_turn = spin * duration_s / 2
    speed = speed * np.sinc(half_turn / np.pi)
    direction = heading + half_turn
    return np.stack([speed * np.cos(direction), speed * np.sin(direction), spin], -1)


@dataclass(frozen=True)
class Arena:
    """What stands still, and where robots start."""

    side_m: float  # length of a wall
    num_robots: int  # N
    num_pillars: int  # M
    pillar_radius_m: float

    def __post_init__(self) -> None:
        if self.reach_m <= 0:
            raise UserError(f"a robot does not fit into an arena of {self.side_m:g} m; make it larger")
        gap = 4 * self.reach_m * 2 / max(self.num_robots, 1) - 2 * BODY_RADIUS_M
        if self.num_robots > 1 and gap < 0.1:
            raise UserError(
                f"{self.num_robots} robots do not fit around an arena of {self.side_m:g} m with 10 cm of wall between "
                "them; make it larger"
            )
        ring = PILLAR_RING * self.side_m / 2
        if self.num_pillars and ring + self.pillar_radius_m > self.reach_m - 3 * BODY_RADIUS_M:
            raise UserError(
                f"pillars of radius {self.pillar_radius_m:g} m reach the posts in an arena of {self.side_m:g} m; "
                "make them thinner"
            )
        if self.num_pillars > 1 and 2 * ring * np.sin(np.pi / self.num_pillars) < 2 * self.pillar_radius_m:
            raise UserError(f"{self.num_pillars} pillars of radius {self.pillar_radius_m:g} m overlap; use fewer")

    @property
    def reach_m(self) -> float:
        """Largest |x| and |y| of a post."""
        return self.side_m / 2 - BODY_RADIUS_M - POST_CLEARANCE_M

    def posts(self) -> Array:
        """Return where robots start [N, 2], counter-clockwise from lower left on a square, m; goals are antipodes."""
        along = np.arange(self.num_robots) * 4 / self.num_robots
        corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        edge = along.astype(int)
        part = (along - edge)[:, None]
        return self.reach_m * (corner[edge] * (1 - part) + corner[edge + 1] * part)

    def pillars(self) -> Array:
        """Return where the pillars stand: [M, 2], evenly spread on a ring, the first on the diagonal, m."""
        angle = np.pi / 4 + 2 * np.pi * np.arange(self.num_pillars) / max(self.num_pillars, 1)
        ring = PILLAR_RING * self.side_m / 2
        return ring * np.stack([np.cos(angle), np.sin(angle)], -1)
