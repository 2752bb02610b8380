"""On-policy experience: what one round of acting in all worlds leaves behind, and its shape for gradient steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from esp_cli.algorithms.learner import Worlds
from esp_cli.networks.contract import Generators
from esp_cli.networks.policy import Critic, StochasticPolicy
from esp_cli.prior import SeedBatch
from esp_envs.base import Environment, Observation
from esp_envs.errors import UserError


@dataclass
class Rollout:
    """T steps of E worlds for S seeds."""

    obs: Tensor  # [S, E, T, N, D]
    state: Tensor  # [S, E, T, state width]
    action: Tensor  # [S, E, T, N(, width)], latent, as the head drew it
    log_prob: Tensor  # [S, E, T, N]
    reward: Tensor  # [S, E, T, N]
    terminated: Tensor  # [S, E, T] bool
    ended: Tensor  # [S, E, T] bool
    last: Observation  # after the final step
    finals: dict[int, Observation] = field(default_factory=dict)  # by t the final one of episodes that ended
    action_mask: Tensor | None = None  # [S, E, T, N, A] bool
    alive: Tensor | None = None  # [S, E, T, N] bool before the step, where agents end
    gone: Tensor | None = None  # likewise, no more after the step


@dataclass
class Batch(SeedBatch):
    """Experience ready for gradient steps: B sequences of tau steps (tau = 1 unless the network is recurrent).

    Shape:
        obs [S, B, tau, N, D], state [S, B, tau, state width], action [S, B, tau, N(, width)],
        log_prob and advantage [S, B, tau, N], target and value [S, B, tau, C] in normalised units.
    """

    per_agent = ("log_prob", "advantage", "target", "value")

    log_prob: Tensor
    advantage: Tensor
    target: Tensor
    value: Tensor


class LoneBatch(Batch):
    """Experience of one agent that has a reward of its own."""

    lone = True


class Collector(Worlds):
    """Acts in the worlds and remembers, between rollouts, where each stands."""

    def __init__(self, env: Environment, policy: StochasticPolicy, generators: Generators) -> None:
        super().__init__(env, policy, generators)
        self._begin()
        self.finished_return = torch.zeros(env.num_seeds, device=env.device)
        self.finished_count = torch.zeros(env.num_seeds, device=env.device)

    def _begin(self) -> None:
        env = self.env
        self.observation, self._stale = env.reset(), False
        self.memory = self.policy.initial_memory(env.num_envs, self.observation.obs)
        self.episode_return = torch.zeros(env.num_seeds, env.num_envs, device=env.device)

    @torch.no_grad()
    def collect(self, num_steps: int) -> Rollout:
        """Act for `num_steps` steps in every world with actions drawn from the policy."""
        if self._stale:
            self._begin()
        noise = self.policy.head.noise((num_steps, self.env.num_envs, self.env.spec.num_agents), self.generators)
        noise = noise.to(self.env.device, non_blocking=True)
        seen, outputs, actions, steps = [], [], [], []
        for t in range(num_steps):
            seen.append(self.observation)
            output, self.memory = self.policy.step(self.observation.obs, self.memory, self.observation.action_mask)
            action = self.policy.head.sample(output, noise[:, t])
            step = self.env.step(self.policy.head.to_environment(action))
            outputs.append(output)
            actions.append(action)
            steps.append(step)
            self._finish(step.reward, step.ended, step.final is not None)
            self.observation = step.next
        action_rows, after = torch.stack(actions, 2), [step.reached.alive for step in steps]
        return Rollout(
            torch.stack([x.obs for x in seen], 2),
            torch.stack([x.state for x in seen], 2),
            action_rows,
            self.policy.head.log_prob(torch.stack(outputs, 2), action_rows),
            torch.stack([step.reward for step in steps], 2),
            torch.stack([step.terminated for step in steps], 2),
            torch.stack([step.ended for step in steps], 2),
            self.observation,
            {t: step.final for t, step in enumerate(steps) if step.final is not None},
            stacked([x.action_mask for x in seen]),
            stacked([x.alive for x in seen]),
            stacked([None if alive is None else ~alive for alive in after]),
        )

    def _finish(self, reward: Tensor, ended: Tensor, any_ended: bool) -> None:
        """Add up returns (mean over agents of the sum over time) and empty the memory of ended episodes."""
        self.episode_return += reward.mean(-1)
        if not any_ended:
            return
        self.finished_return += torch.where(ended, self.episode_return, 0.0).sum(1)
        self.finished_count += ended.sum(1)
        self.episode_return = torch.where(ended, 0.0, self.episode_return)
        if self.memory.shape[-1]:
            self.memory = self.memory * (~ended).repeat_interleave(self.env.spec.num_agents, 1).unsqueeze(-1)

    def pop_mean_return(self) -> Tensor:
        """Return the mean return [S] of episodes finished since the last call (NaN where none was)."""
        mean = self.finished_return / self.finished_count
        self.finished_return.zero_()
        self.finished_count.zero_()
        return mean

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs: of worlds that cannot go on in mid-episode their generators alone."""
        worlds = super().state_dict()
        if not self.env.has("state_dict"):
            return worlds
        seen = {name: getattr(self.observation, name) for name in ("obs", "state", "action_mask", "alive")}
        own = {**seen, "memory": self.memory, "episode_return": self.episode_return}
        return {name: tensor for name, tensor in own.items() if tensor is not None} | worlds

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        if not self.env.has("state_dict"):
            super().load_state_dict(tensors)
            self._stale = True  # the next rollout begins new episodes
            return
        own = {name: tensors[name].to(self.env.device) for name in ("obs", "state", "memory", "episode_return")}
        if own["obs"].shape != self.observation.obs.shape:
            raise UserError("the saved worlds have other seeds, worlds or observations than these; use their settings")
        mask = tensors["action_mask"].to(self.env.device) if self.env.spec.masks else None
        alive = tensors["alive"].to(self.env.device) if self.env.spec.agents_end else None
        self.observation = Observation(own["obs"], own["state"], mask, alive)
        self.memory, self.episode_return = own["memory"], own["episode_return"]
        super().load_state_dict(tensors)


