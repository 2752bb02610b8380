"""MADDPG (Lowe et al., 2017), plain or with a symmetry prior.

Agents share one deterministic actor, whose input is an agent's own observation. A centralised critic values joint
actions, and the actor follows its gradient. Supplement eq. 19 is added to the critic's loss, Eq. 8 to the actor's.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from esp_cli.algorithms.adam import SeedParameters
from esp_cli.algorithms.objectives import value_loss
from esp_cli.algorithms.off_policy import ExploringConfig, ExploringLearner
from esp_cli.algorithms.replay import EpisodeBatch
from esp_cli.networks.build import perceptron
from esp_cli.networks.contract import Generators, IoSpec, NetworkConfig
from esp_cli.networks.exploration import ActorHead, BoundedPoint, ExploringCategorical
from esp_cli.networks.heads import drawn
from esp_cli.networks.joint_q import PerAgentCriticInput
from esp_cli.networks.plain import MLP
from esp_cli.networks.policy import POLICY_GAIN, HistoryPolicy
from esp_cli.prior import Answers, Copies, mean_per_seed
from esp_envs.base import Environment
from esp_envs.spec import Discrete, TaskSpec


class MaddpgConfig(ExploringConfig):
    """Hyperparameters; every default stands here, or in `OffPolicyConfig`, and nowhere else."""

    learning_rate: float = Field(4e-3, gt=0, description="of the critic; paper: 7e-4")
    actor_learning_rate: float = Field(4e-3, gt=0, description="of the actor; paper: 7e-4")
    td_lambda: float = Field(0.6, ge=0, le=1, description="TD(lambda) along the episode; paper: 0, one-step targets")
    critic_activation: Literal["relu", "tanh"] = Field("relu", description="the actor's is network.activation")
    tau: float = Field(0.005, gt=0, le=1, description="share of the way that target networks go at each step")
    actor_actions: Literal["own", "all"] = Field(
        "all",
        description="the actor's gradient: all agents' actions are the policy's, and it follows the "
        "mean of the agents' Q (with actor_gradient=expected, each its own Q); paper: each agent's own alone is",
    )
    actor_gradient: Literal["sampled", "expected"] = Field(
        "sampled",
        description="discrete actions: straight-through of a draw, or that of the expected value over all of them",
    )
    output_penalty: float = Field(1e-3, ge=0, description="weight of the mean square of the actor's outputs")

    def without_effect(self, network: NetworkConfig, spec: Callable[[], TaskSpec]) -> frozenset[str]:
        own, idle = spec(), super().without_effect(network, spec)
        idle |= frozenset() if isinstance(own.action, Discrete) else frozenset({"actor_gradient"})
        shared = all(role.shared_reward for role, _ in own.parts)
        joint = shared and type(network).joint_critic is not NetworkConfig.joint_critic
        return idle | {"critic_activation"} if joint else idle


class Maddpg(ExploringLearner):
    """The learner: actor, centralised critic, their targets, optimisers and prior; arguments as of `Learner`."""

    config_class = MaddpgConfig
    watched = ("td_loss", "policy_loss", "critic_grad_norm", "actor_grad_norm")
    config: MaddpgConfig

    def build(self, env: Environment, network: NetworkConfig) -> None:
        super().build(env, network)
        config, spec, generators = self.config, self.spec, self.generators["learner"]
        self.head: ActorHead = self.policy.head  # type: ignore[assignment]
        if not spec.shared_reward:
            self.joint = PerAgentCriticInput(spec, config.critic_input)
        shape = perceptron(network, config.critic_activation)
        width = self.critic_width + spec.num_agents * self.head.num_outputs
        own = None
        if spec.shared_reward:
            io = IoSpec(spec, config.critic_input)
            own = network.joint_critic(generators, io, self.head.num_outputs, int(config.critic_sees_time))
        self.critic = (own or MLP(generators, width, 1, shape, 1.0)).to(self.device)
        self.target_policy = copy.deepcopy(self.policy).requires_grad_(False)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor_optimiser = self.adam(self.policy, learning_rate=config.actor_learning_rate)
        self.critic_optimiser = self.adam(self.critic, learning_rate=config.learning_rate)
        self._targets_of = [
            (SeedParameters([*self.target_policy.parameters()]), self.actor_optimiser.parameters),
            (SeedParameters([*self.target_critic.parameters()]), self.critic_optimiser.parameters),
        ]
        targets = {"target_policy": self.target_policy, "target_critic": self.target_critic}
        self.modules |= {"critic": self.critic, **targets}
        self.optimisers = {"actor": self.actor_optimiser, "critic": self.critic_optimiser}
        # In units of one step's standardised reward: divided by the root of the horizon, its gradient would be so small
        # that Adam's epsilon slows the actor down.
        self._value_scale = spec.horizon**0.5

    @classmethod
    def build_policy(cls, spec: TaskSpec, network: NetworkConfig, generators: Generators) -> HistoryPolicy:
        kind = ExploringCategorical if isinstance(spec.action, Discrete) else BoundedPoint
        return HistoryPolicy(spec, network, generators, kind(spec.action, len(generators)), POLICY_GAIN)

    def update(self, batch: EpisodeBatch) -> dict[str, Tensor]:
        """Take one gradient step of the critic, then one of the actor, then move the targets."""
        copies = self.prior.copies(batch, self.generators["prior"])
        seen = self.critic_rows(copies.rows)
        here = seen[:, :, :-1]
        metrics = self._learn_critic(copies, seen, here) | self._learn_actor(copies, here)
        for target, online in self._targets_of:
            target.buffer.lerp_(online.buffer, self.config.tau)
        return metrics

    def answers(self, rows: EpisodeBatch) -> Answers:
        values = self.joint.value(self.critic, self.critic_rows(rows)[:, :, :-1], self._encoded(rows))
        return {"policy": (self.head, self._outputs(rows)), "value": values}

    def _outputs(self, rows: EpisodeBatch) -> Tensor:
        """Return the actor's outputs [S, B, T, N, A] for every step."""
        return self.policy.unroll(rows.obs[:, :, :-1], rows.action, rows.action_mask)

    def _learn_critic(self, copies: Copies[EpisodeBatch], seen: Tensor, here: Tensor) -> dict[str, Tensor]:
        """Take one gradient step down L_TD + c S_Q (supplement eq. 19).

        The critic sees `seen` of every row [S, B (1 + copies), T + 1(, N), critic width], `here` without final states.
        """
        values = self.joint.value(self.critic, here, self._encoded(copies.rows))
        target = self._targets(copies.originals, copies.original(seen))
        loss = value_loss(values, target, copies, self.config.huber_delta) + copies.penalty(value=values)
        (norm,) = self.critic_optimiser.step(loss)
        return self.td_metrics(copies.original(values), target, copies.originals) | {"critic_grad_norm": norm}

    def _learn_actor(self, copies: Copies[EpisodeBatch], here: Tensor) -> dict[str, Tensor]:
        """Take one gradient step down -Q(s, pi(o)) + penalty + c S_pi; `here` is what the critic sees of every row."""
        rows, batch = copies.originals, copies.loss_rows
        lead = (rows.count, self.spec.horizon, self.spec.num_agents, self.head.num_outputs)
        noise = copies.tiled(drawn(torch.rand, lead, self.generators["learner"]).to(self.device, non_blocking=True))
        outputs = self._outputs(copies.rows)
        chosen = copies.for_loss(outputs)
        for p in self.critic_optimiser.parameters.parameters:  # a module looks for them each time
            p.requires_grad_(False)
        value = self._value_of_policy(copies.for_loss(here), chosen, noise, batch)
        policy_loss = -self._value_scale * mean_per_seed(value, batch.mask)
        loss = policy_loss + self.config.output_penalty * mean_per_seed(self.head.penalty(chosen), batch.mask)
        (norm,) = self.actor_optimiser.step(loss + copies.penalty(policy=(self.head, outputs)))
        for p in self.critic_optimiser.parameters.parameters:
            p.requires_grad_(True)
        metrics = {name: mean_per_seed(x, batch.mask) for name, x in self.head.statistics(chosen.detach()).items()}
        return metrics | {"policy_loss": policy_loss, "actor_grad_norm": norm}

    def _encoded(self, rows: EpisodeBatch) -> Tensor:
        """Return what was done as the critic reads it [S, B, T, N, A]; zeros for an agent that has ended."""
        return rows.of_living(self.head.encode(rows.action))

    def _value_of_policy(self, seen: Tensor, outputs: Tensor, noise: Tensor, rows: EpisodeBatch) -> Tensor:
        """Return Q where the policy acts, through which the actor's gradient flows: [S, B, T, N or 1].

        The critic sees `seen` [S, B, T(, N), critic width]; noise of the shape of `outputs` is uniform in [0, 1).
        """
        head, together = self.head, self.config.actor_actions == "all"
        if self.config.actor_gradient == "expected" and isinstance(head, ExploringCategorical):
            joint = rows.of_living(head.relaxed(outputs, noise).detach()) if together else self._encoded(rows)
            values = self.joint.exchanged(self.critic, seen, joint, head.choices.expand(*joint.shape, -1))
            return (outputs.exp() * values).sum(-1)
        own = rows.of_living(head.relaxed(outputs, noise))
        if together:
            return self.joint.value(self.critic, seen, own)
        return self.joint.exchanged(self.critic, seen, self._encoded(rows), own.unsqueeze(-2)).squeeze(-1)

    @torch.no_grad()
    def _targets(self, batch: EpisodeBatch, seen: Tensor) -> Tensor:
        """Return y = r + gamma Q^-(s', pi^-(o')) for the originals: [S, B, T, C]."""
        outputs = self.target_policy.unroll(batch.obs, batch.action, batch.action_mask)[:, :, 1:]
        following = batch.of_living(self.head.encode(self.head.mode(outputs)), after=True)
        return self.td_targets(batch, batch.reward, self.joint.value(self.target_critic, seen[:, :, 1:], following))
