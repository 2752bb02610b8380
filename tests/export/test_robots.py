"""The controllers for e-pucks drive simulated ones: a mocked robot interface stands in front of MuJoCo."""

import importlib
import math
import shutil
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from esp_cli.export.export import export
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_environment
from esp_envs.epuck.engines import make_physics
from esp_envs.epuck.robot import MAX_WHEEL_SPEED, drive
from tests.export.policies import drawn_policy

STEPS = 40
BESIDE = ("policy", "esp_epuck", "epuck_webots", "epuck_ros2")
DOCS = Path(__file__).parents[2] / "docs"
pytestmark = pytest.mark.usefixtures("few_scenes")


class Team:
    """Robots and pillars in MuJoCo, as they stood in an environment, to be driven by wheel speeds."""

    def __init__(self, trained: TrainedPolicy) -> None:
        self.env = build_environment(trained.config, 1, "test")
        self.start = self.env.reset()
        settings = self.env.settings
        robots = (1, settings.num_agents)
        pose = np.concatenate([self.env._position, self.env._heading[..., None]], -1)
        self.pillars = self.env._pillars
        self.physics = make_physics(settings.physics, settings.arena, 1, settings.control_period_s)
        ones = np.ones(robots)
        self.physics.place(pose, np.zeros_like(pose), self.pillars, ones, ones)
        self.goals = self.env._goals[0]

    @property
    def poses(self) -> np.ndarray:
        return self.physics.pose[0]

    def drive(self, wheels: object) -> None:
        self.physics.advance(np.asarray(wheels, float)[None])


def imported(folder: Path, name: str, monkeypatch: pytest.MonkeyPatch, **fakes: ModuleType) -> ModuleType:
    """Import an exported file, or a driver of docs/ beside it, as its robot's machine would, with other modules."""
    for other, module in fakes.items():
        monkeypatch.setitem(sys.modules, other, module)
    for other in [known for known in sys.modules if known in BESIDE]:
        monkeypatch.delitem(sys.modules, other)
    for driver in DOCS.glob("epuck_*.py"):
        shutil.copy(driver, folder)
    monkeypatch.syspath_prepend(folder)
    return importlib.import_module(name)


def fake(**members: object) -> ModuleType:
    module = ModuleType("fake")
    for name, member in members.items():
        setattr(module, name, member)
    return module


@torch.no_grad()
def trained_paths(trained: TrainedPolicy, team: Team) -> np.ndarray:
    """Return where the policy itself drives in the environment from the team's start: [STEPS + 1, N, 3]."""
    env, observation = team.env, team.start
    memory = trained.policy.initial_memory(1, observation.obs)
    paths = [env.physics.pose[0]]
    for _ in range(STEPS):
        action, memory = trained.policy.act(observation.obs, memory)
        observation = env.step(action).next
        paths.append(env.physics.pose[0])
    return np.stack(paths)


SETTINGS = {
    "offset": {"kind": "wheels"},
    "nearness, three neighbours": {"kind": "wheels", "sight": "nearness", "neighbours": 3, "num_agents": 5},
    "wheel pairs": {"kind": "wheel pairs"},
}


def test_what_a_robot_cannot_see_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(drawn_policy("wheels"), ["numpy"], tmp_path)
    module = imported(tmp_path, "esp_epuck", monkeypatch)
    policy = importlib.import_module("policy")
    pilot = module.Pilot(policy.DESCRIPTION, policy.act)
    poses, goals = np.zeros((2, 3)), np.zeros((2, 2))
    with pytest.raises(ValueError, match="needs one; name its position"):
        pilot.observations(poses, goals)
    with pytest.raises(ValueError, match=r"should be \[N, 3\] and \[N, 2\]"):
        pilot.observations(poses, goals[:1])
    with pytest.raises(ValueError, match="sees 1 others, but there are 1 robots"):
        pilot.observations(poses[:1], goals[:1], [(0.5, 0.5)])


def node(name: str, pose) -> SimpleNamespace:
    """Return Webots' node of a body that stands where `pose` says."""

    def orientation() -> list[float]:
        c, s = math.cos(pose()[2]), math.sin(pose()[2])
        return [c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0]

    return SimpleNamespace(getDef=lambda: name, getPosition=lambda: [*pose()[:2], 0.0], getOrientation=orientation)


