"""Mirrors derived from models: by hand on small robots, and every planted mistake is found."""

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np
import pytest

from esp_cli import Body, layout
from esp_cli.bodies.deriving import derive
from esp_cli.bodies.frame import Frame
from esp_cli.bodies.numbers import map_of
from esp_cli.bodies.proof import Proof, prove
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError
from tests.bodies.models import BIPED_JOINTS, QUADRUPED, biped, legged

LEFT_RIGHT, FRONT_BACK = PlaneElement(mirrored=True), PlaneElement(Fraction(1, 2), mirrored=True)
GYMNASIUM = Path(pytest.importorskip("gymnasium").__file__).parent / "envs" / "mujoco" / "assets"


def body_of(text: str) -> Body:
    return Body.from_mjcf(mujoco.MjModel.from_xml_string(text))


def signed(body: Body, element: str) -> dict[str, str]:
    return {name: ("-" if sign < 0 else "") + image for name, image, sign, *_ in body.rows(element)}


def test_the_joints_of_a_biped_go_where_hand_work_says():
    body = body_of(biped())
    assert body.group == "flip-x"
    assert signed(body, "flip-x") == BIPED_JOINTS
    # actuators: the gears of the pitch motors differ in sign, and so do their joints: +1
    ctrl = body.found["flip-x"].match.ctrl
    assert ctrl.tolist() == [[-1, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, 0, 1], [0, 0, 0, 1, 0]]


def test_the_proof_of_a_biped_is_exact_and_would_have_seen_each_mistake():
    proof = body_of(biped()).found["flip-x"].proof
    assert proof.verdict == "exact"
    assert proof.gap < 1e-12
    assert proof.constraints < 1e-9
    assert proof.contacts is not None
    assert proof.contacts < 1e-5
    assert proof.planted.min() > 0.3


