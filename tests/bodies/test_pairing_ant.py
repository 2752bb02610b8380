"""Gymnasium's Ant with layouts of its model: states are set and paired, and tell its reward's mirror from another."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from esp_cli import Body, Continuous, Field, Kind, Symmetry, layout
from esp_cli.bodies import VECTOR_3D
from esp_envs import generators_for
from esp_envs.adapters.gymnasium import SingleAgentTask

gymnasium = pytest.importorskip("gymnasium")
BODY = Body.from_mjcf(Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "ant.xml")
MOVED = (BODY.attitude(), BODY.positions(), BODY.velocity(), BODY.spin(), BODY.velocities())


class Ant(SingleAgentTask):
    observation = layout(Field("height", Kind.SCALAR), *MOVED)
    simulated = layout(Field("place", VECTOR_3D), *MOVED)
    action = Continuous(layout(BODY.controls()))
    symmetry, convention, terminates = "flip-x", "gymnasium Ant-v5", True

    def make_single(self):
        return gymnasium.make("Ant-v5", include_cfrc_ext_in_observation=False)


def test_ants_states_are_paired():
    env = Ant(Ant.Settings(workers=0), 6, generators_for([0]))
    assert env.settable()
    start = env.reset()
    for _ in range(5):
        start = env.step(env.random_action()).next
    state, action = start.state[0], env.random_action()

    def reached(state, action):
        env.set_state(state[None])
        step = env.step(action)
        return step.final.obs[0, :, 0], step.reward[0, :, 0]

    seen, reward = reached(state, action)
    for group, is_right in (("flip-x", True), ("flip-y", False)):
        kinds = {"observation": Ant.observation, "action": Ant.action, "state": Ant.simulated}
        (g,) = Symmetry(**kinds, group=group, copies="all").transforms(state)
        image, paid = reached(g.state(state), g.action(action[0, :, 0])[None, :, None])
        torch.testing.assert_close(image, g.obs(seen), atol=1e-3, rtol=1e-3)
        assert torch.allclose(paid, reward, atol=1e-3) == is_right