def motor(wheels: np.ndarray, side: int, most: float) -> SimpleNamespace:
    """Return Webots' wheel motor, which writes into the team's wheel speeds."""
    positions = [0.0]

    def turn(velocity: float) -> None:
        assert positions[-1] == math.inf, "a motor turns to a position, unless that is infinite"
        assert isinstance(velocity, float)
        wheels[side] = velocity

    return SimpleNamespace(setPosition=positions.append, setVelocity=turn, getMaxVelocity=lambda: most)


def robot(team: Team, own: int, wheels: np.ndarray, advance=None, most: float = MAX_WHEEL_SPEED) -> SimpleNamespace:
    """Return Webots' Supervisor of one e-puck; `advance` is called where the simulation goes on."""
    motors = {f"{name} wheel motor": motor(wheels[own], side, most) for side, name in enumerate(("left", "right"))}

    def named(name: str) -> SimpleNamespace | None:
        kind, index = name.rstrip("0123456789"), int(name.lstrip("ROBTPILA"))
        if kind == "ROBOT" and index < len(team.poses):
            return node(name, lambda: team.poses[index])
        if kind == "PILLAR" and index < len(team.pillars[0]):
            return node(name, lambda: (*team.pillars[0, index], 0.0))
        return None

    def step(milliseconds: int) -> int:
        assert milliseconds == 100
        return advance()

    return SimpleNamespace(
        getBasicTimeStep=lambda: 10.0,
        getSelf=lambda: named(f"ROBOT{own}"),
        getFromDef=named,
        getDevice=motors.__getitem__,
        step=step,
    )


@pytest.mark.parametrize("case", ["offset", "wheel pairs", "nearness, three neighbours"])
def test_the_webots_controller_drives_as_the_policy_does(case, tmp_path, monkeypatch):
    trained = drawn_policy(**SETTINGS[case])
    export(trained, ["numpy"], tmp_path)
    team = Team(trained)
    wheels, paths = np.zeros((len(team.poses), 2)), [team.poses]

    def advance() -> int:
        """Let the other robots act, drive all of them, and end the simulation after some steps."""
        for driver in others:
            driver.act()
        team.drive(wheels)
        paths.append(team.poses)
        return 0 if len(paths) <= STEPS else -1

    first = robot(team, 0, wheels, advance)
    module = imported(tmp_path, "epuck_webots", monkeypatch, controller=fake(Supervisor=lambda: first))
    pilot = module.Pilot(sys.modules["policy"].DESCRIPTION, sys.modules["policy"].act)
    # goals are opposite to the posts, from which the start is up to a centimetre away
    goals = [tuple(goal) for goal in team.goals]
    others = [module.Driver(robot(team, k, wheels), pilot, goals[k]) for k in range(1, len(team.poses))]
    monkeypatch.setattr(sys, "argv", ["epuck_webots.py", *map(str, goals[0])])
    module.main()
    assert len(paths) == STEPS + 1
    gap = np.abs(np.stack(paths)[..., :2] - trained_paths(trained, team)[..., :2]).max()
    moved = np.abs(paths[-1][:, :2] - paths[0][:, :2]).max()
    assert moved > 0.05
    assert gap < 1e-3, "in 4 s and up to half a metre the same way, but for float32"


def test_without_arguments_a_webots_robot_drives_to_the_opposite_of_its_start(tmp_path, monkeypatch):
    export(drawn_policy("wheels"), ["numpy"], tmp_path)
    team = SimpleNamespace(poses=np.array([[0.3, 0.2, 1.0], [0.9, -0.5, 2.0]]), pillars=np.zeros((1, 0, 2)))
    second = robot(team, 1, np.zeros((2, 2)), lambda: -1)
    module = imported(tmp_path, "epuck_webots", monkeypatch, controller=fake(Supervisor=lambda: second))
    asked = []

    def wheels(poses, goals, pillars) -> np.ndarray:
        asked.append(goals[1])
        return np.zeros((2, 2))

    monkeypatch.setattr(module, "Pilot", lambda *_: SimpleNamespace(control_period_s=0.1, wheels=wheels))
    for arguments in ([], ["0.5", "-0.3"]):
        monkeypatch.setattr(sys, "argv", ["epuck_webots.py", *arguments])
        module.main()
    assert asked == [(-0.9, 0.5), (0.5, -0.3)]


