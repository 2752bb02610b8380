"""The arena: a walled square, posts around its edge, and pillars inside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from esp_envs.epuck.robot import BODY_RADIUS_M, Array
from esp_envs.errors import UserError

POST_CLEARANCE_M = 0.013  # air between a wall and the body of a robot on its post
PILLAR_RING = 0.4  # distance of the pillars from the middle, as a share of half a side


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
                f"{self.num_robots} robots do not fit around an arena of {self.side_m:g} m with 10 cm between them; "
                "make it larger"
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
        """Return where the robots start, evenly spread along a square: eight stand on corners and edge midpoints.

        They are [N, 2], counter-clockwise from the lower left corner, m. A robot's goal is the antipode of its post.
        """
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
