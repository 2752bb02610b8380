"""How one robot moves in each engine, and what the engines refuse."""

import subprocess
import sys

import numpy as np
import pytest

from esp_envs.epuck.engines import ENGINES
from esp_envs.epuck.robot import MAX_SPEED_M_S, Arena, Array
from tests.envs.epuck.driving import PERIOD_S, engine

OPEN = Arena(2.0, 1, 0, 0.1)
SPEED_TOLERANCE = {"mujoco": 1e-6, "mujoco-3d": 1e-6, "pymunk": 1e-12}
"""Relative error of speed and spin once the robot has got up to them."""
ARC_TOLERANCE_M = {"mujoco": 3e-3, "mujoco-3d": 1e-3, "pymunk": 1e-4}
"""At the end of 0.18 m: the servo of the planar engine lags behind the turning heading by 0.017 rad."""

every_engine = pytest.mark.parametrize("name", ENGINES)


def run(
    name: str, wheels: tuple[float, float], pose: list[float], periods: int, velocity: Array | None = None
) -> Array:
    """Return the poses [periods + 1, 3] of one robot."""
    others = {} if velocity is None else {"velocity": velocity.reshape(1, 1, 3)}
    physics = engine(name, OPEN, np.array([[pose]]), **others)
    poses = [physics.pose[0, 0]]
    for _ in range(periods):
        physics.advance(np.array([[wheels]]))
        poses.append(physics.pose[0, 0])
    return np.array(poses)


def turned(poses: Array) -> float:
    """Return the angle turned from the first to the last pose, rad."""
    steps = np.diff(poses[:, 2])
    return float(np.arctan2(np.sin(steps), np.cos(steps)).sum())


@every_engine
def test_equal_wheels_drive_straight(name: str) -> None:
    poses = run(name, (5.0, 5.0), [-0.5, -0.2, 0.5], periods=20)
    # 5 rad/s on a wheel of 0.02 m: 0.1 m/s, so 0.1 m in the second half of two seconds
    want = 0.1 * np.array([np.cos(0.5), np.sin(0.5)])
    np.testing.assert_allclose(poses[20, :2] - poses[10, :2], want, rtol=SPEED_TOLERANCE[name])
    assert abs(turned(poses)) < 1e-12
    # and it is up to speed soon: never more than 6 ms' way behind
    assert 0.2 - 0.1 * 0.06 < np.linalg.norm(poses[20, :2] - poses[0, :2]) < 0.2
    back = run(name, (-5.0, -5.0), [-0.5, -0.2, 0.5], periods=20)
    np.testing.assert_allclose(back - back[0], poses[0] - poses, atol=1e-12)


@every_engine
def test_a_robot_placed_at_full_speed_keeps_it_and_wheels_at_rest_stop_it(name: str) -> None:
    velocity = MAX_SPEED_M_S * np.array([np.cos(1.0), np.sin(1.0), 0.0])
    physics = engine(name, OPEN, np.array([[[0.0, 0.0, 1.0]]]), velocity=velocity.reshape(1, 1, 3))
    np.testing.assert_allclose(physics.velocity[0, 0], velocity, atol=1e-15)
    physics.advance(np.full((1, 1, 2), 6.28))
    np.testing.assert_allclose(physics.pose[0, 0, :2], velocity[:2] * PERIOD_S, rtol=1e-4)
    physics = engine(name, OPEN, np.zeros((1, 1, 3)), velocity=np.array([[[MAX_SPEED_M_S, 0.0, 3.0]]]))
    for _ in range(5):
        physics.advance(np.zeros((1, 1, 2)))
    assert np.abs(physics.velocity).max() < 1e-4
    assert np.abs(physics.pose[0, 0, :2]).max() < 0.01


@every_engine
def test_opposite_wheels_spin_on_the_spot(name: str) -> None:
    poses = run(name, (-5.0, 5.0), [0.3, 0.1, 2.0], periods=20)
    # 2 x 0.1 m/s over an axle of 0.052 m: 3.846 rad/s counter-clockwise
    np.testing.assert_allclose(turned(poses[10:]), 0.2 / 0.052, rtol=SPEED_TOLERANCE[name])
    np.testing.assert_allclose(poses[:, :2], np.tile([0.3, 0.1], (21, 1)), atol=1e-9)


