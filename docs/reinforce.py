"""REINFORCE (Williams, 1992), plain or with a symmetry prior: the smallest example of docs/add-an-algorithm.md.

To stay short, it ignores `action_mask` and `alive` and takes each episode to last `spec.horizon` steps: it is not for
tasks with masks, with agents that end one by one, or with episodes that end early.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from pydantic import Field
from torch import Tensor

from esp_cli.algorithms.adam import SeedAdam
from esp_cli.algorithms.learner import Iteration, Learner, LearnerConfig
from esp_cli.algorithms.objectives import normalise_per_seed
from esp_cli.algorithms.rollout import Collector
from esp_cli.networks.contract import NetworkConfig
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.prior import SeedBatch, mean_per_seed
from esp_envs.base import Environment
from esp_envs.spec import TaskSpec


class ReinforceConfig(LearnerConfig):
    """Hyperparameters."""

    num_envs: int = Field(32, ge=1, description="episodes per seed and update")
    learning_rate: float = Field(3e-3, gt=0)


@dataclass
class Episodes(SeedBatch):
    """Whole episodes [S, E, T, ...] and, for each step and agent, the weight of its log-probability."""

    per_agent = ("weight",)

    weight: Tensor


class Reinforce(Learner):
    """Climb the log-probability of what was done, weighted by the reward that followed."""

    config_class = ReinforceConfig
    config: ReinforceConfig
    policy: StochasticPolicy
    collector: Collector

    def build(self, env: Environment, network: NetworkConfig) -> None:
        """Make the policy, its optimiser and the collector; see `Learner.build`."""
        generators = self.generators["learner"]
        self.policy = self.build_policy(self.spec, network, generators).to(self.device)
        self.optimiser = SeedAdam(
            list(self.policy.parameters()), learning_rate=self.config.learning_rate, epsilon=1e-8, max_grad_norm=10.0
        )
        self.collector = Collector(env, self.policy, generators)
        self.modules, self.optimisers = {"policy": self.policy}, {"adam": self.optimiser}

    @classmethod
    def build_policy(
        cls, spec: TaskSpec, network: NetworkConfig, generators: Sequence[torch.Generator]
    ) -> StochasticPolicy:
        """Return new stochastic policies."""
        return StochasticPolicy(spec, network, generators)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps per seed of one iteration."""
        return self.config.num_envs * self.spec.horizon

    def iterate(self, progress: float) -> Iteration:
        """Play episodes, take one gradient step, and return what came out."""
        rollout = self.collector.collect(self.spec.horizon)
        to_go = rollout.reward.flip(2).cumsum(2).flip(2)
        weight = normalise_per_seed(to_go - to_go.mean(1, keepdim=True))
        batch = Episodes(rollout.obs, rollout.state, rollout.action, weight)

        copies = self.prior.copies(batch, self.generators["prior"])
        outputs = self.policy.unroll(copies.rows.obs)
        log_prob = self.policy.head.log_prob(copies.for_loss(outputs), copies.loss_rows.action)
        loss = -mean_per_seed(log_prob * copies.loss_rows.weight)
        self.optimiser.step(loss + copies.penalty(policy=(self.policy.head, outputs)))

        metrics = {"train/return": self.collector.pop_mean_return(), "train/policy_loss": loss.detach()}
        return self.iteration(metrics, loss.detach())