@pytest.mark.parametrize("joint", [j for j in BIPED_JOINTS if not j.startswith("right")])
def test_one_wrong_sign_is_broken(joint):
    frame = Frame(mujoco.MjModel.from_xml_string(biped()))
    match = derive(frame, LEFT_RIGHT)
    number = mujoco.mj_name2id(frame.model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    row_q, row_v = frame.model.jnt_qposadr[number], frame.model.jnt_dofadr[number]
    for part, row in (("qpos", row_q), ("qvel", row_v)):
        matrix = getattr(match, part).copy()
        matrix[row] *= -1
        assert prove(frame, replace(match, **{part: matrix})).verdict == "broken"


def test_a_wrong_pair_of_actuators_is_broken():
    frame = Frame(mujoco.MjModel.from_xml_string(biped()))
    match = derive(frame, LEFT_RIGHT)
    assert prove(frame, match).verdict == "exact"
    for wrong in (match.ctrl[[0, 3, 4, 1, 2]], match.ctrl * [1, -1, -1, 1, 1]):
        assert prove(frame, replace(match, ctrl=wrong)).verdict == "broken"


def test_an_asymmetric_joint_is_named_with_what_differs():
    text = biped().replace('name="right_knee" axis="0 1 0" range="0 120" damping="0.1"',
                           'name="right_knee" axis="0 1 0" range="0 120" damping="0.11"')  # fmt: skip
    body = body_of(text)
    rows = {name: difference for name, *_, difference in body.rows("flip-x")}
    assert rows["right_knee"].what == rows["left_knee"].what == "damping"
    assert rows["right_knee"].share == pytest.approx(1 / 11)
    assert rows["left_yaw"].what == ""
    told = {"mass", "middle of mass", "geometry", "inertia", "damping", "range", "gain", "force range", "axis"}
    assert told <= set(rows["left_knee"].shares)
    assert [what for what, share in rows["left_knee"].shares.items() if share > 1e-9] == ["damping"]
    assert body.found["flip-x"].proof.verdict == "nearly"


@pytest.mark.parametrize(
    ("shape", "share"),
    [('size="0.1 0.04 0.03" pos="0.03 0 0"', 0.05), ('size="0.1 0.04 0.02" pos="0.03 0 0.01"', 0.0185)],
)
def test_shapes_that_collide_are_compared_where_masses_are_alike(shape, share):
    inertia = '<inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>'
    foot = '<geom type="box" size="0.1 0.04 0.02" pos="0.03 0 0"/>'
    left, right = biped().replace(foot, inertia + foot).split('name="right_thigh"')
    body = body_of(f'{left}name="right_thigh"{right.replace(foot, foot.replace(foot[16:-2], shape))}')
    differ = {name: difference for name, *_, difference in body.rows("flip-x")}["left_yaw"]
    assert differ.what == "geometry"
    assert differ.share == pytest.approx(share, rel=0.01)


@pytest.mark.parametrize("how", ['friction="5"', 'contype="0" conaffinity="0"', 'solref="0.2 1"'])
def test_a_leg_that_touches_the_floor_otherwise_is_no_exact_mirror(how: str) -> None:
    before, shin, behind = QUADRUPED.partition('fromto="0 0 0 0.2 0 -0.05" size="0.02"')
    proof = body_of(f"{before}{shin} {how}{behind}").found["flip-x"].proof
    assert proof.verdict == "nearly"
    assert proof.contacts is not None
    assert proof.contacts < 1e-9, "of most states it is not seen"
    assert f"but in one state to {proof.worst:.2g}" in str(proof)


def test_a_robot_with_one_leg_moved_has_no_mirror():
    body = body_of(biped(right_y=-0.2))
    assert (body.group, body.found) == ("c1", {})
    assert body.refused["flip-x"].startswith("no joint is like the image of left_")


def test_a_heavy_backpack_on_one_side_is_refused_with_its_gap():
    body = body_of(biped(extra='<geom type="box" size="0.05 0.05 0.05" pos="0 0.2 0.2"/>'))
    assert body.group == "c1"
    assert "accelerations of" in body.refused["flip-x"]


def test_a_quadruped_has_both_mirrors_and_their_product():
    body = body_of(QUADRUPED)
    assert body.group == "d2"
    assert signed(body, "flip-x")["hip0"] == "-hip1"
    assert signed(body, "flip-x")["knee0"] == "knee1"
    assert signed(body, "flip-y")["hip0"] == "-hip2"
    # knees turn about the legs' own left, which a mirror sends to their own right, and reverses
    assert signed(body, "flip-y")["knee0"] == "knee2"
    assert signed(body, "rot180")["hip0"] == "hip3"


def around(count: int) -> Body:
    places = [(0.2 * math.cos(a), 0.2 * math.sin(a), math.degrees(a)) for a in np.arange(count) * 2 * math.pi / count]
    return body_of(legged(places))


@pytest.mark.parametrize("count", [3, 5, 6])
def test_legs_around_a_trunk_turn_by_their_angle(count):
    body = around(count)
    assert body.group == f"d{count}"
    assert signed(body, f"rot{Fraction(360, count)}")["knee1"] == "knee2"


def test_where_not_all_turns_are_tried_the_larger_group_stays():
    # ten legs have d10, of whose turns those by 1/2 and 1/5 are tried, and no product of the two
    assert around(10).group == "d5"


def test_gymnasiums_ant_turns_by_quarters():
    body = Body.from_mjcf(GYMNASIUM / "ant.xml")
    assert body.group == "d4"
    # the front ankles turn about (-1, 1, 0) and (1, 1, 0)
    assert signed(body, "rot90")["ankle_1"] == "-ankle_2"
    assert signed(body, "flip-x")["hip_1"] == "-hip_4"
    assert all(found.proof.verdict == "exact" for found in body.found.values())


def test_gymnasiums_humanoid_is_a_little_asymmetric_and_says_where():
    body = Body.from_mjcf(GYMNASIUM / "humanoid.xml")
    found = body.found["flip-x"]
    assert found.proof.verdict == "nearly"
    assert 0.01 < found.proof.gap < 0.05
    rows = {name: difference.what for name, *_, difference in body.rows("flip-x")}
    assert (rows["right_hip_y"], rows["right_knee"], rows["right_elbow"]) == ("armature", "stiffness", "")


def test_planar_robots_exchange_legs_that_lie_on_one_line():
    body = Body.from_mjcf(GYMNASIUM / "walker2d.xml")
    assert body.group == "flip-x"
    assert signed(body, "flip-x")["thigh_joint"] == "thigh_left_joint"
    assert Body.from_mjcf(GYMNASIUM / "half_cheetah.xml").group == "c1"
    assert signed(Body.from_mjcf(GYMNASIUM / "swimmer.xml"), "flip-x")["motor1_rot"] == "-motor1_rot"


_BALL_BASE = "".join(f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 0 1")) + '<joint type="ball"/>'


@pytest.mark.parametrize("turn", ["0 0 0", "0 0 90"])
def test_a_base_that_slides_and_turns_without_a_free_joint_sees_along_its_own_axes(turn):
    text = biped().replace('name="pelvis"', f'name="pelvis" euler="{turn}"')
    body = body_of(text.replace('<freejoint name="root"/>', _BALL_BASE))
    assert body.group == "flip-x"
    model = mujoco.MjModel.from_xml_string(text.replace('<freejoint name="root"/>', _BALL_BASE))
    match, data, qpos = body.found["flip-x"].match, mujoco.MjData(model), model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, np.random.default_rng(0).normal(size=model.nv), 1)

    def seen(q: np.ndarray) -> np.ndarray:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        return data.xmat[1].reshape(3, 3).T @ [0, 0, -1]

    told = map_of(layout(body.gravity()), LEFT_RIGHT) @ seen(qpos)
    np.testing.assert_allclose(told, seen(match.qpos @ qpos + match.offset), atol=1e-12)


@pytest.mark.parametrize("turn", ["0 0 0", "0 0 90", "0 0 40"])
def test_fields_are_what_the_simulator_says_the_body_sees(turn):
    text = biped().replace('name="pelvis"', f'name="pelvis" euler="{turn}"')
    model = mujoco.MjModel.from_xml_string(text)
    body = Body.from_mjcf(model)
    assert body.group == "flip-x"
    match, rng = body.found["flip-x"].match, np.random.default_rng(0)

    def seen(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        axes = data.xmat[1].reshape(3, 3)
        places = {name: k - 7 for k, name in enumerate(["root"] * 7 + list(body.joints))}
        order = [places[name] for name in body.joints]
        return np.concatenate([axes.T @ [0, 0, -1], axes.T @ qvel[:3], qvel[3:6], qpos[7:][order], qvel[6:][order]])

    qpos, qvel = rng.normal(size=model.nq), rng.normal(size=model.nv)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    told = layout(body.gravity(), body.velocity(), body.spin(), body.positions(), body.velocities())
    image = seen(match.qpos @ qpos + match.offset, match.qvel @ qvel)
    np.testing.assert_allclose(map_of(told, LEFT_RIGHT) @ seen(qpos, qvel), image, atol=1e-12)


def test_a_ball_joint_a_closed_loop_and_tendons_are_right():
    arms = """
    <body name="{0}" pos="0 {1} 0.3"><joint name="{0}_ball" type="ball" range="0 60"/>
      <geom type="capsule" fromto="0 0 0 0.1 {2} 0" size="0.02"/><site name="{0}_end" pos="0.1 {2} 0"/>
      <body pos="0.1 {2} 0"><joint name="{0}_elbow" axis="0 0 1"/><geom size="0.03" pos="0 {2} 0"/></body></body>"""
    text = biped(extra=arms.format("left_arm", 0.2, 0.1) + arms.format("right_arm", -0.2, -0.1)).replace(
        "</mujoco>",
        '<tendon><fixed name="t_l"><joint joint="left_arm_elbow" coef="2"/></fixed>'
        '<fixed name="t_r"><joint joint="right_arm_elbow" coef="2"/></fixed></tendon>'
        '<equality><connect body1="left_arm" body2="right_arm" anchor="0.1 -0.2 0"/></equality>'
        '<actuator><motor tendon="t_l"/><motor tendon="t_r"/></actuator></mujoco>',
    )
    body = body_of(text)
    found = body.found["flip-x"]
    assert found.proof.verdict == "exact"
    assert [row[1:3] for row in body.rows("flip-x") if row[0] == "left_arm_ball"] == [("right_arm_ball", 0)]
    # tendons of both elbows turn them about z, which the mirror reverses
    assert found.match.ctrl[5:, 5:].tolist() == [[0, -1], [-1, 0]]
    # a quaternion's axis (x, y, z) goes to (-x, y, -z)
    assert body.positions(["left_arm_ball", "right_arm_ball"]).kind.matrix(LEFT_RIGHT.matrix)[4:, :4].tolist() == [
        [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, -1]]  # fmt: skip


def test_a_site_that_pushes_is_refused_where_no_image_pushes():
    text = biped(extra='<site name="jet" pos="0.1 0.2 0"/>').replace(
        "</actuator>", '<motor name="thruster" site="jet" gear="0 0 1 0 0 0"/></actuator>'
    )
    assert body_of(text).refused["flip-x"] == "no image was found of the actuators thruster"


@pytest.mark.parametrize(
    ("own", "left", "right", "group"),
    [
        ('dyntype="filter" dynprm="0.1"', 'gainprm="10"', 'gainprm="10"', "flip-x"),
        ('dyntype="filter" dynprm="0.1"', 'gainprm="10"', 'gainprm="100"', "c1"),
        ('dyntype="filter"', 'dynprm="0.1"', 'dynprm="0.9"', "c1"),
        ('delay="0.01" nsample="6"', 'gainprm="10"', 'gainprm="10"', "flip-x"),
        ('delay="0.01" nsample="6"', 'gainprm="10"', 'gainprm="100"', "c1"),
        ('nsample="60"', 'delay="0.01"', 'delay="0.1"', "c1"),
    ],
)
def test_actuators_with_dynamics_or_a_delay_are_seen_to_act(own: str, left: str, right: str, group: str) -> None:
    pair = "".join(f'<general joint="{x}_roll" {own} {how}/>' for x, how in (("left", left), ("right", right)))
    assert body_of(biped().replace("</actuator>", f"{pair}</actuator>")).group == group


def test_actuators_of_several_controls_are_refused() -> None:
    pids = "".join(f'<pid joint="{x}_roll" kp="10" input="pos vel"/>' for x in ("left", "right"))
    with pytest.raises(UserError, match="actuators of no or several controls"):
        body_of(biped().replace("</actuator>", f"{pids}</actuator>"))


def test_unnamed_joints_are_numbered_and_accelerations_that_are_no_numbers_prove_nothing(monkeypatch):
    body = body_of(QUADRUPED.replace('name="hip0"', 'name="joint#3"').replace('joint="hip0"', 'joint="joint#3"'))
    assert "joint#3" in body.joints
    frame = Frame(mujoco.MjModel.from_xml_string(biped()))
    broken = replace(prove(frame, derive(frame, LEFT_RIGHT)), joints=np.full(10, np.nan))
    assert broken.verdict == "broken"
    monkeypatch.setattr("esp_cli.bodies.finding.prove", lambda frame, match: broken)
    assert body_of(biped()).group == "c1"


def test_a_ball_in_the_air_shows_no_mistake_and_so_no_mirror() -> None:
    ball = '<mujoco><worldbody><body name="ball"><freejoint/><geom size="{}"/></body></worldbody></mujoco>'
    body = body_of(ball.format("0.1"))
    assert not body.found
    assert body.refused["flip-x"] == "not covered: no mistake would show in accelerations"
    assert body_of(ball.format('0.1 0.2 0.3" type="box')).group == "d2", "the control: it tumbles"


def test_models_without_a_joint_are_refused():
    with pytest.raises(UserError, match="0 degrees of freedom"):
        body_of("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")


def test_a_search_ends_in_time_and_says_what_it_did_not_reach() -> None:
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()), seconds=0)
    assert not body.found
    assert set(body.refused.values()) == {"not covered: the 0 s for the search were over"}


