"""Asymmetries that few states of a robot show, or none: each is found, and robots without it stay exact."""

import mujoco
import numpy as np
import pytest

from esp_cli import Body
from esp_cli.bodies.deriving import derive
from esp_cli.bodies.frame import Frame
from esp_cli.bodies.proof import Proof, _gaps
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.errors import UserError
from tests.bodies.models import biped

FOOT, FREE, FLOOR = 'pos="0.03 0 0"', '<freejoint name="root"/>', '<geom type="plane" size="5 5 1"/>'


def body_of(text: str) -> Body:
    return Body.from_mjcf(mujoco.MjModel.from_xml_string(text))


def proof_of(text: str) -> Proof:
    return body_of(text).found["flip-x"].proof


def changed(old: str, new: str, text: str | None = None) -> str:
    """Return a model, by default the biped, with its first `old`, which is on the left, replaced."""
    text = text or biped()
    assert old in text
    return text.replace(old, new, 1)


def test_switches_are_compared_as_numbers():
    motor = '<general joint="{0}_roll" dyntype="integrator" actrange="-1 1" actearly="true"/>'
    text = changed("</actuator>", motor.format("left") + motor.format("right") + "</actuator>")
    assert proof_of(text).verdict == "exact"
    early = "early activation of left_roll", "early activation of right_roll"
    assert proof_of(changed(' actearly="true"', "", text)).unlike == early


def drone(spins: tuple[int, ...]) -> str:
    """Return four rotors, front left to back right, that turn the drone slowly about z against their own spin."""
    places = (0.14, 0.18), (0.14, -0.18), (-0.14, 0.18), (-0.14, -0.18)
    sites = "".join(f'<site name="s{i}" pos="{x} {y} 0"/>' for i, (x, y) in enumerate(places))
    rotors = "".join(f'<motor site="s{i}" gear="0 0 1 0 0 {0.006 * s}"/>' for i, s in enumerate(spins))
    return (
        '<mujoco><worldbody><body><freejoint/><inertial pos="0 0 0" mass="1.3" diaginertia=".0365 .0293 .0535"/>'
        f"{sites}</body></worldbody><actuator>{rotors}</actuator></mujoco>"
    )


@pytest.mark.parametrize(("spins", "group"), [((1, -1, -1, 1), "d2"), ((1, 1, -1, -1), "flip-y"), ((1,) * 4, "c2")])
def test_a_wrong_yaw_does_not_drown_in_lift_and_roll(spins, group):
    assert body_of(drone(spins)).group == group


@pytest.mark.parametrize(("dof", "size", "gap"), [(0, 0.1, 0.01), (2, 0.1, 0.01), (3, 0.6, 0.1), (5, 0.1, 0.05)])
def test_a_free_base_is_judged_beside_gravity_beside_its_tumbling_and_beside_its_yaw(dof, size, gap):
    frame = Frame(mujoco.MjModel.from_xml_string(biped()), 100)
    match = derive(frame, PlaneElement(mirrored=True))
    here = np.ones((1, frame.model.nv))
    here[0, :6] = 0, 0, -10, 6, 0, 2  # falls and tumbles: a share of 10, 6 or 2
    there = here @ match.qvel.T
    there[0, dof] += size
    assert _gaps(frame, match, here, there)[0][0] == pytest.approx(gap)


@pytest.mark.parametrize("floor", [FLOOR, '<geom type="box" size="9 9 0.01"/>'])
def test_a_robot_that_begins_high_is_lowered_to_the_floor(floor):
    proof = proof_of(changed('pos="0 0 1"', 'pos="0 0 30"').replace(FLOOR, floor))
    assert proof.contacts is not None
    assert (proof.verdict, proof.contacts < 1e-9) == ("exact", True)


def test_contacts_that_no_state_has_are_not_covered():
    text = changed("<worldbody>", '<worldbody><geom size="0.1" pos="9 0 0"/>').replace(FLOOR, "")
    assert proof_of(text).unlike == ("contacts with the world (not covered: no state has any)",)


