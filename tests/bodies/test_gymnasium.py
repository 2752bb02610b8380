"""Tasks of Gymnasium and MaMuJoCo: what their models say, by hand, and a wrong sign that paired states refuse."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from esp_cli import Body, Symmetry
from esp_cli.bodies import gymnasium as robots
from esp_cli.bodies.kinds import INERTIA, PartsKind
from esp_cli.bodies.numbers import map_of
from esp_cli.bodies.showing import layouts_of
from esp_cli.checking import check_symmetry
from esp_cli.checking.stepping import visit
from esp_cli.symmetry.plane import KIND_MATRICES, PlaneElement
from esp_cli.training.config import resolve_config
from esp_envs import generators_for, make, task_class
from esp_envs.errors import UserError
from esp_envs.spec import Continuous, Layout
from tests.bodies.models import biped
from tests.cli.running import esp

gymnasium = pytest.importorskip("gymnasium")
FLIP_X, FLIP_Y = PlaneElement(mirrored=True), PlaneElement("1/2", mirrored=True)


def made(cls, worlds=1):
    return cls(cls.Settings(workers=0), worlds, generators_for([0]))


def test_ants_mirror_exchanges_the_legs_on_its_sides():
    """Legs 1 and 4 stand at y = 0.2 and -0.2, 2 and 3 too. Hips turn about z: -1. Ankle axes (-1, 1), (1, 1): +1."""
    env = made(robots.Ant)
    names = {"place": 1, "attitude": 4, "positions": 8, "velocity": 3, "spin": 3, "velocities": 8, "cfrc_ext": 78}
    assert {f.name: f.width for f in env.observation.fields} == names
    assert env.symmetry == "flip-x"
    state = np.arange(1.0, 106)
    image = map_of(env.observation, FLIP_X) @ state
    base, joints, rates = image[:5], image[5:13], image[13:27]
    assert base.tolist() == [1, 2, -3, 4, -5]
    assert joints.tolist() == [-12, 13, -10, 11, -8, 9, -6, 7]
    assert rates[:6].tolist() == [14, -15, 16, -17, 18, -19]
    torso = image[27:33]  # of 13 bodies, each torque, then force
    assert torso.tolist() == [-28, 29, -30, 31, -32, 33]
    leg, far = image[33:51], np.arange(88.0, 106)  # three bodies of the first leg come from the last
    assert leg.tolist() == (far * np.tile([-1, 1, -1, 1, -1, 1], 3)).tolist()


@pytest.mark.parametrize(
    ("name", "symmetry", "width"),
    [("halfcheetah", "c1", 17), ("walker2d", "flip-x", 17), ("humanoid", "c1", 348), ("swimmer", "flip-x", 8)],
)
def test_what_holds_of_the_others(name, symmetry, width):
    env = make(name, 1, [0], {"workers": 0})
    assert (env.spec.symmetry, env.spec.observation.width, env.spec.horizon) == (symmetry, width, 1000)
    assert env.spec.nearly == ("flip-x" if name == "humanoid" else "")


def test_a_model_that_is_nearly_its_image_declares_nothing():
    class Standup(robots.MujocoTask):
        scenario, convention = "HumanoidStandup-v5", "gymnasium HumanoidStandup-v5"

    assert (made(Standup).spec.symmetry, made(Standup).spec.nearly) == ("c1", "flip-x")


def test_agents_of_unlike_numbers_are_refused_in_a_sentence():
    pytest.importorskip("gymnasium_robotics")

    class Halves(robots.MujocoTeam):
        scenario, parts, convention, terminates = "Humanoid", "9|8", "mamujoco_v1 Humanoid 9|8", True

    with pytest.raises(UserError, match="agents see or do unlike numbers; give all as many"):
        made(Halves)


@pytest.mark.parametrize("name", ["halfcheetah", "halfcheetah2x3"])
def test_where_nothing_holds_the_default_is_no_prior(name):
    pytest.importorskip("gymnasium_robotics")
    plain = resolve_config(name)
    assert plain.prior.kind == "none"
    assert plain.command().endswith(" --prior none")
    assert resolve_config(name, overrides={"prior.kind": "none"}) == plain
    assert resolve_config(name, overrides={"prior.kind": "esp"}).prior.kind == "esp"
    said = esp("train", "--task", name, "--print-config").stderr
    assert f"{name} declares no symmetry, so there is no prior; --prior auto weighs what holds" in said
    assert "no prior" not in esp("train", "--task", name, "--prior", "none", "--print-config").stderr


def test_walkers_mirror_exchanges_legs_and_swimmers_bends_the_other_way():
    walker, swimmer = made(robots.Walker2d), made(robots.Swimmer)
    assert (map_of(walker.observation, FLIP_X) @ np.arange(8 + 9))[:8].tolist() == [0, 1, 5, 6, 7, 2, 3, 4]
    # angles, then velocities of x, y and the angles
    assert (map_of(swimmer.observation, FLIP_X) @ np.arange(1.0, 9)).tolist() == [-1, -2, -3, 4, -5, -6, -7, -8]


def test_inertia_of_a_mirrored_body():
    """A mirror in y changes the signs of xy and yz, and of y."""
    signs = [1, 1, 1, -1, 1, -1, 1, -1, 1, 1]
    np.testing.assert_allclose(KIND_MATRICES[INERTIA](FLIP_X.matrix), np.diag(signs), atol=1e-12)
    quarter = KIND_MATRICES[INERTIA](np.array([[0.0, -1], [1, 0]]))  # x becomes y, y becomes -x
    np.testing.assert_allclose(quarter @ np.arange(1.0, 11), [2, 1, 3, -4, -6, 5, -8, 7, 9, 10], atol=1e-12)


def reached(env, state, action):
    env.set_state(state[None])
    step = env.step(action)
    return step.final.obs[0, :, 0], step.reward[0, :, 0]


def flipped(layout, name, row):
    fields = []
    for field in layout.fields:
        if field.name == name:
            moves = [(g, np.array(rows)) for g, rows in field.kind.moves]
            for g, matrix in moves:
                matrix[row] *= -1 if g == FLIP_X else 1
            rows = tuple((g, tuple(map(tuple, matrix.tolist()))) for g, matrix in moves)
            fields.append(replace(field, kind=replace(field.kind, moves=rows)))
        else:
            fields.append(field)
    return Layout(tuple(fields))


def test_paired_states_tell_the_mirror_from_another_and_from_a_wrong_sign():
    env = made(robots.Ant, 6)
    assert env.settable()
    start = env.reset()
    for _ in range(5):
        start = env.step(env.random_action()).next
    state, action = start.state[0], env.random_action()
    seen, reward = reached(env, state, action)
    wrong = flipped(env.observation, "positions", 1)
    for layout, group, pays, sees in (
        (env.observation, "flip-x", True, True),
        (env.observation, "flip-y", False, True),
        (wrong, "flip-x", True, False),
    ):
        kinds = {"observation": layout, "action": env.action, "state": env.simulated}
        (g,) = Symmetry(**kinds, group=group, copies="all").transforms(seen)
        image, paid = reached(env, g.state(state), g.action(action[0, :, 0])[None, :, None])
        assert torch.allclose(image, g.obs(seen), atol=1e-3, rtol=1e-3) == sees
        assert torch.allclose(paid, reward, atol=1e-3) == pays


def test_a_team_exchanges_agents_in_the_order_that_the_model_says():
    pytest.importorskip("gymnasium_robotics")
    env, alone = made(robots.Ant4x2), made(robots.HalfCheetah2x3)
    assert (env.symmetry, alone.symmetry) == ("flip-x*agents-3-2-1-0", "c1")
    assert (map_of(env.action.layout, FLIP_X) @ [1.0, 2]).tolist() == [-1, 2]  # hip, ankle
    seen = {f.name: f for f in env.observation.fields}
    assert np.array(seen["positions_3"].kind.moves[0][1]).tolist() == [[0, 0, -1], [0, -1, 0], [-1, 0, 0]]  # hips
    assert env.settable()
    here = env.reset().state
    assert here.shape == (1, 1, 29)
    there = env.set_state(here + 0.01)
    assert torch.allclose(there.state, here + 0.01, atol=1e-6)
    assert there.obs.shape == (1, 1, 4, env.observation.width)


class Limping(robots.Walker2d):
    """Pays for one leg, so that the mirror that it declares is wrong."""

    def make_single(self):
        env = super().make_single()
        return gymnasium.wrappers.TransformReward(env, lambda paid: paid + 0.1 * env.unwrapped.data.qvel[6])


class LimpingTeam(robots.Ant4x2):
    """The same of a team."""

    def make_one(self):
        env = super().make_one()
        plain = env.step

        def step(actions):
            seen, paid, *rest = plain(actions)
            return seen, {agent: reward + 0.1 * env.data.qvel[6] for agent, reward in paid.items()}, *rest

        env.step = step
        return env


@pytest.mark.parametrize(
    ("sound", "wrong", "element"),
    [(robots.Walker2d, Limping, "flip-x"), (robots.Ant4x2, LimpingTeam, "flip-x*agents-3-2-1-0")],
)
def test_a_check_finds_what_is_declared_and_refutes_what_is_wrong(sound, wrong, element):
    pytest.importorskip("gymnasium_robotics")
    reports = []
    for cls in (sound, wrong):
        settings = cls.Settings(workers=0, horizon=60)  # in which some fall
        reports.append(check_symmetry(lambda n, seeds: cls(settings, n, generators_for(seeds)), element))  # noqa: B023
    assert [(report.broken, report.uncovered) for report in reports] == [((), ()), ((element,), ())]
    assert {field.field for field in reports[1].elements[0].fields if field.outcome == "broken"} == {"reward"}


def test_a_slow_simulator_is_looked_at_early():
    env, taken = made(robots.Swimmer), []
    visit(env, lambda t, *_: taken.append(t), math.inf, early=True)
    assert taken[-1] == 422, "1000 ** (7 / 8) - 1, and the step from there"


def test_states_of_bodies():
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()))
    assert [(f.name, f.width) for f in body.state().fields] == [
        ("place", 3), ("attitude", 4), ("positions", 9), ("velocity", 3), ("spin", 3), ("velocities", 9)
    ]  # fmt: skip
    with pytest.raises(UserError, match="given by names has no state"):
        Body(["hip"], {"hip": "-hip"}).state()


def test_what_is_none_of_the_simulators_numbers_is_refused():
    model = mujoco.MjModel.from_xml_string(biped())
    body, data = Body.from_mjcf(model), mujoco.MjData(model)
    found = layouts_of(body, data, lambda: [data.qvel[[8, 6]].copy()])
    assert found.observation.fields[0].kind.parts == ("left_pitch", "waist")
    assert found.orders == {}, "the image of left_pitch is not shown"
    assert isinstance(found.action, Continuous)
    assert isinstance(found.action.layout.fields[0].kind, PartsKind)
    with pytest.raises(UserError, match="number 1 of the observation is none of the simulator's qpos, qvel"):
        layouts_of(body, data, lambda: [[data.qpos[0], 2.0]])
    with pytest.raises(UserError, match="unlike numbers"):
        layouts_of(body, data, lambda: [data.qpos[:3], data.qpos[:2]], [[0], [1]])


def test_a_missing_package_is_one_sentence(monkeypatch):
    def gone(name):
        raise ImportError("gone", name=name)

    assert task_class("ant4x2") is robots.Ant4x2
    monkeypatch.setattr(robots, "import_module", gone)
    monkeypatch.setattr(robots._OfModel, "_known", {})
    with pytest.raises(UserError, match=r"needs a package that is missing \(gymnasium\): pip install"):
        make("ant", 1, [0])


def test_a_robot_is_drawn():
    env = made(robots.Ant)
    env.reset()
    try:
        picture = env.scene().picture
    except UserError as error:
        pytest.skip(str(error))
    assert picture.shape == (480, 480, 3)
    assert picture.std() > 10