def with_sensors(told: str, **how: str) -> Proof:
    text = biped(**how).replace("</mujoco>", f"<sensor>{told}</sensor></mujoco>")
    return body_of(text).found["flip-x"].proof


def test_sensors_that_have_their_images_are_judged_right() -> None:
    """A gyro in a foot that is turned by 40 degrees, too: some turn makes its readings those of its image."""
    site = '<site name="imu" pos="0.05 0 0.02" euler="0 40 0"/>'
    told = "".join(f'<jointpos joint="{x}_knee"/><actuatorfrc actuator="a_{x}_knee"/>' for x in ("left", "right"))
    told += '<subtreecom body="chest"/><subtreelinvel body="chest"/><gyro site="imu"/><accelerometer site="imu"/>'
    proof = with_sensors(told, extra=site)
    assert len(proof.sensors) == 8
    assert max(proof.sensors.values()) < 1e-6
    assert (proof.verdict, proof.broken_sensors, proof.unjudged) == ("exact", [], ())
    assert "sensors to" in str(proof)
    assert not body_of(biped()).found["flip-x"].proof.sensors


@pytest.mark.parametrize(
    ("told", "site", "broken"),
    [
        ('<jointpos name="knee" joint="left_knee"/>', "", "knee"),  # and none at its image
        ('<gyro name="fine" site="imu"/><accelerometer name="aside" site="imu"/>', "0 0.1 0.1", "aside"),
        ('<rangefinder name="ray" site="imu"/><rangefinder name="other" site="imu"/>', "0 0.3 0.2", "ray"),
    ],
)
def test_a_sensor_that_breaks_the_mirror_is_in_the_verdict(told: str, site: str, broken: str) -> None:
    proof = with_sensors(told, extra=f'<site name="imu" pos="{site}" euler="150 0 0"/>' if site else "")
    assert proof.verdict == "broken sensors"
    assert broken in proof.broken_sensors
    assert "fine" not in proof.broken_sensors
    assert proof.gap < 1e-9, "the joints are right"


