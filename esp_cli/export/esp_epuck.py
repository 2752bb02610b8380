"""What e-pucks see and do, for an exported policy of formation change; needs numpy alone.

Positions are metres in the arena's frame (x right, y up), headings radians counter-clockwise from x.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

PATIENCE_S = 0.5
"""Age of poses beyond which robots stand still."""
FIELDS = {"heading", "obstacle", "goal", "robots"}
"""Of an observation, that poses tell."""


class Pilot:
    """Drives a team: where everybody is in, wheel speeds out.

    Args:
        description: DESCRIPTION of the exported policy; an observation follows its layout.
        act: its act(obs).

    Raises:
        ValueError: the policy sees something that poses do not tell.
    """

    def __init__(self, description: dict[str, Any], act: Callable[[Any], Any]) -> None:
        self.robot, settings = description["robot"], description["task"]["settings"]
        self.act = act
        self.control_period_s = float(description["task"]["control_period_s"])
        self.nearness = settings["sight"] == "nearness"
        self.goal_sight_m = settings.get("goal_sight_m")
        self.pillar_radius_m = settings["obstacle_radius_m"]
        self.fields = [field["field"] for field in description["observation"]]
        if unknown := set(self.fields) - FIELDS:
            raise ValueError(f"poses do not tell what this policy sees: {', '.join(sorted(unknown))}")
        self.seen_robots = min(settings["neighbours"], settings["num_agents"] - 1)
        options = description["action"].get("options")
        self.pairs = np.array([option["means"] for option in options]) if options else None

    def observations(self, poses: Any, goals: Any, pillars: Any = ()) -> Any:
        """Return what every robot sees [N, D].

        Args:
            poses: [N, 3] x, y, heading of every robot.
            goals: [N, 2] x, y.
            pillars: [M, 2] x, y of their centres.

        Raises:
            ValueError: other shapes, or fewer robots or pillars than the policy sees.
        """
        poses, goals = np.asarray(poses, float), np.asarray(goals, float)
        pillars = np.asarray(pillars, float)
        if pillars.size and (pillars.ndim != 2 or pillars.shape[1] != 2):
            raise ValueError(f"pillars {pillars.shape} should be [M, 2]")
        pillars = pillars.reshape(-1, 2)
        if poses.ndim != 2 or poses.shape[1] != 3 or goals.shape != (len(poses), 2):
            raise ValueError(f"poses {poses.shape} and goals {goals.shape} should be [N, 3] and [N, 2]")
        position, heading = poses[:, :2], poses[:, 2]
        parts: dict[str, Callable[[], Any]] = {
            "heading": lambda: np.stack([np.cos(heading), np.sin(heading)], -1),
            "obstacle": lambda: self._pillar(position, pillars),
            "goal": lambda: self._goal(goals - position),
            "robots": lambda: self._others(position),
        }
        return np.concatenate([parts[field]() for field in self.fields], -1).astype(np.float32)

    def wheels(self, poses: Any, goals: Any, pillars: Any = (), age_s: float = 0.0) -> Any:
        """Return left and right wheel speed [N, 2] of every robot, rad/s; zeros where it is not safe to drive.

        The whole team stops when the poses are older than `PATIENCE_S`, and when any number is not finite: a robot
        whose neighbour is lost does not know what to avoid.

        Args:
            poses: [N, 3] x, y, heading of every robot.
            goals: [N, 2] x, y.
            pillars: [M, 2] x, y of their centres.
            age_s: of the poses, s; below 0 where clocks differ.
        """
        numbers = [np.asarray(given, float).ravel() for given in (poses, goals, pillars)]
        if not abs(age_s) <= PATIENCE_S or not np.isfinite(np.concatenate(numbers)).all():
            return np.zeros((len(poses), 2))
        action = self.act(self.observations(poses, goals, pillars))
        chosen = np.asarray(np.clip(action, -1, 1) if self.pairs is None else self.pairs[action], float)
        return np.where(np.isfinite(chosen).all(), chosen, 0.0) * self.robot["max_wheel_speed_rad_s"]

    def twist(self, wheels: Any) -> Any:
        """Return forward speed (m/s) and turning rate (rad/s) [..., 2] of wheel speeds [..., 2]."""
        rim = np.asarray(wheels, float) * self.robot["wheel_radius_m"]
        return np.stack([rim.sum(-1) / 2, (rim[..., 1] - rim[..., 0]) / self.robot["axle_m"]], -1)

    def _goal(self, way: Any) -> Any:
        """Return the way to each goal as it is, or in its unit and no longer than one."""
        if self.goal_sight_m is None:
            return way
        return way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), self.goal_sight_m)

    def _pillar(self, position: Any, pillars: Any) -> Any:
        """Return the nearest pillar as each robot sees it [N, 2]."""
        if not len(pillars):
            if self.nearness:
                return np.zeros_like(position)
            raise ValueError("this policy sees the offset of the nearest pillar, so it needs one; name its position")
        ways = pillars[None] - position[:, None]
        way = ways[np.arange(len(position)), np.linalg.norm(ways, axis=-1).argmin(-1)]
        return self._seen(way, self.pillar_radius_m + self.robot["body_radius_m"])

    def _others(self, position: Any) -> Any:
        """Return the nearest other robots as each robot sees them [N, 2 * seen]."""
        if len(position) <= self.seen_robots:
            raise ValueError(f"each robot sees {self.seen_robots} others, but there are {len(position)} robots in all")
        ways = position[None] - position[:, None]
        apart = np.linalg.norm(ways, axis=-1)
        np.fill_diagonal(apart, np.inf)
        nearest = apart.argsort(-1, kind="stable")[:, : self.seen_robots]
        seen = np.take_along_axis(ways, nearest[..., None], 1)
        return self._seen(seen, 2 * self.robot["body_radius_m"]).reshape(len(position), -1)

    def _seen(self, way: Any, reach_m: float) -> Any:
        """Return offsets as they are, or as nearness: their direction, 1 long at a touch, fading with the gap."""
        if not self.nearness:
            return way
        distance = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9)
        return way / distance * np.exp(-np.maximum(distance - reach_m, 0) / self.robot["fading_m"])
