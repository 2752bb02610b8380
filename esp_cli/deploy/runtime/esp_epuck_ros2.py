"""ROS 2 node: drives a team of e-pucks that changes formation by an exported policy. Untested on hardware.

Put this file, esp_epuck.py and policy.py into one folder and run `python3 esp_epuck_ros2.py` in a sourced ROS 2.

Subscribes to
    poses (geometry_msgs/PoseArray): all robots in the order of their numbers, in the arena's frame (metres, z up),
        from an overhead camera or another tracker.
Publishes, for every robot k
    epuck<k>/wheel_speeds (std_msgs/Float32MultiArray): left and right, rad/s;
    epuck<k>/cmd_vel (geometry_msgs/Twist): the same as forward speed and turning rate.
Parameters
    goals (list of x, y of every robot, m): by default opposite to where each is first seen;
    pillars (list of x, y of each, m): by default none.

Robots stand still until the first poses come, and when none came for half a second.
"""

from __future__ import annotations

import math
from typing import Any

import policy
import rclpy
from esp_epuck import Pilot
from geometry_msgs.msg import PoseArray, Twist
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray

PATIENCE_S = 0.5
"""Age of poses beyond which robots stand still."""


def pose_of(message: Any) -> tuple[float, float, float]:
    """Return x, y and heading of a geometry_msgs/Pose."""
    q = message.orientation
    heading = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return message.position.x, message.position.y, heading


class Driver(Node):  # type: ignore[misc] # a class of ROS 2, which has no types
    """Drives the whole team, one action each control period."""

    def __init__(self) -> None:
        super().__init__("esp_epuck")
        self.pilot = Pilot(policy.DESCRIPTION, policy.act)
        self.goals = self._points("goals")
        self.pillars = self._points("pillars")
        self.poses: list[tuple[float, float, float]] = []
        self.seen_at_s = -math.inf
        self.outputs: list[tuple[Any, Any]] = []
        self.create_subscription(PoseArray, "poses", self.see, 1)
        self.create_timer(self.pilot.control_period_s, self.act)

    def _points(self, name: str) -> list[tuple[float, float]]:
        """Read a parameter that lists x and y in turn."""
        values = [float(value) for value in self.declare_parameter(name, [0.0][:0]).value or []]
        if len(values) % 2:
            raise ValueError(f"the parameter {name} lists x and y in turn, but has {len(values)} numbers")
        return list(zip(values[::2], values[1::2], strict=True))

    def see(self, message: Any) -> None:
        """Take in where everybody is."""
        self.poses = [pose_of(pose) for pose in message.poses]
        self.seen_at_s = self._now_s()
        if not self.goals:
            self.goals = [(-x, -y) for x, y, _ in self.poses]
        for k in range(len(self.outputs), len(self.poses)):
            wheels = self.create_publisher(Float32MultiArray, f"epuck{k}/wheel_speeds", 1)
            self.outputs.append((wheels, self.create_publisher(Twist, f"epuck{k}/cmd_vel", 1)))

    def act(self) -> None:
        """Drive everybody, or stop them where nobody knows where they are."""
        if self._now_s() - self.seen_at_s > PATIENCE_S or len(self.goals) != len(self.poses):
            self.send([(0.0, 0.0)] * len(self.outputs))
            return
        self.send(self.pilot.wheels(self.poses, self.goals, self.pillars))

    def send(self, wheels: Any) -> None:
        """Publish left and right wheel speed of every robot, rad/s."""
        for (direct, twist), pair in zip(self.outputs, wheels, strict=False):
            speeds = Float32MultiArray()
            speeds.data = [float(speed) for speed in pair]
            direct.publish(speeds)
            motion = Twist()
            motion.linear.x, motion.angular.z = (float(x) for x in self.pilot.twist(pair))
            twist.publish(motion)

    def _now_s(self) -> float:
        return float(self.get_clock().now().nanoseconds) / 1e9


def main() -> None:
    """Drive until ROS shuts down, and leave the robots standing still."""
    rclpy.init()
    driver = Driver()
    try:
        rclpy.spin(driver)
    except KeyboardInterrupt:
        pass
    finally:
        driver.send([(0.0, 0.0)] * len(driver.outputs))
        driver.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