@every_engine
@pytest.mark.parametrize("sign", [1, -1], ids=["left", "right"])
def test_an_arc_ends_where_the_kinematics_say(name: str, sign: int) -> None:
    wheels = (3.0, 6.0) if sign > 0 else (6.0, 3.0)
    # (0.06 + 0.12) / 2 = 0.09 m/s and 0.06 / 0.052 = 1.1538 rad/s: a circle of radius 0.078 m, 2.3077 rad in 2 s
    spin = sign * 0.06 / 0.052
    poses = run(name, wheels, [0.1, -0.1, 0.0], 20, np.array([0.09, 0.0, spin]))
    angle = 2 * 0.06 / 0.052
    end = [0.1 + 0.078 * np.sin(angle), -0.1 + sign * 0.078 * (1 - np.cos(angle))]
    np.testing.assert_allclose(poses[-1, :2], end, atol=ARC_TOLERANCE_M[name])
    np.testing.assert_allclose(turned(poses), sign * angle, atol=1e-3)


@pytest.mark.parametrize("name", ["mujoco", "pymunk"])
def test_a_heavier_robot_drives_and_turns_as_any_other(name: str) -> None:
    """As much as there is more to move, the wheels press harder on the floor."""
    reached = []
    for mass in (1.0, 1.9):
        physics = engine(name, OPEN, np.zeros((1, 1, 3)), mass=np.full((1, 1), mass))
        physics.advance(np.array([[[3.0, 6.28]]]))
        reached.append(np.concatenate([physics.pose, physics.velocity], -1))
    np.testing.assert_allclose(reached[1], reached[0], rtol=1e-6)


@pytest.mark.parametrize("name", ["mujoco", "pymunk"])
def test_a_slippery_robot_gets_slowly_to_turn(name: str) -> None:
    physics = engine(name, OPEN, np.zeros((1, 1, 3)), friction=np.full((1, 1), 0.05))
    physics.advance(np.array([[[-6.28, 6.28]]]))
    # 0.05 x 9.81 m/s^2 at half an axle of 0.052 m, over 0.037^2 / 2 for a disc: 18.63 rad/s^2 for 0.1 s
    assert physics.velocity[0, 0, 2] == pytest.approx(0.05 * 9.81 * 0.026 / (0.037**2 / 2) * PERIOD_S, rel=1e-3)


@every_engine
def test_the_grip_of_a_slippery_robot_grows_with_its_weight_and_no_faster(name: str) -> None:
    speeds = []
    for mass in (1.0, 1.9):
        made = {"mass": np.full((1, 1), mass), "friction": np.full((1, 1), 0.05)}
        physics = engine(name, OPEN, np.zeros((1, 1, 3)), **made)
        physics.advance(np.full((1, 1, 2), 6.28))
        speeds.append(physics.velocity[0, 0, 0])
    assert 0.01 < speeds[0] < 0.9 * MAX_SPEED_M_S, "it slips"
    assert speeds[1] == pytest.approx(speeds[0], rel=0.05)


@every_engine
def test_robots_at_rest_stay_where_they_are(name: str) -> None:
    arena = Arena(2.0, 8, 2, 0.1)
    pose = np.concatenate([arena.posts(), np.linspace(-3, 3, 8)[:, None]], -1)[None]
    physics = engine(name, arena, pose)
    for _ in range(20):
        physics.advance(np.zeros((1, 8, 2)))
    np.testing.assert_allclose(physics.pose, pose, atol=1e-9)


@every_engine
def test_what_is_read_is_memory_of_its_own(name: str) -> None:
    physics = engine(name, OPEN, np.array([[[0.1, 0.2, 0.3]]]))
    physics.pose[:] = 9.0
    physics.velocity[:] = 9.0
    for array in physics.state_dict().values():
        array[...] = 9.0
    np.testing.assert_allclose(physics.pose, [[[0.1, 0.2, 0.3]]], atol=1e-15)
    assert np.abs(physics.velocity).max() == 0


def test_the_engines_are_imported_when_they_are_asked_for() -> None:
    code = "import sys, esp_envs.epuck.physics; print({'mujoco', 'pymunk'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}; {code}"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "set()"