def test_no_motor_is_asked_for_more_than_it_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    export(drawn_policy("wheels"), ["numpy"], tmp_path)
    team, wheels = SimpleNamespace(poses=np.zeros((1, 3)), pillars=np.zeros((1, 0, 2))), np.zeros((1, 2))
    module = imported(tmp_path, "epuck_webots", monkeypatch, controller=fake(Supervisor=None))
    pilot = SimpleNamespace(wheels=lambda *_: np.array([[6.28, -5.0]]))
    module.Driver(robot(team, 0, wheels, most=4.0), pilot).act()
    assert wheels.tolist() == [[4.0, -4.0]]


def test_a_webots_world_that_does_not_fit_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = drawn_policy("wheels")
    export(trained, ["numpy"], tmp_path)
    team = Team(trained)
    odd = robot(team, 0, np.zeros((8, 2)))
    module = imported(tmp_path, "epuck_webots", monkeypatch, controller=fake(Supervisor=lambda: odd))
    odd.getBasicTimeStep = lambda: 32.0
    with pytest.raises(ValueError, match=r"basicTimeStep is 32\.0 ms; take a divisor of 100 ms"):
        module.main()
    odd.getSelf = lambda: node("EPUCK", lambda: (0, 0, 0))
    with pytest.raises(ValueError, match="this robot has the DEF name 'EPUCK'"):
        module.Driver(odd, None)


class RosNode:
    """rclpy's Node with a clock that the test sets, and publishers that remember."""

    now_s, parameters = 0.0, {}

    def __init__(self, name: str) -> None:
        self.name, self.published = name, {}

    def declare_parameter(self, name: str, default: list[float], descriptor: SimpleNamespace) -> SimpleNamespace:
        assert descriptor.dynamic_typing or default, "rclpy takes an empty list for bytes, and then refuses numbers"
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_subscription(self, kind, topic: str, callback, depth: int) -> None:
        assert (topic, depth) == ("poses", 1)
        self.callback = callback

    def create_timer(self, period_s: float, callback) -> None:
        assert period_s == 0.1
        self.tick = callback

    def create_publisher(self, kind, topic: str, depth: int) -> SimpleNamespace:
        def publish(message) -> None:
            self.published[topic] = message

        return SimpleNamespace(publish=publish)

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=int(self.now_s * 1e9)))

    def destroy_node(self) -> None:
        pass

    def speeds(self) -> list[list[float]]:
        """Return the wheel speeds that were last published, robot by robot."""
        return [message.data for topic, message in self.published.items() if topic.endswith("wheel_speeds")]


def ros_fakes(spin=None) -> dict[str, ModuleType]:
    def twist() -> SimpleNamespace:
        return SimpleNamespace(linear=SimpleNamespace(x=0.0), angular=SimpleNamespace(z=0.0))

    done = fake(init=lambda: None, spin=spin, try_shutdown=lambda: None)
    return {
        "rclpy": done,
        "rclpy.node": fake(Node=RosNode),
        "geometry_msgs": fake(),
        "geometry_msgs.msg": fake(PoseArray=SimpleNamespace, Twist=twist),
        "rcl_interfaces": fake(),
        "rcl_interfaces.msg": fake(ParameterDescriptor=SimpleNamespace),
        "std_msgs": fake(),
        "std_msgs.msg": fake(Float32MultiArray=SimpleNamespace),
    }


def ros_poses(poses: np.ndarray, stamp_s: int = 0) -> SimpleNamespace:
    def pose(x: float, y: float, heading: float) -> SimpleNamespace:
        turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(heading / 2), w=math.cos(heading / 2))
        return SimpleNamespace(position=SimpleNamespace(x=x, y=y), orientation=turn)

    header = SimpleNamespace(stamp=SimpleNamespace(sec=stamp_s, nanosec=0))
    return SimpleNamespace(header=header, poses=[pose(*row) for row in poses.tolist()])