def test_heights_of_a_field_are_not_covered():
    field = '<asset><hfield name="hills" nrow="2" ncol="2" elevation="0 1 2 0" size="5 5 1 1"/></asset>'
    text = changed(FLOOR, '<geom name="ground" type="hfield" hfield="hills"/>').replace(
        "<worldbody>", f"{field}<worldbody>"
    )
    unlike = ["shape of ground (not covered: of a height field its box alone is)"]
    assert [what for what in proof_of(text).unlike if "ground" in what] == unlike


def test_equalities_that_are_switched_off_are_not_covered():
    text = changed("</mujoco>", '<equality><weld name="dock" body1="pelvis" active="false"/></equality></mujoco>')
    assert proof_of(text).unlike == ("dock (not covered: it is switched off)",)


HOW = {
    'friction="2 0.1 0.1"': "friction",
    'solref="0.1 1"': "solref",
    'solimp="0.8 0.9 0.01"': "solimp",
    'margin="0.1"': "margin",
    'condim="1"': "condim",
    'priority="1"': "priority",
    'mass="1" euler="0 0 20"': "shape",
}


@pytest.mark.parametrize("how", HOW)
def test_a_foot_of_a_robot_held_in_the_air_touches_as_its_image_does(how):
    text = biped().replace(FREE, "").replace('pos="0 0 1"', 'pos="0 0 3"').replace(FOOT, f'{FOOT} mass="1"')
    assert proof_of(text).verdict == "exact"
    own = how if "mass" in how else f'mass="1" {how}'
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><geom type="box" size="0.1 0.04 0.02"'
    text = text.replace('<geom type="box" size="0.1 0.04 0.02"', inertial)
    proof = proof_of(changed(f'{FOOT} mass="1"', f"{FOOT} {own}", text))
    assert proof.unlike == (f"{HOW[how]} of geom#5 of left_foot", f"{HOW[how]} of geom#8 of right_foot")
    assert proof.verdict == "nearly"


def test_pairs_of_contacts_are_compared():
    text = changed(FOOT, f'{FOOT} name="left"').replace(f"{FOOT}/>", f'{FOOT} name="right"/>')
    text = changed(FLOOR, FLOOR.replace("<geom", '<geom name="floor"'), text)
    pair = '<pair geom1="{}" geom2="floor" condim="{}"/>'
    told = "<contact>{}</contact><actuator>"
    alike = changed("<actuator>", told.format(pair.format("left", 3) + pair.format("right", 3)), text)
    assert proof_of(alike).verdict == "exact"
    assert proof_of(changed('condim="3"', 'condim="4"', alike)).unlike == (
        "contact pair of floor and left",
        "contact pair of floor and right",
    )
    alone = proof_of(changed("<actuator>", told.format(pair.format("left", 3)), text))
    assert alone.unlike == ("contact pair of floor and left",)


@pytest.mark.parametrize("free", [FREE, ""])
def test_a_wall_has_its_image_about_the_base(free):
    wall = '<geom name="{}" type="box" size="3 0.1 2" pos="0 {} 0"/>'
    text = biped().replace(FREE, free)
    one = changed(FLOOR, FLOOR + wall.format("left", 4), text)
    assert proof_of(one).unlike == ("shape of left",)
    assert proof_of(changed(FLOOR, FLOOR + wall.format("right", -4), one)).verdict == "exact"


TENDONS = "".join(f'<fixed name="t_{x}"><joint joint="{x}_roll" coef="1"/></fixed>' for x in ("left", "right"))
PULLS = '<position name="p_{0}" tendon="t_{0}" kp="9"/><motor name="m_{0}" jointinparent="{0}_roll"/>'
ARM = """<body name="{0}_arm" pos="0 {1} 0.3"><joint name="{0}_ball" type="ball" range="0 180"/>
  <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.02"/><site name="{0}_end"/></body>"""
