"""ROS 2 node: drives a team of e-pucks that changes formation by an exported policy. Untested on hardware.

It stands beside policy.py and esp_epuck.py, which `esp export formation -f numpy` writes: `python epuck_ros2.py`.

Subscribes to
    poses (geometry_msgs/PoseArray): all robots in the order of their numbers, in the arena's frame (metres, z up),
        from an overhead camera or another tracker.
Publishes, for every robot k
    epuck<k>/wheel_speeds (std_msgs/Float32MultiArray): left and right, rad/s;
    epuck<k>/cmd_vel (geometry_msgs/Twist): the same as forward speed and turning rate.
Parameters
    goals (list of x, y of every robot, m): by default opposite to where each is first seen;
    pillars (list of x, y of each, m): by default none.

Robots stand still until the first poses come, when no new ones came for half a second, and when a number is not
finite. Poses are as old as their time stamp says, where they have one, so the tracker's clock has to be the node's;
with the stamp of the last ones they are not new.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import Any

import policy
import rclpy
from esp_epuck import Pilot
from geometry_msgs.msg import PoseArray, Twist
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from std_msgs.msg import Float32MultiArray


def pose_of(message: Any) -> tuple[float, float, float]:
    """Return x, y and heading of a geometry_msgs/Pose; NaN where a tracker fills in no orientation."""
    q = message.orientation
    heading = math.atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
    is_known = any((q.w, q.x, q.y, q.z))
    return message.position.x, message.position.y, heading if is_known else math.nan


class Driver(Node):  # type: ignore[misc] # a class of ROS 2, which has no types
    """Drives the whole team, one action each control period."""

    def __init__(self) -> None:
        super().__init__("esp_epuck")
        self.pilot = Pilot(policy.DESCRIPTION, policy.act)
        self.goals = self._points("goals")
        self.pillars = self._points("pillars")
        self.poses: list[tuple[float, float, float]] = []
        self.seen_at_s, self.stamp = -math.inf, (0, 0)
        self.outputs: list[tuple[Any, Any]] = []
        self.create_subscription(PoseArray, "poses", self.see, 1)
        self.create_timer(self.pilot.control_period_s, self.act)

    def _points(self, name: str) -> list[tuple[float, float]]:
        """Read a parameter that lists x and y in turn."""
        any_numbers = ParameterDescriptor(dynamic_typing=True)  # rclpy takes an empty list for one of bytes
        values = [float(value) for value in self.declare_parameter(name, [], any_numbers).value or []]
        if len(values) % 2:
            raise ValueError(f"the parameter {name} lists x and y in turn, but has {len(values)} numbers")
        return list(zip(values[::2], values[1::2], strict=True))

    def see(self, message: Any) -> None:
        """Take in where everybody is, unless a tracker repeats itself."""
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        if stamp == self.stamp != (0, 0):
            return
        self.stamp = stamp
        self.poses = [pose_of(pose) for pose in message.poses]
        self.seen_at_s = min(self._now_s(), stamp[0] + stamp[1] / 1e9) if any(stamp) else self._now_s()
        if not self.goals and all(map(math.isfinite, chain.from_iterable(self.poses))):
            self.goals = [(-x, -y) for x, y, _ in self.poses]
        for k in range(len(self.outputs), len(self.poses)):
            wheels = self.create_publisher(Float32MultiArray, f"epuck{k}/wheel_speeds", 1)
            self.outputs.append((wheels, self.create_publisher(Twist, f"epuck{k}/cmd_vel", 1)))

    def act(self) -> None:
        """Drive everybody, or stop them where nobody knows where they are."""
        if len(self.goals) != len(self.poses):
            self.send([(0.0, 0.0)] * len(self.outputs))
            return
        age_s = self._now_s() - self.seen_at_s
        self.send(self.pilot.wheels(self.poses, self.goals, self.pillars, age_s))

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