def test_the_ros_node_drives_as_the_policy_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = drawn_policy("wheels")
    export(trained, ["numpy"], tmp_path)
    team, paths = Team(trained), []
    parameters = {"goals": team.goals.ravel().tolist(), "pillars": team.pillars.ravel().tolist()}
    monkeypatch.setattr(RosNode, "parameters", parameters)

    def spin(node: RosNode) -> None:
        """Be camera, clock and robots, then interrupt the node as Ctrl-C does."""
        node.tick()
        assert node.published == {}, "nobody moves before it is known where everybody is"
        for step in range(STEPS + 1):
            paths.append(team.poses)
            node.now_s = step * 0.1
            node.callback(ros_poses(team.poses))
            node.tick()
            team.drive(node.speeds())
            twist, wheels = node.published["epuck3/cmd_vel"], node.published["epuck3/wheel_speeds"].data
            speed, spin_rate = drive(np.array(wheels))
            assert (twist.linear.x, twist.angular.z) == pytest.approx((float(speed), float(spin_rate)))
        node.now_s += 0.6
        node.tick()
        assert node.speeds() == [[0.0, 0.0]] * 8, "nobody drives blind"
        node.now_s -= 0.6
        node.tick()
        assert node.speeds()[0] != [0.0, 0.0]
        lost = team.poses.copy()
        lost[3, 1] = math.nan
        node.callback(ros_poses(lost))
        node.tick()
        assert node.speeds() == [[0.0, 0.0]] * 8, "one robot is lost"
        node.callback(ros_poses(team.poses, stamp_s=5))
        node.tick()
        assert node.speeds()[0] != [0.0, 0.0]
        node.now_s += 0.6
        node.callback(ros_poses(team.poses, stamp_s=5))
        node.tick()
        assert node.speeds()[0] == [0.0, 0.0], "a tracker that repeats itself tells nothing"
        node.callback(ros_poses(team.poses, stamp_s=6))
        node.tick()
        assert node.speeds()[0] != [0.0, 0.0]
        for node.now_s, stamp_s, drives in ((67.0, 7, False), (67.0, 67, True)):
            node.callback(ros_poses(team.poses, stamp_s))
            node.tick()
            assert (node.speeds()[0] != [0.0, 0.0]) == drives, "poses are as old as their stamp says"
        nodes.append(node)
        raise KeyboardInterrupt

    nodes: list[RosNode] = []
    module = imported(tmp_path, "epuck_ros2", monkeypatch, **ros_fakes(spin))
    module.main()
    assert nodes[0].speeds() == [[0.0, 0.0]] * 8, "interrupted robots stand still"
    gap = np.abs(np.stack(paths)[..., :2] - trained_paths(trained, team)[..., :2]).max()
    assert gap < 1e-3


def test_a_ros_node_without_goals_takes_the_opposite_of_the_start(tmp_path, monkeypatch):
    export(drawn_policy("wheels"), ["numpy"], tmp_path)
    module = imported(tmp_path, "epuck_ros2", monkeypatch, **ros_fakes())
    driver = module.Driver()
    driver.see(ros_poses(np.array([[math.nan, -0.5, 1.0], [0.1, 0.2, -3.0]])))
    assert driver.goals == [], "a start that is not finite tells no goal"
    driver.see(ros_poses(np.array([[0.9, -0.5, 1.0], [0.1, 0.2, -3.0]])))
    assert driver.goals == [(-0.9, 0.5), (-0.1, -0.2)]
    assert driver.poses[1] == pytest.approx((0.1, 0.2, -3.0))
    odd = ros_poses(np.array([[0.9, -0.5, 1.0], [0.1, 0.2, -3.0]]))
    odd.poses[0].orientation.w *= 0.9  # of a tracker that rounds
    odd.poses[0].orientation.z *= 0.9
    odd.poses[1].orientation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)
    driver.see(odd)
    assert driver.poses[0] == pytest.approx((0.9, -0.5, 1.0))
    assert math.isnan(driver.poses[1][2]), "an orientation of zeros is none, and the team stands still"
    monkeypatch.setattr(RosNode, "parameters", {"goals": [1.0, 2.0, 3.0]})
    with pytest.raises(ValueError, match="the parameter goals lists x and y in turn, but has 3 numbers"):
        module.Driver()


def test_a_ros_node_stops_a_team_of_another_size_than_its_goals(tmp_path, monkeypatch):
    export(drawn_policy("wheels"), ["numpy"], tmp_path)
    monkeypatch.setattr(RosNode, "parameters", {"goals": [0.5, 0.0, -0.5, 0.0]})
    driver = imported(tmp_path, "epuck_ros2", monkeypatch, **ros_fakes()).Driver()
    driver.see(ros_poses(np.array([[0.9, -0.5, 1.0], [0.1, 0.2, -3.0], [0.0, 0.6, 0.0]])))
    driver.act()
    assert driver.speeds() == [[0.0, 0.0]] * 3
