"""MASAC: soft actor-critic (Haarnoja et al., 2018) for many agents, plain or with a symmetry prior.

Agents share one stochastic actor. Twin centralised critics value joint actions, and the smaller of both values counts.
The temperature alpha of each seed keeps the policy's entropy near a target.

    esp train --algo masac:Masac --task navigation --out runs/masac
    esp eval runs/masac --algo masac:Masac
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn.functional import softplus

from esp_cli.algorithms.objectives import value_loss
from esp_cli.algorithms.off_policy import OffPolicyConfig, OffPolicyLearner
from esp_cli.algorithms.replay import EpisodeBatch
from esp_cli.networks.build import perceptron
from esp_cli.networks.contract import NetworkConfig
from esp_cli.networks.heads import BoundedGaussian, Categorical
from esp_cli.networks.joint_q import PerAgentCriticInput
from esp_cli.networks.plain import MLP
from esp_cli.networks.policy import POLICY_GAIN, HistoryPolicy
from esp_cli.prior import Answers, Copies, mean_per_seed
from esp_envs.base import Environment
from esp_envs.spec import ActionSpace, Discrete, TaskSpec


class MasacConfig(OffPolicyConfig):
    """Hyperparameters; those of the replay are in `OffPolicyConfig`."""

    learning_rate: float = Field(4e-3, gt=0, description="of the critics")
    actor_learning_rate: float = Field(4e-3, gt=0, description="of the actor")
    temperature_learning_rate: float = Field(0.02, gt=0, description="of log alpha")
    td_lambda: float = Field(0.6, ge=0, le=1, description="TD(lambda) along the episode; original: 0")
    tau: float = Field(0.005, gt=0, le=1, description="share of the way that target critics go at each step")
    initial_temperature: float = Field(0.5, gt=0, description="alpha at the start, in standardised rewards of a step")
    target_entropy: float | None = Field(
        None, description="of one agent, in nats; none: 0.5 log A of A actions, or -1 for each number of an action"
    )


class SquashedGaussian(BoundedGaussian):
    """A bounded Gaussian whose log-probability is that of the action after the squash."""

    def squashed_log_prob(self, outputs: Tensor, latent: Tensor) -> Tensor:
        """Return log pi(a) = log N(u) - log |det da/du| of a = squash(u): [S, B, T, N].

        A vector of d numbers u with r = |u| is squashed to u tanh(r) / r, which stretches lengths by 1 - tanh(r)^2
        and the d - 1 directions across by tanh(r) / r. For one number this is the usual 1 - tanh(u)^2.
        """
        length = (latent.square() @ self.disc + 1e-12).sqrt()  # that of its vector, for each number
        along = 2 * (math.log(2) - length - softplus(-2 * length))
        across = (torch.tanh(length) / length).log()
        width = self.disc.sum(0)
        return self.log_prob(outputs, latent) - ((along + (width - 1) * across) / width).sum(-1)


class Temperature(nn.Module):
    """alpha, one for each seed."""

    def __init__(self, num_seeds: int, initial: float) -> None:
        super().__init__()
        self.log = nn.Parameter(torch.full((num_seeds, 1), math.log(initial)))

    def forward(self, like: Tensor) -> Tensor:
        """Return alpha, shaped to stand beside numbers [S, ...]; no gradient flows to it."""
        return self.log.detach().exp().view(-1, *[1] * (like.dim() - 1))

    def loss(self, entropy: Tensor, target: float) -> Tensor:
        """Return log alpha (H - target) of entropies [S]: alpha rises while the entropy is below its target."""
        return self.log.squeeze(1) * (entropy.detach() - target)


class Masac(OffPolicyLearner):
    """The learner: actor, twin critics, their targets, temperature, optimisers and prior."""

    config_class = MasacConfig
    watched = ("td_loss", "policy_loss", "critic_grad_norm", "actor_grad_norm")
    config: MasacConfig

    def build(self, env: Environment, network: NetworkConfig) -> None:
        """Make all that the learner consists of; see `Learner.build`."""
        super().build(env, network)
        config, spec, generators = self.config, self.spec, self.generators["learner"]
        self.head: Categorical | SquashedGaussian = self.policy.head  # type: ignore[assignment]
        if not spec.shared_reward:
            self.joint = PerAgentCriticInput(spec, config.critic_input)
        width = self.critic_width + spec.num_agents * self.head.num_outputs
        shape = perceptron(network, "relu")
        critics = [MLP(generators, width, 1, shape, 1.0) for _ in range(2)]
        self.critics = nn.ModuleList(critics).to(self.device)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.temperature = Temperature(env.num_seeds, config.initial_temperature).to(self.device)
        self.target_entropy = config.target_entropy
        if config.target_entropy is None:
            self.target_entropy = default_target_entropy(spec.action)
        self.modules |= {"critics": self.critics, "target_critics": self.target_critics}
        self.modules["temperature"] = self.temperature
        self.optimisers = {
            "actor": self.adam(self.policy, learning_rate=config.actor_learning_rate),
            "critic": self.adam(self.critics, learning_rate=config.learning_rate),
            "temperature": self.adam(self.temperature, learning_rate=config.temperature_learning_rate),
        }
        self.scale = spec.horizon**0.5  # values are in rewards divided by it, alpha is in rewards of a step

    @classmethod
    def build_policy(
        cls, spec: TaskSpec, network: NetworkConfig, generators: Sequence[torch.Generator]
    ) -> HistoryPolicy:
        """Return new stochastic policies."""
        space, count = spec.action, len(generators)
        head = Categorical(space) if isinstance(space, Discrete) else SquashedGaussian(space, count)
        return HistoryPolicy(spec, network, generators, head, POLICY_GAIN)

    def update(self, batch: EpisodeBatch) -> dict[str, Tensor]:
        """Take one gradient step of critics, actor and temperature, then move the target critics."""
        copies = self.prior.copies(batch, self.generators["prior"])
        seen = self.critic_rows(copies.rows)
        metrics = self.learn_critics(copies, seen) | self.learn_actor(copies, seen[:, :, :-1])
        targets, online = list(self.target_critics.parameters()), list(self.critics.parameters())
        with torch.no_grad():
            torch._foreach_lerp_(targets, online, self.config.tau)
        return metrics

    def learn_critics(self, copies: Copies[EpisodeBatch], seen: Tensor) -> dict[str, Tensor]:
        """Take one gradient step of both critics down L_TD + c S_Q (supplement eq. 19)."""
        batch, here, done = copies.originals, seen[:, :, :-1].contiguous(), self.encoded(copies.rows)
        target = self.targets(batch, copies.original(seen))
        values = [self.joint.value(critic, here, done) for critic in self.critics]
        first, second = (
            value_loss(value, target, copies, self.config.huber_delta) + copies.penalty(value=value) for value in values
        )
        (norm,) = self.optimisers["critic"].step(first + second)
        return self.td_metrics(copies.original(values[0]), target, batch) | {"critic_grad_norm": norm}

    def learn_actor(self, copies: Copies[EpisodeBatch], here: Tensor) -> dict[str, Tensor]:
        """Take one gradient step down E[alpha log pi(a) - Q(s, a)] + c S_pi (Eq. 8), then one of the temperature."""
        rows = copies.loss_rows
        outputs = self.policy.unroll(copies.rows.obs[:, :, :-1], copies.rows.action, copies.rows.action_mask)
        self.critics.requires_grad_(False)
        policy_loss, entropy = self.policy_loss(copies.for_loss(outputs), copies.for_loss(here).contiguous(), rows)
        (norm,) = self.optimisers["actor"].step(policy_loss + copies.penalty(policy=(self.head, outputs)))
        self.critics.requires_grad_(True)
        entropy = mean_per_seed(entropy.detach(), rows.mask)
        self.optimisers["temperature"].step(self.temperature.loss(entropy, self.target_entropy))
        alpha = self.temperature(entropy)
        return {"policy_loss": policy_loss, "actor_grad_norm": norm, "entropy": entropy, "temperature": alpha}

    def policy_loss(self, outputs: Tensor, here: Tensor, rows: EpisodeBatch) -> tuple[Tensor, Tensor]:
        """Return E[alpha log pi(a) - Q(s, a)], [S], and the entropy, [S, B, T, N].

        Continuous actions are reparameterised, so that the gradient flows through the critics. Of discrete actions the
        expectation over each agent's own is taken, while the others' are drawn.
        """
        latent, entropy = self.drawn(outputs)
        joint = rows.of_living(self.head.encode(latent))
        if isinstance(self.head, SquashedGaussian):
            q = self.smaller(self.joint.value(critic, here, joint) for critic in self.critics)
            gain = self.scale * q + self.per_value(rows.of_living(self.temperature(entropy) * entropy))
            return -mean_per_seed(gain, rows.valued(gain.shape[-1])), entropy
        choices = torch.eye(self.head.num_outputs, device=joint.device).expand(*joint.shape, -1)
        with torch.no_grad():
            q = self.smaller(self.joint.exchanged(critic, here, joint, choices) for critic in self.critics)
        gain = self.scale * (outputs.exp() * q).sum(-1) + self.temperature(entropy) * entropy
        return -mean_per_seed(gain, rows.mask), entropy

    @torch.no_grad()
    def targets(self, batch: EpisodeBatch, seen: Tensor) -> Tensor:
        """Return y = r + gamma (min Q^-(s', a') - alpha log pi(a')) of the originals, a' drawn: [S, B, T, C]."""
        outputs = self.policy.unroll(batch.obs, batch.action, batch.action_mask)[:, :, 1:]
        latent, entropy = self.drawn(outputs)
        joint = batch.of_living(self.head.encode(latent), after=True)
        q = self.smaller(self.joint.value(critic, seen[:, :, 1:], joint) for critic in self.target_critics)
        bonus = batch.of_living(self.temperature(entropy) * entropy, after=True) / self.scale
        return self.td_targets(batch, batch.reward, q, self.per_value(bonus))

    def drawn(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return drawn actions, and the entropy [S, B, T, N], which of continuous ones is that of the draw alone."""
        noise = self.head.noise(outputs.shape[1:-1], self.generators["learner"]).to(self.device, non_blocking=True)
        action = self.head.sample(outputs, noise)
        if isinstance(self.head, SquashedGaussian):
            return action, -self.head.squashed_log_prob(outputs, action)
        return action, self.head.entropy(outputs)

    def encoded(self, rows: EpisodeBatch) -> Tensor:
        """Return what was done as the critics read it: [S, B, T, N, A]."""
        return rows.of_living(self.head.encode(rows.action))

    def per_value(self, entropy: Tensor) -> Tensor:
        """Return entropies [S, B, T, N] as the values count them: summed over a team that shares its reward."""
        return entropy.sum(-1, keepdim=True) if self.spec.shared_reward else entropy

    @staticmethod
    def smaller(values: Iterable[Tensor]) -> Tensor:
        """Return the smaller of both critics' values."""
        first, second = values
        return torch.minimum(first, second)

    def answers(self, rows: EpisodeBatch) -> Answers:
        """Return what actor and critic say of rows, for `SymmetryPrior.errors`."""
        outputs = self.policy.unroll(rows.obs[:, :, :-1], rows.action, rows.action_mask)
        value = self.joint.value(self.critics[0], self.critic_rows(rows)[:, :, :-1], self.encoded(rows))
        return {"policy": (self.head, outputs), "value": value}


def default_target_entropy(space: ActionSpace) -> float:
    """Return 0.5 log A of A discrete actions, or -1 for each number of a continuous action."""
    return 0.5 * math.log(space.count) if isinstance(space, Discrete) else -float(space.width)
