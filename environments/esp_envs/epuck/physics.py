"""The contract of physics engines: robots are placed, driven by wheel speeds, and read back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from esp_envs.epuck.robot import Arena, Array
from esp_envs.errors import UserError

TIMESTEP_S = 0.01


class Physics(ABC):
    """W worlds of N robots and M pillars in one arena, in float64 on the CPU."""

    remembered: ClassVar[tuple[str, ...]]  # arrays that a world's future depends on; attributes have an underscore
    _pose: Array
    _velocity: Array

    def __init__(self, arena: Arena, num_worlds: int, control_period_s: float) -> None:
        self.arena, self.num_worlds, self.control_period_s = arena, num_worlds, control_period_s
        self._substeps = round(control_period_s / TIMESTEP_S)
        if self._substeps < 1 or not np.isclose(self._substeps * TIMESTEP_S, control_period_s, rtol=1e-9):
            raise UserError(
                f"a control period of {control_period_s:g} s is not a multiple of {TIMESTEP_S:g} s; choose a multiple"
            )

    @abstractmethod
    def place(self, pose: Array, velocity: Array, pillars: Array, mass: Array, friction: Array) -> None:
        """Put every world into a state; what follows depends on nothing before.

        pose [W, N, 3]: x, y (m) and heading (rad, counter-clockwise from the x axis). velocity [W, N, 3]: m/s and
        rad/s. pillars [W, M, 2]: m. mass and friction [W, N]: multiples of an e-puck's.
        """

    @abstractmethod
    def advance(self, wheels: Array) -> None:
        """Drive for one control period at wheel speeds [W, N, 2], left and right, rad/s."""

    @property
    def pose(self) -> Array:
        """[W, N, 3] x, y and heading, as memory of its own."""
        return self._pose.copy()

    @property
    def velocity(self) -> Array:
        """[W, N, 3] of x, y and heading, as memory of its own."""
        return self._velocity.copy()

    def state_dict(self) -> dict[str, Array]:
        """Return copies of all that `load_state_dict` needs to go on bit for bit."""
        return {name: getattr(self, f"_{name}").copy() for name in self.remembered}

    @abstractmethod
    def load_state_dict(self, arrays: dict[str, Array]) -> None:
        """Restore what `state_dict` of an engine of the same size returned."""