SENSORS = "".join(f'<accelerometer name="s_{x}" site="{x}_end"/>' for x in ("left", "right"))


def pulled() -> str:
    """Return a biped with ball joints, tendons, actuators at both, and sensors."""
    text = biped(extra=ARM.format("left", 0.3) + ARM.format("right", -0.3))
    text = text.replace("</actuator>", PULLS.format("left") + PULLS.format("right") + "</actuator>")
    return text.replace("</mujoco>", f"<tendon>{TENDONS}</tendon><sensor>{SENSORS}</sensor></mujoco>")


@pytest.mark.parametrize(
    ("part", "how", "what"),
    [
        ('name="left_ball"', 'solreflimit="0.1 1"', "stops of left_ball"),
        ('type="ball"', 'limited="false"', "range of left_ball"),
        ('name="left_knee"', 'springyield="50"', "springyield of left_knee"),
        ('name="p_left"', 'forcerange="-99 99"', "force range of p_left"),
        ('name="p_left"', 'ctrlrange="-2 2"', "control range of p_left"),
        ('name="m_left"', 'forcerange="-99 99"', "force range of left_roll"),
        ('name="t_left"', 'range="-9 9"', "limits or spring of t_left"),
        ('name="t_left"', 'actuatorfrcrange="-99 99"', "limits or spring of t_left"),
        ('name="t_left"', 'stiffness="1" springlength="-9 9"', "limits or spring of t_left"),
        ('name="t_left"', 'springyield="5"', "limits or spring of t_left"),
        ('name="s_left"', 'interval="0.1"', "interval of s_left"),
        ('name="s_left"', 'noise="1"', "noise of s_left"),
        ('name="s_left"', 'cutoff="500"', "cutoff of s_left"),
    ],
)
def test_what_only_some_states_or_times_show_is_compared(part, how, what):
    text = pulled()
    if "yield" in how and not hasattr(mujoco.MjModel, "jnt_springyield"):
        pytest.skip("this MuJoCo has no plastic springs")
    assert proof_of(text).verdict == "exact"
    proof = proof_of(changed(part, f"{part} {how}", text))
    assert {what, what.replace("left", "right")} <= set(proof.unlike)
    assert proof.verdict == "nearly"


PAIRS = {
    "gains": ('<general name="{0}{2}" joint="{1}_roll" gainprm="{3}"/>', (1, 10), [-1, -1]),
    "stiffness": ('<position name="{0}{2}" joint="{1}_roll" kp="{3}"/>', (5, 50), [-1, -1]),
    "ranges": ('<motor name="{0}{2}" joint="{1}_pitch" ctrlrange="{3}"/>', ("0 1", "-2 0"), [-1, -1]),
    "adhesion": ('<adhesion name="{0}{2}" body="{1}_shin" ctrlrange="0 1" gain="{3}"/>', (1, 10), [1, 1]),
}


@pytest.mark.parametrize("what", PAIRS)
def test_two_actuators_of_one_part_may_stand_in_another_order_on_each_side(what):
    told, values, signs = PAIRS[what]
    right = values if what != "ranges" else ("-1 0", "0 2")  # pitch changes its sign
    own = "".join(told.format("l", "left", k, x) for k, x in enumerate(values))
    own += "".join(told.format("r", "right", k, x) for k, x in reversed([*enumerate(right)]))
    found = body_of(changed("</actuator>", own + "</actuator>")).found["flip-x"]
    assert found.proof.verdict == "exact"
    # left 0 and 1 go to right 0 and 1, which stand in the other order
    assert found.match.ctrl[5:, 5:7].T.tolist() == [[0, 0, 0, signs[0]], [0, 0, signs[1], 0]]


