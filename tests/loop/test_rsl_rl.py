"""rsl_rl: copies of its batches, and recurrent PPO whose mirrors have the states of whole mirrored histories."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("rsl_rl.algorithms")
from rsl_rl.algorithms import PPO
from rsl_rl.extensions.symmetry import Symmetry as Extension
from rsl_rl.models import RNNModel
from rsl_rl.runners import OnPolicyRunner
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from esp_cli import Body, Field, Kind, layout
from esp_cli.bodies.emitting import emitted, mirror_of
from esp_cli.loop.rsl_rl import MirroredPPO, data_augmentation_func
from esp_envs.errors import UserError
from tests.bodies.test_emitting import imported
from tests.bodies.test_fields import anymal

ENVS, STEPS = 6, 10
GROUPS = {"actor": ["policy"], "critic": ["policy"]}


@pytest.fixture
def mirror(tmp_path):
    body = Body(["left", "right"], {"left": "-right"})
    seen = layout(Field("cue", Kind.PSEUDOSCALAR), Field("clock", Kind.SCALAR), body.positions())
    return imported(emitted(body, {"policy": seen, "action": layout(body.positions())}, "two"), tmp_path)


def learner(mirror, kind="gru", seed=0, **settings) -> MirroredPPO:
    torch.manual_seed(seed)
    obs = TensorDict({"policy": torch.zeros(ENVS, 4)}, batch_size=[ENVS])
    shape = {"hidden_dims": [16], "rnn_type": kind, "rnn_hidden_dim": 8}
    gauss = {"class_name": "GaussianDistribution", "init_std": 0.5}
    actor = RNNModel(obs, GROUPS, "actor", 2, distribution_cfg=gauss, **shape)
    storage = RolloutStorage("rl", ENVS, STEPS, obs, [2])
    return MirroredPPO(actor, RNNModel(obs, GROUPS, "critic", 1, **shape), storage, mirror=mirror, num_mini_batches=2,
                       num_learning_epochs=2, **settings)  # fmt: skip


def train(ppo: MirroredPPO) -> dict[str, float]:
    with torch.inference_mode():
        ppo.compute_returns(TensorDict({"policy": torch.zeros(ENVS, 4)}, batch_size=[ENVS]))
    return ppo.update()


def collect(ppo: MirroredPPO, rollouts: int = 1) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Play random observations in episodes of 7 steps; return observations and ends."""
    generator, history = torch.Generator().manual_seed(1), []
    for step in range(rollouts * STEPS):
        if step and step % STEPS == 0:
            train(ppo)
        obs = torch.randn(ENVS, 4, generator=generator)
        dones = torch.arange(ENVS) % 7 == step % 7
        with torch.inference_mode():  # as the runner does
            ppo.act(TensorDict({"policy": obs}, batch_size=[ENVS]))
            ppo.process_env_step(None, torch.randn(ENVS, generator=generator), dones, {})
        history.append((obs, dones))
    return history


@pytest.mark.parametrize("kind", ["gru", "lstm"])
def test_states_of_mirrors_are_those_of_whole_mirrored_histories(mirror, kind):
    ppo = learner(mirror, kind)
    history = collect(ppo)
    state = None
    for obs, dones in history:
        ppo.actor.reset(hidden_state=state)
        ppo.actor(TensorDict({"policy": mirror.mirrored(obs, "flip-x", "policy")}, batch_size=[ENVS]))
        state = ppo.actor.get_hidden_state()
        ppo.actor.reset(dones)
    kept = ppo.states["flip-x", 0]
    assert torch.equal(kept[0] if kind == "lstm" else kept, state[0] if kind == "lstm" else state)


def test_a_batch_holds_each_trajectory_and_its_image(mirror):
    ppo = learner(mirror)
    collect(ppo, 2)  # trajectories that go on from an earlier rollout have states that are not 0
    batches = list(map(ppo.with_images, ppo.numbered(ppo.storage.recurrent_mini_batch_generator(2, 2))))
    assert len(batches) == 4
    for batch in batches:
        half = batch.masks.shape[1] // 2
        assert torch.equal(batch.masks[:, :half], batch.masks[:, half:])
        own, image = batch.observations["policy"].split(half, 1)
        assert torch.equal(image, own[..., [0, 1, 3, 2]] * torch.tensor([-1, 1, -1, -1]))
        assert torch.equal(batch.actions[:, 3:], -batch.actions[:, :3][..., [1, 0]])
        assert torch.equal(batch.returns[:, :3], batch.returns[:, 3:])
        assert batch.old_distribution_params[0].shape[1] == 3  # the divergence is that of originals
        states = batch.hidden_states[0].split(half, 1)
        assert not torch.equal(*states)
    first = batches[0]
    half = first.masks.shape[1] // 2
    ppo.actor(first.observations, masks=first.masks, hidden_state=first.hidden_states[0])
    assert ppo.saved["flip-x", 0][0][0].abs().sum() > 0
    started = ppo.saved["flip-x", 0][0][0][:, 0]
    assert torch.equal(first.hidden_states[0][:, half], started)