def stacked(flags: Sequence[Tensor | None]) -> Tensor | None:
    """Stack the flags of all steps [S, E, ...] along the time axis; None where the task has none."""
    known = [flag for flag in flags if flag is not None]
    return torch.stack(known, 2) if known else None


def values_along(
    critic: Critic, rollout: Rollout, episode: int | None, terminates: bool = True
) -> tuple[Tensor, Tensor]:
    """Return V(s_t) and V of what really followed, each [S, E, T, C], in the critic's units.

    A recurrent critic is unrolled over whole episodes of `episode` steps. If none `terminates` before the horizon,
    nothing asks which did, for which a GPU would be waited for.
    """
    if episode is not None:
        finals = [rollout.finals[t] for t in sorted(rollout.finals)]
        obs = _episodes(rollout.obs, [final.obs for final in finals], episode)
        state = _episodes(rollout.state, [final.state for final in finals], episode)
        values = critic.unroll(obs, state).unflatten(1, (rollout.obs.shape[1], -1))
        return values[:, :, :, :-1].flatten(2, 3), values[:, :, :, 1:].flatten(2, 3)
    value = critic.unroll(rollout.obs, rollout.state)
    next_value = torch.cat([value[:, :, 1:], _value_of(critic, rollout.last).unsqueeze(2)], 2)
    # An episode that terminated has no value behind its end: only truncated ones are worth a look at their last state.
    cut = (rollout.ended & ~rollout.terminated).flatten(0, 1).any(0).tolist() if terminates else None
    for t, final in rollout.finals.items():
        if cut is None or cut[t]:
            ended = rollout.ended[:, :, t].unsqueeze(2)  # other worlds' last bits shall not depend on these
            next_value[:, :, t] = torch.where(ended, _value_of(critic, final), next_value[:, :, t])
    return value, next_value


def _episodes(rows: Tensor, finals: list[Tensor], length: int) -> Tensor:
    """Cut [S, E, T, ...] into whole episodes, each with its final row behind it: [S, E * k, length + 1, ...]."""
    return torch.cat([rows.unflatten(2, (-1, length)), torch.stack(finals, 2).unsqueeze(3)], 3).flatten(1, 2)


def _value_of(critic: Critic, observation: Observation) -> Tensor:
    return critic.unroll(observation.obs.unsqueeze(2), observation.state.unsqueeze(2)).squeeze(2)