def test_sensors_without_a_known_mirror_are_reported() -> None:
    told = '<user name="own" dim="1" needstage="acc" objtype="body" objname="chest"/><framequat objtype="body" '
    proof = with_sensors(told + 'objname="chest"/><touch site="imu"/>', extra='<site name="imu"/>')
    assert (proof.verdict, proof.sensors, proof.unjudged) == ("exact", {}, ("framequat", "touch", "user"))


def test_servos_that_stand_in_another_order_on_each_side_have_their_images():
    servo = '<{kind} name="{side}-{kind}" joint="{side}" k{letter}="9"/>'
    arm = (
        '<body pos="0 {y} 0"><joint name="{side}" axis="0 1 0"/>'
        '<geom type="capsule" size="0.03" fromto="0 0 0 0.3 0 -0.1"/></body>'
    )
    servos = [
        ("left", "position", "p"),
        ("left", "velocity", "v"),
        ("right", "velocity", "v"),
        ("right", "position", "p"),
    ]
    body = body_of(
        '<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom type="box" size="0.2 0.1 0.05"/>'
        + "".join(arm.format(side=side, y=y) for side, y in (("left", 0.15), ("right", -0.15)))
        + "</body></worldbody><actuator>"
        + "".join(servo.format(side=side, kind=kind, letter=letter) for side, kind, letter in servos)
        + "</actuator></mujoco>"
    )
    assert body.group == "flip-x"
    assert body.found["flip-x"].match.ctrl.tolist() == [[0, 0, 0, 1], [0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0]]


