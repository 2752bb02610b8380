"""Emitted mirrors inside of the real Stable-Baselines3 and skrl, by the lines that the page of legged robots gives."""

import mujoco
import numpy as np
import pytest
import torch

from esp_cli import Body
from esp_cli.bodies.emitting import emitted
from esp_cli.bodies.numbers import numbers_of
from tests.bodies.models import biped
from tests.bodies.test_emitting import imported

gymnasium = pytest.importorskip("gymnasium")


class Walk(gymnasium.Env):
    """Numbers of Isaac Lab's velocity task, at random."""

    observation_space = gymnasium.spaces.Box(-9, 9, (39,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (9,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.standard_normal(39).astype(np.float32), {}

    def step(self, action):
        return self.np_random.standard_normal(39).astype(np.float32), 1.0, False, False, {}


@pytest.fixture
def my_mirror(tmp_path):
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()))
    return imported(emitted(body, numbers_of(body, None), "biped.xml"), tmp_path, "my_mirror")


def look(module, obs, actions, numbers, batch):
    assert torch.equal(obs[batch:], module.mirrored(obs[:batch], "flip-x", "policy"))
    assert torch.equal(actions[batch:], module.mirrored(actions[:batch], "flip-x"))
    assert all(torch.equal(x[:batch], x[batch:]) for x in numbers)


def test_stable_baselines3_learns_from_copies(my_mirror):
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.buffers import RolloutBuffer
    from stable_baselines3.common.type_aliases import RolloutBufferSamples

    batches = []

    class Mirrored(RolloutBuffer):
        def _get_samples(self, batch_inds, env=None):
            obs, actions, *numbers = my_mirror.augment(*super()._get_samples(batch_inds, env))
            look(my_mirror, obs, actions, numbers, 32)
            batches.append(len(obs))
            return RolloutBufferSamples(obs, actions, *numbers)

    learner = sb3.PPO("MlpPolicy", Walk(), n_steps=64, batch_size=32, n_epochs=1, rollout_buffer_class=Mirrored)
    learner.learn(64)
    assert batches == [64, 64]


def test_skrl_learns_from_copies(my_mirror):
    pytest.importorskip("skrl")
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.trainers.torch import SequentialTrainer

    batches, env = [], wrap_env(Walk(), wrapper="gymnasium")
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": "cpu"}

    class Mirrored(RandomMemory):
        def sample(self, names, **how):
            for seen, states, acted, *rest in super().sample(names, **how):
                obs, actions, *numbers = my_mirror.augment(seen, acted, *rest)
                look(my_mirror, obs, actions, numbers, 16)
                batches.append(len(obs))
                yield obs, states, actions, *numbers

    class Actor(GaussianMixin, Model):
        def __init__(self):
            Model.__init__(self, **spaces)
            GaussianMixin.__init__(self)
            self.net, self.scale = torch.nn.Linear(39, 9), torch.nn.Parameter(torch.zeros(9))

        def compute(self, inputs, role):
            return self.net(inputs["observations"]), {"log_std": self.scale}

    class Critic(DeterministicMixin, Model):
        def __init__(self):
            Model.__init__(self, **spaces)
            DeterministicMixin.__init__(self)
            self.net = torch.nn.Linear(39, 1)

        def compute(self, inputs, role):
            return self.net(inputs["observations"]), {}

    config = PPO_CFG()
    config.rollouts, config.mini_batches, config.learning_epochs = 32, 2, 1
    memory = Mirrored(memory_size=32, num_envs=1, device="cpu")
    agent = PPO(models={"policy": Actor(), "value": Critic()}, memory=memory, cfg=config, **spaces)
    steps = {"timesteps": 33, "disable_progressbar": True, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=steps).train()
    assert batches == [32, 32]
