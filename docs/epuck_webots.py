"""Webots controller: an e-puck of a team that changes formation by an exported policy. Untested on hardware.

It stands in a project's folder controllers/epuck_webots beside policy.py and esp_epuck.py, which
`esp export formation -f numpy` writes. In your world (2023a or newer: z is up) the e-pucks have the DEF names ROBOT0,
ROBOT1, ... without a gap, pillars PILLAR0, PILLAR1, ..., and each e-puck has this controller and `supervisor TRUE`,
through which it learns where everybody is. The control period has to be a multiple of basicTimeStep: 10 or 20 ms do.
Robots stand still where a pose is not finite.

A robot's goal is opposite to where it starts, seen from the middle of the arena, unless controllerArgs names one as
two numbers (m): ["0.5", "-0.3"].
"""

from __future__ import annotations

import math
import sys
from typing import Any

import policy
from controller import Supervisor
from esp_epuck import Pilot


def named(robot: Any, prefix: str) -> list[Any]:
    """Return the nodes with the DEF names PREFIX0, PREFIX1, ..., up to the first that is missing."""
    nodes: list[Any] = []
    while (node := robot.getFromDef(f"{prefix}{len(nodes)}")) is not None:
        nodes.append(node)
    return nodes


def pose_of(node: Any) -> tuple[float, float, float]:
    """Return x, y and heading of a node; column 0 of its orientation is where its front points."""
    x, y, _ = node.getPosition()
    turn = node.getOrientation()
    return x, y, math.atan2(turn[3], turn[0])


class Driver:
    """One robot of the team.

    Args:
        robot: Webots' Supervisor of this e-puck.
        pilot: of the exported policy.
        goal: x and y, m; by default opposite to the start.
    """

    def __init__(self, robot: Any, pilot: Pilot, goal: tuple[float, float] | None = None) -> None:
        self.robot, self.pilot = robot, pilot
        self.team, self.pillars = named(robot, "ROBOT"), named(robot, "PILLAR")
        own = robot.getSelf().getDef()
        names = [node.getDef() for node in self.team]
        if own not in names:
            raise ValueError(f"this robot has the DEF name '{own}'; give the team the names ROBOT0, ROBOT1, ...")
        self.own = names.index(own)
        self.motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
        for motor in self.motors:
            motor.setPosition(math.inf)
            motor.setVelocity(0.0)
        x, y, _ = pose_of(self.team[self.own])
        self.goal = (-x, -y) if goal is None else goal

    def act(self) -> None:
        """Look where everybody is, and set the own wheels."""
        poses = [pose_of(node) for node in self.team]
        # Only the own row counts, in which the others' goals do not occur.
        goals = [self.goal] * len(poses)
        wheels = self.pilot.wheels(poses, goals, [node.getPosition()[:2] for node in self.pillars])[self.own]
        for motor, speed in zip(self.motors, wheels, strict=True):
            motor.setVelocity(float(max(-motor.getMaxVelocity(), min(motor.getMaxVelocity(), speed))))


def main() -> None:
    """Drive until the simulation ends."""
    robot = Supervisor()
    pilot = Pilot(policy.DESCRIPTION, policy.act)
    period_ms = round(1000 * pilot.control_period_s)
    if period_ms % int(robot.getBasicTimeStep()):
        raise ValueError(f"basicTimeStep is {robot.getBasicTimeStep()} ms; take a divisor of {period_ms} ms, as 10")
    goal = (float(sys.argv[1]), float(sys.argv[2])) if len(sys.argv) > 2 else None
    driver = Driver(robot, pilot, goal)
    driver.act()
    while robot.step(period_ms) != -1:
        driver.act()


if __name__ == "__main__":
    main()
