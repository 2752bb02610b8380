"""Acting for off-policy learners: whole episodes, from their start to their end."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from esp_cli.algorithms.learner import below
from esp_cli.algorithms.replay import EpisodeBatch
from esp_cli.algorithms.rollout import stacked
from esp_cli.networks.policy import HistoryPolicy
from esp_envs.base import Environment


class EpisodeCollector:
    """Plays one episode in every world at a time, each from a fresh start.

    What a world does after its episode has ended before the horizon is marked as not valid.

    Args:
        env: the worlds.
        policy: the behaviour policy.
        generators: one CPU generator per seed for action noise.
    """

    def __init__(self, env: Environment, policy: HistoryPolicy, generators: Sequence[torch.Generator]) -> None:
        self.env, self.policy, self.generators = env, policy, generators

    @torch.no_grad()
    def collect(self) -> tuple[EpisodeBatch, Tensor]:
        """Play one episode in every world with exploring actions.

        Returns:
            The episodes, and their mean return [S] (mean over agents of the sum over time).
        """
        env, policy, head = self.env, self.policy, self.policy.head
        steps, agents = env.spec.horizon, env.spec.num_agents
        noise = head.noise((steps, env.num_envs, agents), self.generators).to(env.device, non_blocking=True)
        observation = env.reset()
        memory = policy.initial_memory(env.num_envs, observation.obs)
        running = torch.ones(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
        seen = [observation]
        actions, rewards, terminated, valid = [], [], [], []
        for t in range(steps):
            outputs, memory = policy.step(observation.obs, memory, observation.action_mask)
            action = head.sample(outputs, noise[:, t])
            memory = policy.remember(memory, action)
            step = env.step(head.to_environment(action))
            observation = step.next
            seen.append(step.reached)
            actions.append(action)
            rewards.append(step.reward)
            terminated.append(step.terminated)
            valid.append(running)
            running = running & ~step.ended
        reward, mask = torch.stack(rewards, 2), torch.stack(valid, 2)
        returns = torch.where(mask, reward.mean(-1), 0.0).sum(2).mean(1)
        shared = reward[..., :1] if env.spec.shared_reward else reward
        batch = EpisodeBatch(
            torch.stack([x.obs for x in seen], 2),
            torch.stack([x.state for x in seen], 2),
            torch.stack(actions, 2),
            shared,
            torch.stack(terminated, 2),
            mask,
            action_mask=stacked([x.action_mask for x in seen]),
            alive=stacked([x.alive for x in seen]),
        )
        return batch, returns

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs: between episodes that is the worlds' own state."""
        return {f"env.{name}": tensor for name, tensor in self.env.state_dict().items()}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned."""
        self.env.load_state_dict(below(tensors, "env"))
