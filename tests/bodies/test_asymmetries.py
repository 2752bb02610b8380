"""Asymmetries that few states of a robot show, or none: each is found, and robots without it stay exact."""

import mujoco
import pytest

from esp_cli import Body
from esp_cli.bodies.proof import Proof
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


@pytest.mark.parametrize("floor", [FLOOR, '<geom type="box" size="9 9 0.01"/>'])
def test_a_robot_that_begins_high_is_lowered_to_the_floor(floor):
    proof = proof_of(changed('pos="0 0 1"', 'pos="0 0 30"').replace(FLOOR, floor))
    assert proof.contacts is not None
    assert (proof.verdict, proof.contacts < 1e-9) == ("exact", True)


def test_contacts_that_no_state_has_are_not_covered():
    text = changed("<worldbody>", '<worldbody><geom size="0.1" pos="9 0 0"/>').replace(FLOOR, "")
    assert proof_of(text).unlike == ("contacts with the world (not covered: no state has any)",)


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