def test_training_uses_the_images_and_leaves_the_storage_as_it_was(mirror):
    ppo = learner(mirror)
    collect(ppo, 3)
    losses = train(ppo)
    assert all(torch.isfinite(torch.tensor(x)) for x in losses.values())
    assert "recurrent_mini_batch_generator" not in vars(ppo.storage)
    assert "get_kl_divergence" not in vars(ppo.actor)


def test_rsl_rl_augments_groups_with_the_function_of_a_body(tmp_path):
    body = anymal()
    numbers = {
        "policy": layout(body.gravity(), body.positions()),
        "critic": layout(body.velocity(), body.contacts(["LF", "LH", "RF", "RH"])),
        "action": layout(body.positions()),
    }
    obs = TensorDict({"policy": torch.randn(6, 15), "critic": torch.randn(6, 7)}, batch_size=[6])
    ones, actions = torch.ones(6, 1), torch.randn(6, 12)
    rows = {"old_actions_log_prob": ones, "values": ones, "advantages": ones, "returns": ones}
    batch = SimpleNamespace(observations=obs, actions=actions, **rows)
    extension = Extension(None, data_augmentation_func(body, numbers), use_data_augmentation=True)
    extension.augment_batch(batch, 6)
    assert (batch.observations.batch_size[0], len(batch.actions), len(batch.returns)) == (24, 24, 24)
    written = imported(emitted(body, numbers, "anymal"), tmp_path).compute_symmetric_states(None, obs, actions)
    assert torch.equal(batch.actions, written[1])
    assert all(torch.equal(batch.observations[group], written[0][group]) for group in obs.keys())  # noqa: SIM118

    one = data_augmentation_func(body, numbers, "left-right")
    seen, nothing = one(env=None, obs=obs, actions=None)
    assert nothing is None
    assert torch.equal(seen["critic"][6:, 3:], obs["critic"][:, [5, 6, 3, 4]])
    nothing, moved = one(env=None, obs=None, actions=actions)
    assert nothing is None
    assert torch.equal(moved, written[1][:12])
    with pytest.raises(UserError, match="the body has no rot90; its group is d2"):
        data_augmentation_func(body, numbers, "d4")


class Walk:
    """Joints of ANYmal at random, in rsl_rl's form."""

    num_envs, num_actions, max_episode_length, device, cfg = ENVS, 12, 7, "cpu", {}
    episode_length_buf = torch.zeros(ENVS, dtype=torch.long)

    def get_observations(self) -> TensorDict:
        return TensorDict({"policy": torch.randn(ENVS, 39)}, batch_size=[ENVS])

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        return self.get_observations(), -actions.square().sum(-1), torch.rand(ENVS) < 0.2, {}


@pytest.mark.parametrize("recurrent", [False, True])
def test_the_runner_learns_by_the_names_that_its_settings_give(recurrent, monkeypatch):
    body = anymal()
    joints = [body.positions(), body.velocities(), body.positions(name="actions")]
    mirror = mirror_of(body, {"policy": layout(body.gravity(), *joints), "action": layout(body.positions())})
    monkeypatch.setitem(
        sys.modules, "my_robot", SimpleNamespace(mirror=mirror, augment=mirror.compute_symmetric_states)
    )
    model = {"class_name": "RNNModel" if recurrent else "MLPModel", "hidden_dims": [16]}
    model |= {"rnn_type": "gru", "rnn_hidden_dim": 8} if recurrent else {}
    symmetry = {"data_augmentation_func": "my_robot:augment", "use_data_augmentation": True, "use_mirror_loss": True}
    plain = {"class_name": "PPO", "symmetry_cfg": symmetry}
    mirrored = {"class_name": "esp_cli.loop.rsl_rl:MirroredPPO", "mirror": "my_robot:mirror"}
    algorithm = {"num_learning_epochs": 1, "num_mini_batches": 2, **(mirrored if recurrent else plain)}
    gauss = {"class_name": "GaussianDistribution", "init_std": 0.5}
    settings = {"algorithm": algorithm, "actor": {**model, "distribution_cfg": gauss}, "critic": model.copy()}
    settings |= {"obs_groups": GROUPS, "num_steps_per_env": STEPS, "save_interval": 100}
    runner = OnPolicyRunner(Walk(), settings, None, "cpu")
    before = [x.clone() for x in runner.alg.actor.parameters()]
    runner.learn(2)
    assert type(runner.alg) is (MirroredPPO if recurrent else PPO)
    assert not recurrent or runner.alg.mirror is mirror
    assert any(not torch.equal(x, y) for x, y in zip(before, runner.alg.actor.parameters(), strict=True))
