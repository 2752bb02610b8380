"""Off-policy experience: whole episodes, played from start to end, kept per seed until newer ones take their place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.algorithms.learner import Worlds
from esp_cli.algorithms.rollout import stacked
from esp_cli.prior import SeedBatch
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, TaskSpec


@dataclass
class EpisodeBatch(SeedBatch):
    """B whole episodes for each of S seeds; rows past the end of an episode are not valid.

    Shape:
        obs [S, B, T + 1, N, D] and state [S, B, T + 1, Ds], the last row being the final one,
        action [S, B, T, N(, width)], reward [S, B, T, C] with C = 1 if shared, else N,
        terminated and valid [S, B, T] bool, action_mask [S, B, T + 1, N, A] and alive [S, B, T + 1, N]
        bool or None.
    """

    per_agent = ("reward",)

    reward: Tensor
    terminated: Tensor
    valid: Tensor

    @property
    def mask(self) -> Tensor | None:
        return self.valid if self.alive is None else self.valid.unsqueeze(-1) & self.alive[:, :, :-1]

    @property
    def played(self) -> Tensor | None:
        return self.valid

    def of_living(self, x: Tensor, after: bool = False) -> Tensor:
        """Return numbers per agent [S, B, T, N(, width)], 0 where one has ended before the step, or `after` it."""
        if self.alive is None:
            return x
        alive = self.alive[:, :, 1:] if after else self.alive[:, :, :-1]
        return x.masked_fill(~alive if x.dim() == alive.dim() else ~alive.unsqueeze(-1), 0)


class WholeEpisodes(EpisodeBatch):
    """Episodes of agents and worlds that all last to the horizon, so that every row counts."""

    mask = played = None


class LoneEpisodes(EpisodeBatch):
    """Episodes of one agent that has a reward of its own."""

    lone = True


class EpisodeReplay:
    """The last `capacity` episodes of each of S seeds, allocated at once on the training device."""

    def __init__(self, spec: TaskSpec, num_seeds: int, capacity: int, device: torch.device) -> None:
        self.capacity, self.size, self.cursor = capacity, 0, 0
        steps, agents, space = spec.horizon, spec.num_agents, spec.action

        def room(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.empty(num_seeds, capacity, *shape, dtype=dtype, device=device)

        allowed = None
        if isinstance(space, Discrete):
            action = room(steps, agents, dtype=torch.int16)
            allowed = room(steps + 1, agents, space.count, dtype=torch.bool) if spec.masks else None
        else:
            action = room(steps, agents, space.width)
        kind = EpisodeBatch if spec.terminates or spec.agents_end else WholeEpisodes
        if spec.agents_end and agents == 1 and not spec.shared_reward:
            kind = LoneEpisodes
        self._store = kind(
            obs=room(steps + 1, agents, spec.observation.width),
            state=room(steps + 1, spec.state.width),
            action=action,
            reward=room(steps, 1 if spec.shared_reward else agents),
            terminated=room(steps, dtype=torch.bool),
            valid=room(steps, dtype=torch.bool),
            action_mask=allowed,
            alive=room(steps + 1, agents, dtype=torch.bool) if spec.agents_end else None,
        )

    def add(self, episodes: EpisodeBatch) -> None:
        """Store episodes; the oldest give way."""
        count = episodes.obs.shape[1]
        places = (self.cursor + torch.arange(count, device=episodes.obs.device)) % self.capacity
        for name, tensor in self._store.tensors.items():
            tensor.index_copy_(1, places, getattr(episodes, name).to(tensor.dtype))
        self.cursor = (self.cursor + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def select(self, places: Tensor) -> EpisodeBatch:
        """Return the episodes at `places` [S, B]; each seed's come from its own store."""
        batch = self._store.select(places)
        if batch.action.dtype == torch.int16:
            batch.action = batch.action.long()
        return batch

    def sample(self, count: int, generators: list[torch.Generator]) -> EpisodeBatch:
        """Draw `count` episodes per seed, uniformly and with replacement, each seed by its own generator."""
        places = [torch.randint(self.size, (count,), generator=g) for g in generators]
        return self.select(torch.stack(places).to(self._store.obs.device, non_blocking=True))

    def state_dict(self) -> dict[str, Tensor]:
        filled = {name: tensor[:, : self.size] for name, tensor in self._store.tensors.items()}
        return filled | {"cursor": torch.tensor(self.cursor)}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        known = tensors.keys() == {*self._store.tensors, "cursor"} and tensors["obs"].dim() >= 2
        if not known or (tensors["cursor"].shape, tensors["cursor"].dtype) != ((), torch.int64):
            raise UserError("the saved episodes do not fit into the replay of this configuration")
        size = tensors["obs"].shape[1]
        for name, tensor in self._store.tensors.items():
            saved = tensors[name]
            if size > self.capacity or saved.shape != tensor[:, :size].shape:
                raise UserError("the saved episodes do not fit into the replay of this configuration")
            tensor[:, :size] = saved
        self.size, self.cursor = size, int(tensors["cursor"]) % self.capacity


class EpisodeCollector(Worlds):
    """Plays one episode in every world at a time, each from a fresh start."""

    @torch.no_grad()
    def collect(self) -> tuple[EpisodeBatch, Tensor]:
        """Play one episode in every world and return all, and their mean return [S]: of agents, summed over time."""
        env, policy, head = self.env, self.policy, self.policy.head
        steps, agents = env.spec.horizon, env.spec.num_agents
        noise = head.noise((steps, env.num_envs, agents), self.generators).to(env.device, non_blocking=True)
        observation = env.reset()
        memory = policy.initial_memory(env.num_envs, observation.obs)
        running = torch.ones(env.num_seeds, env.num_envs, dtype=torch.bool, device=env.device)
        seen, actions, taken, valid = [observation], [], [], []
        for t in range(steps):
            outputs, memory = policy.step(observation.obs, memory, observation.action_mask)
            action = head.sample(outputs, noise[:, t])
            memory = policy.remember(memory, action)
            step = env.step(head.to_environment(action))
            observation = step.next
            seen.append(step.reached)
            actions.append(action)
            taken.append(step)
            valid.append(running)
            running = running & ~step.ended
        reward, mask = torch.stack([step.reward for step in taken], 2), torch.stack(valid, 2)
        returns = torch.where(mask, reward.mean(-1), 0.0).sum(2).mean(1)
        shared = reward[..., :1] if env.spec.shared_reward else reward
        batch = EpisodeBatch(
            torch.stack([x.obs for x in seen], 2),
            torch.stack([x.state for x in seen], 2),
            torch.stack(actions, 2),
            shared,
            torch.stack([step.terminated for step in taken], 2),
            mask,
            action_mask=stacked([x.action_mask for x in seen]),
            alive=stacked([x.alive for x in seen]),
        )
        return batch, returns