def test_what_may_touch_on_one_side_alone_is_not_exact():
    def excluding(*sides: str) -> Proof:
        pairs = "".join(f'<exclude body1="chest" body2="{side}_foot"/>' for side in sides)
        text = biped().replace("<actuator>", f"<contact>{pairs}</contact><actuator>")
        return body_of(text).found["flip-x"].proof

    assert (excluding("left", "right").unlike, excluding("left", "right").verdict) == ((), "exact")
    # the right foot may touch the chest, and its image, the left foot, may not
    assert excluding("left").unlike == ("contact of chest and right_foot",)
    assert excluding("left").verdict == "nearly"


def test_a_shape_that_may_not_touch_what_its_image_touches_is_not_exact():
    def heels(right: str) -> Proof:
        text, heel = biped(), '<geom type="sphere" size=".01" pos="-0.08 0 -0.03" mass="0" {}/></body>'
        for side, masks in (("left", 'contype="2" conaffinity="1"'), ("right", right)):
            at = text.index("</body>", text.index(f'name="{side}_foot"'))
            text = text[:at] + heel.format(masks) + text[at + len("</body>") :]
        return body_of(text).found["flip-x"].proof

    assert heels('contype="2" conaffinity="1"').unlike == ()
    # of either mask it may touch the other leg; the floor has the mask 1
    assert "contact of world and left_foot" in heels('contype="2" conaffinity="2"').unlike


_LIMITS = {
    "force range of left_knee": ('<motor name="a_left_knee" ', '<motor name="a_left_knee" forcerange="-9 9" '),
    "torque range of left_knee": ('<joint name="left_knee" ', '<joint name="left_knee" actuatorfrcrange="-9 9" '),
    "control range of left_knee": ('<motor name="a_left_knee" ', '<motor name="a_left_knee" ctrlrange="-9 9" '),
    "stops of left_knee": ('<joint name="left_knee" ', '<joint name="left_knee" solreflimit="0.1 1" '),
}


@pytest.mark.parametrize("what", _LIMITS)
def test_a_limit_of_one_side_that_no_state_reaches_is_not_exact(what):
    proof = body_of(biped().replace(*_LIMITS[what])).found["flip-x"].proof
    assert (proof.verdict, proof.unlike) == ("nearly", (what, what.replace("left", "right")))


