"""The quadruped: its model, what it feels, when it falls, and what its commands pay, by hand."""

import mujoco
import numpy as np
import pytest
import torch

from esp_cli import Body
from esp_cli.bodies.walking import HEIGHT_M, quadruped
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.transforms import build_transform
from esp_envs import make
from esp_envs.conformance import Subject, check

STANDING = [0, 0, HEIGHT_M, 1, 0, 0, 0, *[0] * 12]


def state_of(place=STANDING, rates=(), command=(0, 0, 0)):
    """Return one state: positions, velocities, no targets before, a command, the start of a stride."""
    rates = [*rates, *[0.0] * (18 - len(rates))]
    return torch.tensor([*place, *rates, *[0.0] * 12, *command, 1, 0], dtype=torch.float32).view(1, 1, -1)


def put(place=STANDING, rates=(), command=(0, 0, 0)):
    env = make("quadruped", 1, [0])
    env.reset()
    return env, env.set_state(state_of(place, rates, command)).obs[0, 0, 0]


def test_mirrors_exchange_legs():
    """Hips turn about x, thighs and shins about y. A mirror in y keeps turns about y alone, one in x those about x."""
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(quadruped()))
    assert body.group == "d2"
    assert max(found.proof.gap for found in body.found.values()) < 1e-9
    for element, partner, signs in (("flip-x", "right_front", (-1, 1, 1)), ("flip-y", "left_hind", (1, -1, -1))):
        rows = {row[0]: (row[1], row[2]) for row in body.rows(element)}
        parts = ("hip", "thigh", "shin")
        expected = [(f"{partner}_{part}", sign) for part, sign in zip(parts, signs, strict=True)]
        assert [rows[f"left_front_{part}"] for part in parts] == expected


def test_one_heavier_leg_leaves_no_symmetry():
    heavier = quadruped().replace('mass=".5"', 'mass=".8"', 1)
    assert Body.from_mjcf(mujoco.MjModel.from_xml_string(heavier)).group == "c1"


def test_what_it_feels():
    """Rolled by 90 degrees about x its y axis points up: gravity is (0, -1, 0), and (1, 2, 3) is (1, 3, -2)."""
    half = np.sqrt(0.5)
    _, obs = put([0, 0, 1, half, half, 0, 0, *[0] * 12], (1, 2, 3, 4, 5, 6), (0.5, 0.25, 0.125))
    expected = [1, 3, -2, 4, 5, 6, 0, -1, 0, 0.5, 0.25, 0.125]
    torch.testing.assert_close(obs[:12], torch.tensor(expected), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("command", "reward"), [((0, 0, 0), 1.5), ((0.3, 0.4, 0), 1.0), ((0, 0, 1), 1.0)])
def test_standing_pays_by_the_command(command, reward):
    """It stands still; torques that hold it, and what is left of settling, cost less than 0.05 a step."""
    env, _ = put(command=command)
    steps = [env.step(env.heuristic("stand")) for _ in range(100)]
    assert not any(step.ended.any() for step in steps)
    assert reward - 0.05 < steps[-1].reward.item() < reward


@pytest.mark.parametrize(
    ("place", "falls"),
    [(STANDING, False), ([0, 0, 1, 0, 1, 0, 0, *[0] * 12], True), ([0, 0, 0.1, *STANDING[3:]], True)],
)
def test_an_episode_ends_where_it_lies(place, falls):
    env, _ = put(place)
    assert env.step(env.heuristic("stand")).terminated.item() == falls


@pytest.mark.parametrize("command", [(0.6, 0, 0), (-0.6, 0, 0), (0, 0.4, 0), (0, 0, 0.8)])
def test_a_trot_goes_where_it_is_told(command):
    """Over two seconds it comes more than half as far as it should, and less than a fifth of that elsewhere."""
    env, _ = put(command=command)
    gone = torch.zeros(3)
    for _ in range(100):
        velocity, spin, *_ = env._felt(step_of(env))
        gone += 0.02 * torch.stack([velocity[0, 0, 0], velocity[0, 0, 1], spin[0, 0, 2]])
    asked = 2 * torch.tensor(command)
    assert (gone @ asked) / (asked @ asked) > 0.5
    assert (gone - (gone @ asked) / (asked @ asked) * asked).norm() < 0.2 * asked.norm()


def step_of(env):
    env.step(env.heuristic("trot"))
    return env.world


def test_the_clock_goes_round_in_a_stride():
    """16 steps are a turn, 4 a quarter: from (1, 0) to (0, 1)."""
    env, obs = put()
    assert obs[-2:].tolist() == [1, 0]
    seen = [env.step(env.heuristic()).next.obs[0, 0, 0, -2:] for _ in range(16)]
    torch.testing.assert_close(seen[3], torch.tensor([0.0, 1]), atol=1e-6, rtol=0)
    torch.testing.assert_close(seen[15], torch.tensor([1.0, 0]), atol=1e-6, rtol=0)


def test_each_element_turns_what_follows():
    env = make("quadruped", 8, [0], {"horizon": 50})
    seen = env.reset()
    for _ in range(10):
        seen = env.step(env.random_action()).next
    action = env.random_action()
    env.set_state(seen.state)
    step = env.step(action)
    for element in parse_elements("d2", 1):
        transform = build_transform([element], env.spec)
        env.set_state(transform.state(seen.state))
        image = env.step(transform.action(action))
        torch.testing.assert_close(image.next.obs, transform.obs(step.next.obs), atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(image.reward, step.reward, atol=1e-4, rtol=1e-4)
        other = env.step(action)  # which is not the image's action
        assert not torch.allclose(other.next.obs, transform.obs(step.next.obs), atol=1e-2)


def test_it_keeps_every_promise():
    findings = list(
        check(Subject(lambda num_envs, seeds: make("quadruped", num_envs, tuple(seeds), {"horizon": 12}), 1e-4))
    )
    assert [(found.promise, found.broken) for found in findings if found.broken] == []
    assert len(findings) > 10
