"""What off-policy learners share: collect whole episodes, store them, draw batches, take gradient steps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor, nn

from esp_cli.algorithms.adam import SeedAdam
from esp_cli.algorithms.learner import Iteration, Learner, LearnerConfig, below, under
from esp_cli.algorithms.normalisation import ValueNormaliser
from esp_cli.algorithms.objectives import td_targets, value_error
from esp_cli.algorithms.replay import EpisodeBatch, EpisodeCollector, EpisodeReplay
from esp_cli.networks.contract import NetworkConfig
from esp_cli.networks.exploration import ExploringHead
from esp_cli.networks.joint_q import SharedCriticInput
from esp_cli.networks.policy import HistoryPolicy
from esp_cli.prior import Answers, mean_per_seed
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec


class OffPolicyConfig(LearnerConfig):
    """Hyperparameters of off-policy learners; every default stands here, or in the algorithm's own file."""

    num_envs: int = Field(8, ge=1, description="worlds per seed, one episode each a round; paper: 1")
    rounds: int = Field(1, ge=1, le=1000, description="rounds of collecting and learning between two lines of metrics")
    updates_per_episode: int = Field(1, ge=1, le=10_000, description="gradient steps per collected episode")
    batch_episodes: int = Field(32, ge=1, description="episodes per seed of a gradient step")
    replay_episodes: int = Field(1000, ge=1, description="episodes that each seed remembers; paper: 5000")
    warmup_episodes: int = Field(5, ge=0, description="episodes of random actions before learning begins")
    learning_rate: float = Field(gt=0, description="of Adam")
    anneal_learning_rate: bool = Field(True, description="linearly to 0 over the run; paper: off")
    adam_epsilon: float = Field(1e-5, gt=0, description="Adam's epsilon")
    max_grad_norm: float = Field(10.0, gt=0, description="per seed, of each optimiser")
    gamma: float = Field(0.99, ge=0, le=1, description="discount")
    td_lambda: float = Field(ge=0, le=1, description="0: one-step targets; above: TD(lambda) along the episode")
    huber_delta: float = Field(10.0, gt=0, description="where the TD loss becomes linear, in normalised units")
    bootstrap_truncated: bool = Field(False, description="value the final state where the horizon cuts an episode")
    reward_decay: float = Field(0.999, gt=0, lt=1, description="of the reward statistics, per episode")
    critic_input: Literal["state", "observations"] = Field(
        "observations", description="what the critic (the mixer) sees: the global state, or all observations in a row"
    )
    critic_sees_time: bool = Field(True, description="the critic (the mixer) also sees the share of the horizon gone")


class ExploringConfig(OffPolicyConfig):
    """Hyperparameters of learners that explore by a schedule."""

    epsilon_start: float = Field(1.0, ge=0, le=1, description="exploration at the start")
    epsilon_finish: float = Field(0.05, ge=0, le=1, description="exploration at the end")
    epsilon_steps: int = Field(50_000, ge=1, description="environment steps from start to finish, linearly")

    def without_effect(self, network: NetworkConfig, spec: Callable[[], TaskSpec]) -> frozenset[str]:
        return frozenset({"epsilon_steps"}) if self.epsilon_start == self.epsilon_finish else frozenset()