def test_a_wall_beside_a_robot_that_is_fixed_is_not_exact():
    arms = biped().replace('<freejoint name="root"/>', "").replace('<geom type="plane" size="5 5 1"/>', "{}")
    assert body_of(arms.format("")).found["flip-x"].proof.verdict == "exact"
    wall = '<geom type="box" size="1 0.01 1" pos="0 0.3 0.5"/>'
    assert body_of(arms.format(wall)).found["flip-x"].proof.verdict == "nearly"


def test_meshes_touch_with_their_hulls_however_they_are_meshed():
    def hands(right: str) -> Proof:
        half = {"big": (0.06, 0.04, 0.02), "small": (0.03, 0.04, 0.02)}
        corners = {k: [(x, y, z) for x in (-a, a) for y in (-b, b) for z in (-c, c)] for k, (a, b, c) in half.items()}
        corners["more"] = [*corners["big"], (0.06, 0, 0), (0.06, 0.01, 0.01), (0, 0, 0.02)]  # on its faces
        assets = "".join(
            f'<mesh name="{k}" vertex="{" ".join(str(x) for p in own for x in p)}"/>' for k, own in corners.items()
        )
        text = biped().replace("<worldbody>", f"<asset>{assets}</asset><worldbody>", 1)
        text = text.replace('<geom type="plane" size="5 5 1"/>', "").replace('<freejoint name="root"/>', "")
        for side, y, mesh in (("left", 1, "big"), ("right", -1, right)):
            hand = f'<geom type="mesh" mesh="{mesh}" pos="0 {0.3 * y} 0.1" mass="0.1"/><body name="{side}_thigh"'
            text = text.replace(f'<body name="{side}_thigh"', hand)
        return (
            body_of(text.replace("</worldbody>", '<geom size="0.1" pos="0 0 1.1"/></worldbody>')).found["flip-x"].proof
        )

    assert not any("shape" in what for what in hands("big").unlike + hands("more").unlike)
    assert any(what.startswith("shape of geom") for what in hands("small").unlike)


def test_a_turn_that_limits_forbid_is_refused():
    # Front and back hips and knees alike: accelerations are those of d2, but knees bend backward alone.
    place = [(0.2, 0.1, 0), (0.2, -0.1, 0), (-0.2, 0.1, 0), (-0.2, -0.1, 0)]
    body = body_of(legged(place).replace("0.2 0 0", "0 0 -0.2").replace("0.2 0 -0.05", "0 0 -0.2"))
    assert body.group == "flip-x"
    assert body.refused["flip-y"].startswith("with limits, friction and equalities accelerations differ by ")


def test_two_motors_that_pull_a_joint_opposite_ways_change_places():
    turret = (
        '<mujoco><worldbody><body pos="0 0 1"><joint name="yaw" axis="0 0 1" damping="1"/>'
        '<geom type="capsule" size="0.05" fromto="0 0 0 0.4 0 0"/></body></worldbody><actuator>'
        '<motor name="left" joint="yaw" gear="2" ctrlrange="0 1"/>'
        '<motor name="right" joint="yaw" gear="-2" ctrlrange="0 1"/></actuator></mujoco>'
    )
    assert body_of(turret).found["flip-x"].match.ctrl.tolist() == [[0, 1], [1, 0]]


@pytest.mark.parametrize("mass", [0.1, 500])
def test_of_two_free_bodies_the_one_with_joints_is_the_base(mass):
    box = f'<body pos="1 0 0.1" euler="0 0 90"><freejoint/><geom size="0.05" mass="{mass}"/></body><body name="pelvis"'
    frame = Frame(mujoco.MjModel.from_xml_string(biped().replace('<body name="pelvis"', box)))
    assert frame.name("joint", frame.base or 0) == "root"


def test_a_base_that_is_turned_at_rest_has_no_attitude_and_shifted_joints_no_state():
    turned = body_of(
        biped().replace('<body name="pelvis" pos="0 0 1">', '<body name="pelvis" pos="0 0 1" euler="0 0 90">')
    )
    assert layout(turned.velocity(), turned.gravity())
    with pytest.raises(UserError, match="the base is turned at rest, so attitudes do not follow"):
        turned.attitude()
    shifted = body_of(biped().replace('_roll" axis="1 0 0"', '_roll" axis="1 0 0" ref="10"'))
    with pytest.raises(UserError, match="left_roll has a reference that is not its image's"):
        shifted.state()
    with pytest.raises(UserError, match="has no joints; name some"):
        shifted.positions([])
