"""Copies of what TorchRL's collectors deliver, under what reads along time: no copy changes a number of an original."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from esp_cli import Continuous, Field, Kind, Symmetry, layout

pytest.importorskip("torchrl", reason="needs TorchRL, of the extra torchrl")
pytest.importorskip("gymnasium", reason="needs Gymnasium")

from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.collectors.utils import split_trajectories
from torchrl.data import LazyTensorStorage, MultiStep, ReplayBuffer
from torchrl.data.replay_buffers.samplers import SliceSampler
from torchrl.envs import GymEnv, SerialEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE, TDLambdaEstimator

from esp_cli.loop.torchrl import SymmetricCopies, SymmetricLoss

FRAMES = 64
SEEN = layout(Field("cos", Kind.SCALAR), Field("sin", Kind.PSEUDOSCALAR), Field("rate", Kind.PSEUDOSCALAR))
TORQUE = Continuous(layout(Field("torque", Kind.PSEUDOSCALAR)))


def mirrored() -> Symmetry:
    return Symmetry(observation=SEEN, action=TORQUE, group="flip-x")


def collected(num_envs: int = 1) -> TensorDict:
    """Return what a collector delivers of random actions: [64], or [E, 64 / E]."""
    torch.manual_seed(0)
    env: Any = GymEnv("Pendulum-v1") if num_envs == 1 else SerialEnv(num_envs, lambda: GymEnv("Pendulum-v1"))
    collector = Collector(env, None, frames_per_batch=FRAMES, total_frames=FRAMES)
    (data,) = (batch.clone() for batch in collector)
    collector.shutdown()
    return data


def critic() -> TensorDictModule:
    torch.manual_seed(1)
    return TensorDictModule(nn.Linear(3, 1), ["observation"], ["state_value"])


def estimated(kind: Any, data: TensorDict) -> torch.Tensor:
    estimator = kind(gamma=0.99, lmbda=0.95, value_network=critic())
    return estimator(data.clone())["advantage"]


def originals(x: Any, like: TensorDict) -> Any:
    """Return the part of a batch with one copy that is the originals', in their shape."""
    return x[0] if x.dim() > like.dim() + (isinstance(x, torch.Tensor)) else x[: like.shape[0]]


@pytest.mark.parametrize("kind", [GAE, TDLambdaEstimator])
@pytest.mark.parametrize("num_envs", [1, 2])
def test_advantages_of_originals_are_those_without_copies(kind, num_envs) -> None:
    data = collected(num_envs)
    both = SymmetricCopies(mirrored())(data)
    assert both.names[-1] == "time"
    assert both.shape == ((2, FRAMES) if num_envs == 1 else (4, FRAMES // 2))
    expected = estimated(kind, data)
    torch.testing.assert_close(originals(estimated(kind, both), data), expected)
    if num_envs == 1:
        behind = estimated(kind, torch.cat([data, data]))
        assert (behind[:FRAMES] - expected).abs().max() > 10, "the control: copies behind it, along time"


def test_a_real_collector_takes_them_as_its_postproc() -> None:
    torch.manual_seed(0)
    env, copies = GymEnv("Pendulum-v1"), SymmetricCopies(mirrored())
    collector = Collector(env, None, frames_per_batch=FRAMES, total_frames=FRAMES, postproc=copies)
    (both,) = (batch.clone() for batch in collector)
    collector.shutdown()
    assert both.shape == (2, FRAMES)
    signs = torch.tensor([1.0, -1.0, -1.0])
    assert torch.equal(both["observation"][1], both["observation"][0] * signs)
    assert torch.equal(both["action"][1], -both["action"][0])
    advantage = estimated(GAE, both)
    torch.testing.assert_close(advantage[0], estimated(GAE, both[0].clone()))
    torch.testing.assert_close(advantage[1], estimated(GAE, both[1].clone()))


def test_time_that_comes_first_stays_first() -> None:
    data = collected(2).transpose(0, 1)
    data.names = ["time", None]
    both = mirrored().augment_tensordict(data)
    assert both.shape == (FRAMES // 2, 4)
    torch.testing.assert_close(both[:, :2]["observation"], data["observation"])
    torch.testing.assert_close(estimated(GAE, both)[:, :2], estimated(GAE, data))


@pytest.mark.parametrize("num_envs", [1, 2])
def test_returns_of_several_steps_end_where_the_data_do(num_envs) -> None:
    data, steps = collected(num_envs), MultiStep(gamma=0.99, n_steps=5)
    both = mirrored().augment_tensordict(data)
    expected = steps(data.clone().unsqueeze(0) if num_envs == 1 else data.clone())["next", "reward"]
    found = steps(both.clone())["next", "reward"]
    torch.testing.assert_close(found[:num_envs], expected)


@pytest.mark.parametrize("num_envs", [1, 2])
def test_no_trajectory_goes_from_an_original_on_to_a_copy(num_envs) -> None:
    data = collected(num_envs)
    both = mirrored().augment_tensordict(data)
    split = split_trajectories(both, trajectory_key=("collector", "traj_ids"))
    assert split.shape[0] == 2 * num_envs
    assert split.shape[1] == FRAMES // num_envs
    same = both.clone()
    same["collector", "traj_ids"] = torch.zeros_like(same["collector", "traj_ids"])
    assert split_trajectories(same, trajectory_key=("collector", "traj_ids")).shape[0] < 2 * num_envs, "the control"


def test_slices_of_a_replay_buffer_hold_one_trajectory_under_one_element() -> None:
    sampler = SliceSampler(slice_len=16, traj_key=("collector", "traj_ids"), strict_length=True)
    buffer = ReplayBuffer(storage=LazyTensorStorage(1000), sampler=sampler, batch_size=256)
    for _ in range(3):
        buffer.extend(mirrored().augment_tensordict(collected()).reshape(-1))
    slices = buffer.sample().reshape(-1, 16)
    ids = slices["collector", "traj_ids"]
    assert (ids == ids[:, :1]).all()
    assert (ids < 0).any()
    assert (ids >= 0).any()
    # a step of a pendulum, at most 8 rad/s for 0.05 s, cannot exchange a scene with its mirror image
    step = slices["next", "observation"][:, :-1] - slices["observation"][:, 1:]
    assert step.abs().max() < 1e-5


@pytest.mark.parametrize("num_envs", [1, 2])
def test_a_loss_estimates_advantages_before_it_makes_copies(num_envs) -> None:
    """As TorchRL documents it: a loss of PPO is given what the collector delivers."""
    data = collected(num_envs)
    data["sample_log_prob"] = data["action_log_prob"] = torch.zeros(data.shape)
    torch.manual_seed(0)
    net = TensorDictModule(nn.Sequential(nn.Linear(3, 2), NormalParamExtractor()), ["observation"], ["loc", "scale"])
    actor = ProbabilisticActor(net, ["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)
    plain = ClipPPOLoss(actor, critic(), normalize_advantage=False)
    ready = data.clone()
    GAE(gamma=0.99, lmbda=0.95, value_network=plain.critic_network)(ready)
    loss = SymmetricLoss(plain, mirrored())
    bare, given = loss(data.clone()), loss(ready)
    for name in ("loss_objective", "loss_critic", "policy_symmetry", "value_symmetry"):
        torch.testing.assert_close(bare[name], given[name])
    if num_envs == 1:
        crossed = plain(mirrored().augment_tensordict(data).reshape(-1))
        assert not torch.isclose(crossed["loss_critic"], given["loss_critic"]), "the control: along one axis of time"
