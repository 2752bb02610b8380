"""QMIX (Rashid et al., 2018), plain or with a symmetry prior.

Every agent has action values of its own, from one network that all share; a mixer that is monotonic in them makes the
team's value Q_tot, so that each agent's best action is its part of the team's. Temporal differences on Q_tot, with
the consistency loss of supplement eq. 19 added to them.

An agent that has ended adds nothing: its value enters the mixer as 0. (PyMARL feeds the value of a dead agent's no-op.)
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from types import MappingProxyType

import torch
from pydantic import Field
from torch import Tensor

from esp_cli.algorithms.objectives import value_loss
from esp_cli.algorithms.off_policy import ExploringConfig, ExploringLearner
from esp_cli.algorithms.replay import EpisodeBatch
from esp_cli.networks.build import perceptron
from esp_cli.networks.contract import Generators, IoSpec, NetworkConfig
from esp_cli.networks.exploration import EpsilonGreedy
from esp_cli.networks.heads import best
from esp_cli.networks.joint_q import MonotonicMixer
from esp_cli.networks.policy import HistoryPolicy
from esp_cli.prior import Answers
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, TaskSpec


class QmixConfig(ExploringConfig):
    """Hyperparameters; every default stands here, or in `OffPolicyConfig`, and nowhere else."""

    learning_rate: float = Field(4e-3, gt=0, description="of Adam; paper: 7e-4")
    td_lambda: float = Field(0.9, ge=0, le=1, description="TD(lambda) along the episode; paper: 0, one-step targets")
    mixer_width: int = Field(32, ge=1, le=1024, description="hidden units of the mixer")
    hyper_width: int = Field(64, ge=1, le=1024, description="hidden units of the hypernetwork")
    double_q: bool = Field(True, description="the online network chooses the next action, the target network values it")
    target_every: int = Field(100, ge=1, description="gradient steps between hard copies into the target networks")

    def without_effect(self, network: NetworkConfig, spec: Callable[[], TaskSpec]) -> frozenset[str]:
        own = type(network).mixer is not NetworkConfig.mixer  # which has no hypernetwork
        return super().without_effect(network, spec) | (frozenset({"hyper_width"}) if own else frozenset())


# orthogonal gain of the utility network's last layer: the first values are small beside standardised rewards
VALUE_GAIN = 0.1


class Qmix(ExploringLearner):
    """The learner: utilities, mixer, their targets, optimiser and prior of S seeds; arguments as of `Learner`."""

    config_class = QmixConfig
    watched = ("td_loss", "grad_norm")
    config: QmixConfig
    task_settings = MappingProxyType({"actions": "discrete"})

    def build(self, env: Environment, network: NetworkConfig) -> None:
        super().build(env, network)
        config, generators = self.config, self.generators["learner"]
        widths = (self.spec.num_agents, self.critic_width, config.mixer_width, config.hyper_width)
        _, compiled = perceptron(network, "relu").products
        io = IoSpec(self.spec, config.critic_input)
        own = network.mixer(generators, io, config.mixer_width, int(config.critic_sees_time))
        self.mixer = (own or MonotonicMixer(generators, *widths, compiled)).to(self.device)
        self.target_policy = copy.deepcopy(self.policy).requires_grad_(False)
        self.target_mixer = copy.deepcopy(self.mixer).requires_grad_(False)
        self.optimiser = self.adam(self.policy, self.mixer, learning_rate=config.learning_rate)
        targets = {"target_policy": self.target_policy, "target_mixer": self.target_mixer}
        self.modules |= {"mixer": self.mixer, **targets}
        self.optimisers = {"adam": self.optimiser}

    @classmethod
    def build_policy(cls, spec: TaskSpec, network: NetworkConfig, generators: Generators) -> HistoryPolicy:
        if not isinstance(spec.action, Discrete):
            raise UserError(
                f"qmix chooses among discrete actions, but those of this {spec.name} are continuous; "
                "use maddpg or mappo, or discrete actions"
            )
        return HistoryPolicy(spec, network, generators, EpsilonGreedy(spec.action, len(generators)), VALUE_GAIN)

    def update(self, batch: EpisodeBatch) -> dict[str, Tensor]:
        copies = self.prior.copies(batch, self.generators["prior"])
        utilities = self._utilities(copies.rows)
        seen = self.critic_rows(copies.rows)
        values = self._total(utilities, copies.rows, seen)
        target = self._targets(batch, copies.original(utilities).detach(), copies.original(seen))
        loss = value_loss(values, target, copies, self.config.huber_delta) + copies.penalty(value=values)
        (norm,) = self.optimiser.step(loss)
        if (self.updates + 1) % self.config.target_every == 0:
            self.target_policy.load_state_dict(self.policy.state_dict())
            self.target_mixer.load_state_dict(self.mixer.state_dict())
        return self.td_metrics(copies.original(values), target, batch) | {"grad_norm": norm}

    def answers(self, rows: EpisodeBatch) -> Answers:
        return {"value": self._total(self._utilities(rows), rows, self.critic_rows(rows))}

    def _utilities(self, rows: EpisodeBatch) -> Tensor:
        return self.policy.unroll(rows.obs, rows.action, rows.action_mask)

    def _total(self, utilities: Tensor, rows: EpisodeBatch, seen: Tensor) -> Tensor:
        """Return Q_tot [S, B, T, 1] of what was done, from utilities [S, B, T + 1, N, A] and what the mixer sees."""
        chosen = utilities[:, :, :-1].gather(-1, rows.action.unsqueeze(-1)).squeeze(-1)
        return self.mixer(rows.of_living(chosen), seen[:, :, :-1]).unsqueeze(-1)

    @torch.no_grad()
    def _targets(self, batch: EpisodeBatch, utilities: Tensor, seen: Tensor) -> Tensor:
        """Return y = r + gamma Q_tot^-(s', argmax_a Q(o', a)) for the originals: [S, B, T, 1]."""
        following = self.target_policy.unroll(batch.obs, batch.action, batch.action_mask)[:, :, 1:]
        chooser = utilities[:, :, 1:] if self.config.double_q else following
        chosen = following.gather(-1, best(chooser).unsqueeze(-1)).squeeze(-1)
        chosen = batch.of_living(chosen, after=True)
        next_value = self.target_mixer(chosen, seen[:, :, 1:]).unsqueeze(-1)
        return self.td_targets(batch, batch.reward.mean(-1, keepdim=True), next_value)