class OffPolicyLearner(Learner):
    """Replay, behaviour, targets and the prior's copies; a subclass says what a gradient step is.

    The policy draws its actions as its head does; see `ExploringLearner` for a schedule of exploration.

    Arguments as of `Learner`.
    """

    replays = True
    watched: ClassVar[tuple[str, ...]]  # names of what `update` returns that has to be finite for a seed to go on
    config: OffPolicyConfig
    policy: HistoryPolicy
    collector: EpisodeCollector

    def build(self, env: Environment, network: NetworkConfig) -> None:
        config, spec, device, generators = self.config, self.spec, self.device, self.generators["learner"]
        per_round = config.num_envs * (1 + self.prior.num_stored)
        if per_round > config.replay_episodes:
            raise UserError(
                f"one round brings {per_round} episodes, but replay_episodes is {config.replay_episodes}; raise it"
            )
        self.joint = SharedCriticInput(spec, config.critic_input)
        self.policy = self.build_policy(spec, network, generators).to(device)  # type: ignore[assignment]
        self.reward_scale = ValueNormaliser(env.num_seeds, config.reward_decay**config.num_envs).to(device)
        self.replay = EpisodeReplay(spec, env.num_seeds, config.replay_episodes, device)
        self.collector = EpisodeCollector(env, self.policy, generators)
        self.modules = {"policy": self.policy, "reward_scale": self.reward_scale}
        self.episodes = self.updates = 0
        self._time = torch.linspace(0, 1, spec.horizon + 1, device=device)

    @property
    def steps_per_iteration(self) -> int:
        return self.config.rounds * self.config.num_envs * self.spec.horizon

    @property
    def critic_width(self) -> int:
        """Numbers that the critic or the mixer sees of a state."""
        return self.joint.width + self.config.critic_sees_time

    def iterate(self, progress: float) -> Iteration:
        config, sums, returns = self.config, dict[str, Tensor](), []
        if config.anneal_learning_rate:
            self.anneal(1.0 - progress)
        learned = 0
        for _ in range(config.rounds):
            explored = self.explore()
            episodes, mean_return = self.collector.collect()
            returns.append(mean_return)
            self._store(episodes)
            if self.episodes < config.warmup_episodes:
                continue
            for _ in range(config.num_envs * config.updates_per_episode):
                batch = self.replay.sample(config.batch_episodes, self.generators["learner"])
                for name, value in self.update(batch).items():
                    sums[name] = sums.get(name, 0.0) + value.detach()
                self.updates += 1
                learned += 1
        metrics = {"train/return": torch.stack(returns).mean(0), **explored}
        metrics["train/augmented_share"] = self.prior.augmented_share(len(mean_return))
        if learned:
            metrics |= {f"train/{name}": value / learned for name, value in sums.items()}
            errors = self.prior.errors(batch.first(PROBE_EPISODES), self.answers)
            metrics |= {f"train/{name}": error for name, error in errors.items()}
        return self.iteration(metrics, *(value for name, value in sums.items() if name in self.watched))

    @abstractmethod
    def update(self, batch: EpisodeBatch) -> dict[str, Tensor]:
        """Take one gradient step on a batch of originals and return what is logged of it, each [S]."""

    @abstractmethod
    def answers(self, rows: EpisodeBatch) -> Answers:
        """Return what the networks say of rows, for `SymmetryPrior.errors`."""

    def explore(self) -> dict[str, Tensor]:
        """Set how the policy explores in the next round, and return what is logged of it, each [S]."""
        return {}

    def _store(self, episodes: EpisodeBatch) -> None:
        valid = episodes.valid.unsqueeze(-1).expand(episodes.reward.shape)
        if not self.spec.shared_reward:
            valid = episodes.of_living(valid)
        self.reward_scale.update(episodes.reward.flatten(2), valid.flatten(2))
        self.replay.add(episodes)
        for copies in self.prior.stored(episodes, self.generators["prior"]):
            self.replay.add(copies)
        self.episodes += self.config.num_envs

    def critic_rows(self, batch: EpisodeBatch) -> Tensor:
        """Return what the critic or the mixer sees of every state: [S, B, T + 1(, N), critic width]."""
        rows = self.joint.rows(batch.obs, batch.state)
        if not self.config.critic_sees_time:
            return rows
        time = self._time.view(-1, *[1] * (rows.dim() - 3))
        return torch.cat([rows, time.expand(*rows.shape[:-1], 1)], -1)

    @torch.no_grad()
    def td_targets(
        self, batch: EpisodeBatch, reward: Tensor, next_value: Tensor, bonus: Tensor | None = None
    ) -> Tensor:
        """Return targets [S, B, T, C] from standardised rewards and the target network's values of what followed.

        Rewards, `reward` as they were paid, are divided by the root of the horizon too: the sum of T independent ones
        then has variance 1, so that values, and with them S_Q and c, mean about the same in every task. Mean and
        variance are those of one agent's reward; a team's, the mean of rewards of the agents' own, varies less. Where
        an episode or an agent may end early, the mean is not taken off: it would pay for each step that is still to
        come, or charge for it. `bonus`, an entropy, is added to value and lambda-return of what followed.
        """
        config = self.config
        last = batch.valid & ~nn.functional.pad(batch.valid[:, :, 1:], (0, 1))
        ended = batch.terminated if config.bootstrap_truncated else batch.terminated | last
        ends_early = self.spec.terminates or self.spec.agents_end
        standardised = self.reward_scale.scaled if ends_early else self.reward_scale.normalise
        reward = standardised(reward) * self.spec.horizon**-0.5
        over = ended.unsqueeze(-1)
        if batch.alive is not None and batch.own(next_value.shape[-1]):
            over = over | ~batch.alive[:, :, 1:]  # what follows an agent's end is not its own
        if bonus is not None:
            reward = reward + torch.where(over, 0.0, config.gamma * bonus)
        return td_targets(reward, next_value, over, config.gamma, config.td_lambda, last.unsqueeze(-1))

    @torch.no_grad()
    def td_metrics(self, values: Tensor, target: Tensor, batch: EpisodeBatch) -> dict[str, Tensor]:
        """Return what is logged of a step: L_TD and the mean value, over the originals; [S, B, T, C] each."""
        error, valued = value_error(values, target, self.config.huber_delta), batch.valued(values.shape[-1])
        return {"td_loss": mean_per_seed(error, valued), "value": mean_per_seed(values, valued)}

    def adam(self, module: nn.Module, *others: nn.Module, learning_rate: float) -> SeedAdam:
        """Return an optimiser of the parameters of some networks, whose gradients are clipped together."""
        parameters = [parameter for part in (module, *others) for parameter in part.parameters()]
        return SeedAdam(
            parameters,
            learning_rate=learning_rate,
            epsilon=self.config.adam_epsilon,
            max_grad_norm=self.config.max_grad_norm,
        )

    @property
    def has_learned(self) -> bool:
        return self.updates > 0

    def state_dict(self, complete: bool = False) -> dict[str, Tensor]:
        out = super().state_dict(complete) | {"counters": torch.tensor([self.episodes, self.updates])}
        return out if complete else out | under("replay", self.replay.state_dict())

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        super().load_state_dict(tensors)
        replay = below(tensors, "replay")
        if "counters" not in tensors or (tensors["counters"].shape, tensors["counters"].dtype) != ((2,), torch.int64):
            raise UserError("the checkpoint does not fit this configuration (it has no counters)")
        self.episodes, self.updates = tensors["counters"].tolist()
        if replay:
            self.replay.load_state_dict(replay)


class ExploringLearner(OffPolicyLearner):
    """Explores at random in the warm-up, then by a measure epsilon that falls linearly; see `ExploringHead`."""

    config: ExploringConfig

    def explore(self) -> dict[str, Tensor]:
        config, head = self.config, self.policy.head
        assert isinstance(head, ExploringHead)
        share = min(self.episodes * self.spec.horizon / config.epsilon_steps, 1.0)
        fallen = config.epsilon_start + share * (config.epsilon_finish - config.epsilon_start)
        head.explore(1.0 if self.episodes < config.warmup_episodes else fallen)
        return {"train/epsilon": head.epsilon.clone()}


PROBE_EPISODES = 4  # episodes per seed on which the symmetry errors are measured once an iteration
