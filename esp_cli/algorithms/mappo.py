"""Multi-agent proximal policy optimisation (Yu et al., 2022), plain or with a symmetry prior.

The update follows the paper's order: advantages (GAE), the clipped objective of Eq. 3 and 7, the critic's loss of
Eq. 4, the consistency terms of Eq. 8 and 9, combined as in Eq. 10.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from esp_cli.algorithms.adam import SeedAdam
from esp_cli.algorithms.learner import Iteration, Learner, LearnerConfig
from esp_cli.algorithms.normalisation import ValueNormaliser
from esp_cli.algorithms.objectives import (
    beside,
    clipped_surrogate,
    explained_variance,
    gae,
    normalise_per_seed,
    ppo_loss,
    value_error,
    value_loss,
)
from esp_cli.algorithms.rollout import Batch, Collector, LoneBatch, Rollout, values_along
from esp_cli.networks.contract import Generators, NetworkConfig, Reads
from esp_cli.networks.policy import Critic, StochasticPolicy
from esp_cli.prior import Answers, Copies, Loss, mean_per_seed
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec

# environment steps per seed on which the symmetry errors are measured after every update: fewer of many agents
PROBE_STEPS, PROBE_ROWS = 100, 1600
# metrics that have to be finite for a seed to go on
WATCHED = ("policy_loss", "value_loss", "actor_grad_norm", "critic_grad_norm")


class MappoConfig(LearnerConfig):
    """Hyperparameters; every default stands here and nowhere else."""

    num_envs: int = Field(32, ge=1, description="worlds per seed; MAPPO paper on MPE: 128")
    num_steps: int = Field(25, ge=1, description="steps per world and update")
    num_epochs: int = Field(10, ge=1, le=1000, description="passes over a rollout")
    num_minibatches: int = Field(4, ge=1, le=10_000, description="gradient steps per pass; paper: 1")
    learning_rate: float = Field(1e-3, gt=0, description="of Adam, for actor and critic; paper: 7e-4")
    anneal_learning_rate: bool = Field(True, description="linearly to 0 over the run")
    adam_epsilon: float = Field(1e-5, gt=0, description="Adam's epsilon")
    max_grad_norm: float = Field(10.0, gt=0, description="per seed; actor and critic apart")
    gamma: float = Field(0.99, ge=0, le=1, description="discount")
    gae_lambda: float = Field(0.95, ge=0, le=1, description="lambda of generalised advantage estimation")
    clip_epsilon: float = Field(0.2, gt=0, description="range of the ratio's clip, and of the value's")
    clip_value: bool = Field(False, description="MAPPO paper: on; ours off, it slows learning badly")
    huber_delta: float = Field(10.0, gt=0, description="where the value loss becomes linear, in normalised units")
    value_coef: float = Field(1.0, gt=0, description="weight of the value loss")
    entropy_coef: float = Field(0.01, ge=0, description="weight of the entropy bonus")
    anneal_entropy: bool = Field(True, description="linearly to 0 over the run")
    bootstrap_truncated: bool = Field(True, description="value the final state where the horizon cuts an episode")
    value_decay: float = Field(0.99, gt=0, lt=1, description="of the value normaliser; MAPPO paper: 0.99999")
    critic_input: Reads = Field(
        "observations",
        description="the task's global state, all agents' observations in a row, or each agent's own observation",
    )
    critic_activation: Literal["relu", "tanh"] = Field("relu", description="the actor's is network.activation")
    truncation: int = Field(10, ge=0, description="recurrent networks: steps through which gradients flow")
    chunk_steps: int = Field(
        8000,
        ge=1,
        description="environment steps, over all seeds, of a forward pass; speed only, and a whole minibatch where "
        "agents end one by one",
    )

    def without_effect(self, network: NetworkConfig, spec: Callable[[], TaskSpec]) -> frozenset[str]:
        idle = set() if network.recurrent else {"truncation"}
        if network.with_activation("relu") == network.with_activation("tanh"):
            idle.add("critic_activation")
        if self.entropy_coef == 0:
            idle.add("anneal_entropy")
        return frozenset(idle)


class Mappo(Learner):
    """The learner: policy, centralised critic, optimiser and prior of S seeds; arguments as of `Learner`."""

    config_class = MappoConfig
    config: MappoConfig
    policy: StochasticPolicy
    collector: Collector

    def build(self, env: Environment, network: NetworkConfig) -> None:
        config, spec, device, generators = self.config, self.spec, self.device, self.generators["learner"]
        self.policy = self.build_policy(spec, network, generators).to(device)
        critic_network = network.with_activation(config.critic_activation)
        self.critic = Critic(spec, config.critic_input, critic_network, generators).to(device)
        self.num_values = self.critic.num_values
        if spec.agents_end and spec.shared_reward and self.num_values > 1:
            raise UserError(
                f"mappo.critic_input=own values each agent up to its own end, but agents of {spec.name} share a reward "
                "that goes on behind it; set mappo.critic_input to observations or state"
            )
        self.normaliser = ValueNormaliser(env.num_seeds, config.value_decay).to(device)
        self.recurrent = self.policy.actor.memory_width > 0
        if self.recurrent and spec.terminates:
            raise UserError(
                f"mappo needs episodes of one length for a recurrent network, but those of {spec.name} may end early; "
                "choose a network without memory"
            )
        if self.recurrent and config.num_steps % spec.horizon:
            raise UserError(
                f"a recurrent network needs whole episodes: set mappo.num_steps to a multiple of {spec.horizon}"
            )
        sequences = config.num_envs * config.num_steps // (spec.horizon if self.recurrent else 1)
        if config.num_minibatches > sequences:
            raise UserError(
                f"mappo.num_minibatches is {config.num_minibatches}, but a rollout has {sequences} rows to share"
            )
        self.optimiser = SeedAdam(
            list(self.policy.parameters()),
            list(self.critic.parameters()),
            learning_rate=config.learning_rate,
            epsilon=config.adam_epsilon,
            max_grad_norm=config.max_grad_norm,
        )
        self.modules = {"policy": self.policy, "critic": self.critic, "normaliser": self.normaliser}
        self.optimisers = {"adam": self.optimiser}
        self.collector = Collector(env, self.policy, self.generators["learner"])
        self._old: tuple[StochasticPolicy, Critic] | None = None

    @classmethod
    def build_policy(cls, spec: TaskSpec, network: NetworkConfig, generators: Generators) -> StochasticPolicy:
        return StochasticPolicy(spec, network, generators)

    @property
    def steps_per_iteration(self) -> int:
        return self.config.num_envs * self.config.num_steps

    def iterate(self, progress: float) -> Iteration:
        rollout = self.collector.collect(self.config.num_steps)
        metrics = {"train/return": self.collector.pop_mean_return(), **self.update(rollout, progress)}
        return self.iteration(metrics, *(metrics[f"train/{name}"] for name in WATCHED))

    def update(self, rollout: Rollout, progress: float) -> dict[str, Tensor]:
        """Learn from a rollout by epochs of minibatches, each one gradient step, and return metrics, [S] each."""
        config = self.config
        remaining = 1.0 - progress
        if config.anneal_learning_rate:
            self.anneal(remaining)
        entropy_coef = config.entropy_coef * (remaining if config.anneal_entropy else 1.0)

        batch, metrics = self.prepare(rollout)
        self._remember_old_networks()
        for epoch in range(config.num_epochs):
            is_last = epoch == config.num_epochs - 1
            sums: dict[str, Tensor] = {}
            for minibatch in self._minibatches(batch):
                self._gradient_step(minibatch, entropy_coef, sums if is_last else None)
        metrics |= {f"train/{name}": value / config.num_minibatches for name, value in sums.items()}
        metrics["train/augmented_share"] = self.prior.augmented_share(batch.obs.shape[0])
        num_steps, num_agents = batch.obs.shape[2:4]
        probed = batch.first(max(1, min(PROBE_STEPS, PROBE_ROWS // num_agents) // num_steps))
        errors = self.prior.errors(probed, self.answers)
        return metrics | {f"train/{name}": error for name, error in errors.items()}

    def prepare(self, rollout: Rollout) -> tuple[Batch, dict[str, Tensor]]:
        """Value every state, estimate advantages, and shape the rollout into sequences."""
        config = self.config
        reward = rollout.reward.mean(-1, keepdim=True) if self.num_values == 1 else rollout.reward
        steps = 1 / max(1 - config.gamma * config.gae_lambda, 1 / self.spec.horizon)
        self.normaliser.begin(reward, steps, centres=not (self.spec.terminates or self.spec.agents_end))
        reward = (reward - beside(self.normaliser.offset, reward)).to(reward.dtype)
        with torch.no_grad():
            episode = self.spec.horizon if self.recurrent else None
            raw_value, raw_next = values_along(self.critic, rollout, episode, self.spec.terminates)
        value, next_value = self.normaliser.denormalise(raw_value), self.normaliser.denormalise(raw_next)
        ended = rollout.ended.unsqueeze(-1)
        terminated = rollout.terminated.unsqueeze(-1) if config.bootstrap_truncated else ended
        valid = None
        if rollout.alive is not None and rollout.gone is not None and not self.spec.shared_reward:
            # what follows an agent's end is not its
            terminated, ended, valid = terminated | rollout.gone, ended | rollout.gone, rollout.alive
        advantage = gae(reward, value, next_value, terminated, ended, config.gamma, config.gae_lambda)
        target = advantage + value
        self.normaliser.update(target, valid)
        if rollout.alive is not None:
            advantage = advantage.expand(rollout.log_prob.shape)
        per_agent = normalise_per_seed(advantage, valid=rollout.alive).expand(rollout.log_prob.shape)
        done = (rollout.obs, rollout.state, rollout.action, rollout.log_prob)
        fields = (*done, per_agent, self.normaliser.normalise(target), raw_value)
        flags = {"action_mask": rollout.action_mask, "alive": rollout.alive}
        known = {name: self._as_sequences(flag) for name, flag in flags.items() if flag is not None}
        kind = LoneBatch if self.spec.num_agents == 1 and not self.spec.shared_reward else Batch
        batch = kind(*(self._as_sequences(x) for x in fields), **known)
        return batch, {"train/explained_variance": explained_variance(value, target, valid)}

    def _as_sequences(self, x: Tensor) -> Tensor:
        """Shape [S, E, T, ...] into [S, E * T, 1, ...], or into whole episodes [S, E * k, horizon, ...]."""
        length = self.spec.horizon if self.recurrent else 1
        return x.unflatten(2, (-1, length)).flatten(1, 2)

    def _remember_old_networks(self) -> None:
        needed = self.prior.augments and (self.prior.recomputes or self.config.clip_value)
        self._old = (copy.deepcopy(self.policy), copy.deepcopy(self.critic)) if needed else None

    @torch.no_grad()
    def reevaluated(self, copied: Batch) -> Batch:
        """Return copies with old log-probability and old value under the networks that collected the rollout.

        The old log-probability stays that of the original unless the prior recomputes it. The old value, which only
        value clipping reads, is always recomputed.
        """
        if self._old is None:
            return copied
        policy, critic = self._old
        if self.prior.recomputes:
            outputs = policy.unroll(copied.obs, action_mask=copied.action_mask)
            copied = replace(copied, log_prob=policy.head.log_prob(outputs, copied.action))
        if self.config.clip_value:
            copied = replace(copied, value=critic.unroll(copied.obs, copied.state))
        return copied

    def _minibatches(self, batch: Batch) -> list[Batch]:
        count, parts = batch.obs.shape[1], self.config.num_minibatches
        if parts == 1:
            return [batch]
        order = torch.stack([torch.randperm(count, generator=g) for g in self.generators["learner"]])
        order = order.to(self.device, non_blocking=True)
        size = count // parts
        return batch.select(order[:, : parts * size]).chunks(size)

    def _gradient_step(self, minibatch: Batch, entropy_coef: float, sums: dict[str, Tensor] | None) -> None:
        """Take one gradient step, accumulated over chunks small enough for the processor's cache."""
        adapt = None if self._old is None else self.reevaluated
        copies = self.prior.copies(minibatch, self.generators["prior"], adapt)
        num_seeds, total, length = minibatch.obs.shape[:3]
        size = max(1, self.config.chunk_steps // (num_seeds * length))
        if minibatch.alive is not None:
            size = total  # a mean over the living of the whole minibatch
        gradients = []
        for chunk in copies.chunks(size):
            weight = chunk.originals.count / total
            gradient = self.optimiser.gradient(self.loss(chunk, entropy_coef, weight, sums))
            gradients.append(gradient if weight == 1 else gradient.mul_(weight))
        actor_norm, critic_norm = self.optimiser.apply(sum(gradients[1:], start=gradients[0]))
        if sums is not None:
            _add(sums, 1.0, actor_grad_norm=actor_norm, critic_grad_norm=critic_norm)

    def loss(self, copies: Copies[Batch], entropy_coef: float, weight: float, sums: dict[str, Tensor] | None) -> Loss:
        """Return the negative of J_ESP = J_MAPPO - c (S_pi + S_V) (Eq. 10) per seed: [S].

        The copies are a chunk of a minibatch, `weight` its share of it. What is logged is added to `sums`, if given.
        """
        config, head, state = self.config, self.policy.head, copies.originals.state
        outputs = self.policy.unroll_with_vjp(copies.obs, config.truncation, copies.action_mask)
        state = copies.state if self.critic.reads == "state" else state
        values = self.critic.unroll_with_vjp(copies.obs, state, config.truncation)
        if sums is not None:
            self._watch(copies.originals, copies.original(outputs.tensor), copies.original(values.tensor), weight, sums)
        loss = ppo_loss(head, outputs, copies, config.clip_epsilon, entropy_coef)
        clip = config.clip_epsilon if config.clip_value else None
        loss = loss + config.value_coef * value_loss(values, copies.originals.target, copies, config.huber_delta, clip)
        return loss + copies.penalty(policy=(head, outputs), value=values)

    @torch.no_grad()
    def _watch(self, batch: Batch, outputs: Tensor, values: Tensor, weight: float, sums: dict[str, Tensor]) -> None:
        """Add what is logged of a chunk of originals to the sums, from what policy and critic say of it."""
        config, head = self.config, self.policy.head
        outputs = head.normalise(outputs)
        log_ratio = head.log_prob(outputs, batch.action) - batch.log_prob
        ratio = log_ratio.exp()
        parts = {
            "clip_fraction": ((ratio - 1).abs() > config.clip_epsilon).float(),
            "kl": ratio - 1 - log_ratio,
            "entropy": head.entropy(outputs),
            "policy_loss": -clipped_surrogate(log_ratio, batch.advantage, config.clip_epsilon),
        }
        means = {name: mean_per_seed(part, batch.mask) for name, part in parts.items()}
        old = batch.value if config.clip_value else None
        error = value_error(values, batch.target, config.huber_delta, old, config.clip_epsilon)
        _add(sums, weight, **means, value_loss=mean_per_seed(error, batch.valued(self.num_values)))

    def answers(self, rows: Batch) -> Answers:
        """Return what policy and critic say of rows, for `SymmetryPrior.errors`."""
        outputs = self.policy.unroll(rows.obs, action_mask=rows.action_mask)
        return {"policy": (self.policy.head, outputs), "value": self.critic.unroll(rows.obs, rows.state)}


def _add(sums: dict[str, Tensor], weight: float, **values: Tensor) -> None:
    for name, value in values.items():
        sums[name] = sums.get(name, 0.0) + weight * value.detach()
