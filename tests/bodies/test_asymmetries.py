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


