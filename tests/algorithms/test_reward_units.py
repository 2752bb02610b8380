"""Offsets and scales of the reward: what a learner makes of rewards a + b r, against what it makes of r."""

import pytest
import torch

from esp_cli.algorithms.normalisation import ValueNormaliser, with_variances
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from tests.algorithms.off_policy import on_perceptron


def learner(algorithm: str = "mappo", task: str = "navigation"):
    overrides = {f"{algorithm}.num_envs": 8, "network.hidden": [16, 16], "prior.kind": "none"} | on_perceptron(task)
    return build_learner(resolve_config(task, algorithm, steps=10_000, seeds=(0, 1), overrides=overrides))


def advantages(offset: float, scale: float, task: str = "navigation") -> torch.Tensor:
    """Return the advantages and targets of three rollouts of one random policy, whose critic never learns."""
    trained, out = learner(task=task), []
    for _ in range(3):
        rollout = trained.collector.collect(25)
        rollout.reward.mul_(scale).add_(offset)
        batch, _ = trained.prepare(rollout)
        out.append(torch.cat([batch.advantage.mean(-1).flatten(1), batch.target.flatten(1)], 1))
    return torch.stack(out)


@pytest.mark.parametrize(("offset", "scale"), [(1e3, 1.0), (-1e3, 1.0), (1e6, 1e3), (1.0, 1e-3), (1e4, 10.0)])
def test_mappo_sees_no_offset_far_from_0(offset, scale):
    one, other = advantages(100.0, 1.0), advantages(offset, scale)
    torch.testing.assert_close(other, one, atol=0.15 if scale != 1 else 5e-3, rtol=0)
    assert (advantages(0.0, 1.0) - one).abs().max() > 0.5, "the control: near 0, rewards are taken as they are"


@pytest.mark.parametrize("scale", [1e-4, 1e-3, 1e3, 1e6])
def test_mappo_sees_no_scale(scale):
    torch.testing.assert_close(advantages(0.0, scale), advantages(0.0, 1.0), atol=0.05, rtol=0)


def test_an_offset_is_kept_where_episodes_end_early():
    trained = learner(task="wildlife")
    rollout = trained.collector.collect(25)
    rollout.reward.add_(1e3)
    trained.prepare(rollout)
    assert trained.spec.terminates
    assert (trained.normaliser.offset == 0).all()
    assert (trained.normaliser.mean > 1e3).all()


def test_what_is_fixed_before_the_first_update_stays():
    normaliser, near = ValueNormaliser(3, 0.9), torch.tensor([7.0, 9.0])
    rewards = torch.stack([near, near + 10, torch.full((2,), 0.5)])  # 8, 18 and infinitely many deviations from 0
    normaliser.begin(rewards, 10.0, centres=True)
    assert normaliser.offset.tolist() == [0.0, 18.0, 0.5]
    assert normaliser.variance.tolist() == [1.0, 1.0, 1.0], "all sums of ten rewards are larger, or 0"
    normaliser.update(rewards)
    before = {name: value.clone() for name, value in normaliser.state_dict().items()}
    normaliser.begin(1e3 + rewards, 10.0, centres=True)
    assert all(torch.equal(before[name], value) for name, value in normaliser.state_dict().items())


def test_first_values_are_small_beside_small_rewards():
    normaliser = ValueNormaliser(2, 0.9)
    normaliser.begin(torch.tensor([[3e-3, 4e-3], [3.0, 4.0]]), 10.0, centres=False)
    root_mean_square = 12.5**0.5 * 1e-3
    deviation = normaliser.denormalise(torch.ones(2, 1)).flatten()
    torch.testing.assert_close(deviation, torch.tensor([0.01 * 10 * root_mean_square, 1.0]))


def test_a_run_of_0_1_goes_on_without_an_offset():
    old = {f"normaliser.{name}": torch.ones(2) for name in ("mean", "square", "weight")}
    assert with_variances(old)["normaliser.offset"].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
@pytest.mark.parametrize(("offset", "scale"), [(10.0, 1.0), (1e3, 1.0), (-1e3, 1e-2), (0.0, 1e-3), (0.0, 1e6)])
def test_targets_of_replays_see_neither(algorithm, offset, scale):
    def targets(offset: float, scale: float) -> torch.Tensor:
        trained = learner(algorithm)
        episodes, _ = trained.collector.collect()
        episodes.reward.mul_(scale).add_(offset)
        trained._store(episodes)
        return trained.td_targets(episodes, episodes.reward, torch.zeros_like(episodes.reward))

    plain = targets(0.0, 1.0)
    torch.testing.assert_close(targets(offset, scale), plain, atol=2e-2 if offset < 0 else 1e-3, rtol=0)
    assert plain.std() > 0.1, "the control: there is something to see"