def test_a_gain_of_the_other_sign_is_matched_by_what_it_does():
    text = changed('<motor name="a_left_knee" joint="left_knee"/>', '<general joint="left_knee" gainprm="-1"/>')
    found = body_of(text).found["flip-x"]
    assert (found.proof.verdict, found.match.ctrl[4, 3]) == ("exact", -1)


def test_time_constants_that_are_nearly_alike_are_nearly_a_mirror():
    slow = '<general joint="{}_roll" dyntype="filter" dynprm="{}"/>'
    text = changed("</actuator>", slow.format("left", 0.05) + slow.format("right", 0.0501) + "</actuator>")
    assert proof_of(text).unlike == ("dynamics of left_roll", "dynamics of right_roll")


def test_tendons_that_pull_at_nothing_at_rest_have_their_images():
    ends = '<site name="{0}_{1}" pos="0 {2} {3}"/>'
    text = biped(extra=ends.format("left", "hip", 0.1, 0.2) + ends.format("right", "hip", -0.1, 0.2))
    for side in ("left", "right"):  # through the axis of the roll
        text = text.replace(
            f'<body name="{side}_shin"', ends.format(side, "end", 0, -0.3) + f'<body name="{side}_shin"'
        )
        strand = f'<spatial name="{side}"><site site="{side}_hip"/><site site="{side}_end"/></spatial>'
        text = text.replace("</mujoco>", f"<tendon>{strand}</tendon></mujoco>")
    pull = '<motor tendon="left"/><motor tendon="right"/></actuator>'
    found = body_of(text.replace("0.02 0.1 -0.1", "0 0.1 -0.1").replace("0.02 -0.1 -0.1", "0 -0.1 -0.1")
                    .replace("</actuator>", pull)).found["flip-x"]  # fmt: skip
    assert found.match.ctrl[5:, 5:].tolist() == [[0, 1], [1, 0]]


def test_an_actuator_that_never_pulls_is_not_covered():
    text = changed("</actuator>", '<motor name="loose" joint="left_roll" gear="0"/></actuator>')
    refused = body_of(text).refused["flip-x"]
    assert refused == "not covered: in no pose that was looked at does anything pull of the actuators loose"


@pytest.mark.parametrize("order", [("sole", "imu"), ("imu", "sole")])
def test_frames_at_one_place_go_to_those_of_like_names(order):
    text = biped()
    for side, names in (("left", ("sole", "imu")), ("right", order)):
        frames = "".join(f'<body name="{side}_{name}" pos="0 0 -0.1"/>' for name in names)
        text = text.replace(f'<joint name="{side}_yaw"', f'{frames}<joint name="{side}_yaw"')
    body = body_of(text)
    for name in ("sole", "imu"):
        assert body.contacts([f"left_{name}", f"right_{name}"])


def test_a_base_beside_the_origin_has_no_state():
    assert body_of(biped()).state()
    assert body_of(changed('pos="0 0 1"', 'pos="3 0 1"')).state(), "flip-x leaves x"
    with pytest.raises(UserError, match="the base does not begin over the origin, so its state has no layout"):
        body_of(changed('pos="0 0 1"', 'pos="0 2 1"')).state()


def test_where_a_free_object_begins_does_not_matter():
    ball = '<body name="{}" pos="{} {} 0.1"><freejoint/><geom size="0.05" friction="{}"/></body>'
    text = changed(FLOOR, FLOOR + ball.format("one", 0.5, 0.7, 1))
    found = body_of(text).found["flip-x"]
    assert found.proof.verdict == "exact"
    assert found.match.joint[0] == 0
    # of two that are alike, the one that begins at the image
    both = body_of(changed(FLOOR, FLOOR + ball.format("two", 0.5, -0.7, 1), text)).found["flip-x"]
    assert (both.proof.verdict, both.match.joint[:2].tolist()) == ("exact", [1, 0])
    unlike = body_of(changed(FLOOR, FLOOR + ball.format("two", 0.5, -0.7, 2), text)).found["flip-x"]
    assert unlike.proof.verdict == "nearly"
