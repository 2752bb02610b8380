"""The ROS 2 package (ament_python) around an exported policy. Untested in ROS 2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from esp_cli.defaults import __version__
from esp_envs.epuck.arena import Arena

ROS2_PACKAGE = "esp_formation"
_MANIFEST = f"""<?xml version="1.0"?>
<?xml-model href="http://download.ros.org/schema/package_format3.xsd" schematypens="http://www.w3.org/2001/XMLSchema"?>
<package format="3">
  <name>{ROS2_PACKAGE}</name>
  <version>{__version__}</version>
  <description>Drives a team of e-pucks that changes formation, by a policy that esp exported.</description>
  <maintainer email="you@example.org">you</maintainer>
  <license>MIT</license>
  <exec_depend>rclpy</exec_depend>
  <exec_depend>rcl_interfaces</exec_depend>
  <exec_depend>geometry_msgs</exec_depend>
  <exec_depend>std_msgs</exec_depend>
  <exec_depend>launch</exec_depend>
  <exec_depend>launch_ros</exec_depend>
  <exec_depend>python3-numpy</exec_depend>
  <export>
    <build_type>ament_python</build_type>
  </export>
</package>
"""
_SETUP = f'''"""Installs the node and its launch file."""

from setuptools import setup

setup(
    name="{ROS2_PACKAGE}",
    version="{__version__}",
    packages=["{ROS2_PACKAGE}"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/{ROS2_PACKAGE}"]),
        ("share/{ROS2_PACKAGE}", ["package.xml"]),
        ("share/{ROS2_PACKAGE}/launch", ["launch/formation.launch.py"]),
    ],
    install_requires=["setuptools", "numpy"],
    entry_points={{"console_scripts": ["drive = {ROS2_PACKAGE}.esp_epuck_ros2:main"]}},
)
'''
_SETUP_CFG = f"""[develop]
script_dir=$base/lib/{ROS2_PACKAGE}
[install]
install_scripts=$base/lib/{ROS2_PACKAGE}
"""
_LAUNCH = f'''"""Starts the node: ros2 launch {ROS2_PACKAGE} formation.launch.py poses:=/tracker/poses."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PILLARS = @pillars@
"""x and y of each in turn, m, as in training; put yours here."""


def generate_launch_description():
    """Return the argument `poses`, the topic of the tracker, and the node."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("poses", default_value="poses"),
            Node(
                package="{ROS2_PACKAGE}",
                executable="drive",
                output="screen",
                parameters=[{{"pillars": PILLARS}}] if PILLARS else [],
                remappings=[("poses", LaunchConfiguration("poses"))],
            ),
        ]
    )
'''


def package_files(settings: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the files of the package that are not the node's own modules.

    Args:
        settings: of the task, as an export describes them.
    """
    arena = Arena(settings["arena_m"], settings["num_agents"], settings["num_obstacles"], settings["obstacle_radius_m"])
    pillars = [round(x, 4) for x in arena.pillars().ravel().tolist()]
    texts = {
        "package.xml": _MANIFEST,
        "setup.py": _SETUP,
        "setup.cfg": _SETUP_CFG,
        f"resource/{ROS2_PACKAGE}": "",
        f"{ROS2_PACKAGE}/__init__.py": '"""An exported policy and the node that drives e-pucks by it."""\n',
        "launch/formation.launch.py": _LAUNCH.replace("@pillars@", repr(pillars)),
    }
    return {name: text.encode() for name, text in texts.items()}
