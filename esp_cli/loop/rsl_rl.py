"""rsl_rl: copies of what PPO trains on, and PPO for recurrent policies with whole mirrored histories.

numbers = {"policy": layout(...), "critic": layout(...), "action": layout(body.positions())}  # by group
symmetry_cfg = {"data_augmentation_func": data_augmentation_func(body, numbers), "use_data_augmentation": True}

rsl_rl refuses symmetry for recurrent networks, since the hidden state of an original is not that of its mirror image.
With `class_name: esp_cli.loop.rsl_rl:MirroredPPO` each mirror has hidden states of its own: while data is collected,
actor and critic also see the mirrored observations, from the first step of each episode. Training then sees mirrored
trajectories with their own states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from types import ModuleType
from typing import Any

import torch

from esp_cli.bodies.body import Body
from esp_cli.bodies.emitting import mirror_of
from esp_cli.bodies.numbers import Numbers
from esp_envs.installed import install

try:
    from rsl_rl.algorithms import PPO
    from rsl_rl.storage import RolloutStorage
    from tensordict import TensorDict
except ModuleNotFoundError as error:
    needed = f"esp_cli.loop.rsl_rl needs the extra rsl_rl, and {error.name} is missing: {install('rsl_rl')}"
    raise ModuleNotFoundError(needed, name=error.name) from None

State = torch.Tensor | tuple[torch.Tensor, ...] | None


def parts_of(state: State) -> tuple[torch.Tensor, ...]:
    """Return the tensors [layers, envs, width] of a hidden state: one of a GRU, two of an LSTM, none before a start."""
    return () if state is None else state if isinstance(state, tuple) else (state,)


def data_augmentation_func(body: Body, numbers: Numbers, group: str | None = None) -> Callable[..., Any]:
    """Return a function (env, obs, actions) of rsl_rl's `symmetry_cfg`, as a file of `esp mirror` has it.

    It gives observations (a TensorDict of groups [B, D]) and actions [B, A], each followed by its copies; None for the
    one that is None.

    Args:
        body: of the robot.
        numbers: layouts of the observation groups by name, and of "action".
        group: the elements that leave your reward alone, such as "left-right"; by default all that the body has and the
            numbers carry.

    Raises:
        UserError: the body has no symmetry, or lacks an element of the group.
    """
    return mirror_of(body, numbers, group).compute_symmetric_states


class MirroredPPO(PPO):
    """PPO whose batches hold each trajectory, then its image under each element of a mirror.

    Args:
        mirror: the module that `esp mirror` wrote, its name, or what `esp_cli.bodies.emitting.mirror_of` returns, also
            by name as "my_robot:mirror".
        others: those of PPO; `symmetry_cfg` stays None.
    """

    def __init__(self, *args: Any, mirror: str | ModuleType, **others: Any) -> None:
        super().__init__(*args, **others)
        if isinstance(mirror, str):
            module, _, name = mirror.partition(":")
            mirror = getattr(import_module(module), name) if name else import_module(module)
        self.mirror = mirror
        self.models = (self.actor, self.critic)
        self.states: dict[tuple[str, int], State] = {}
        self.saved: dict[tuple[str, int], list[torch.Tensor]] = {}

    def image(self, obs: TensorDict, element: str) -> TensorDict:
        """Return observations under an element."""
        moved = {group: self.mirror.mirrored(obs[group], element, group) for group in obs.keys()}  # noqa: SIM118
        return TensorDict(moved, batch_size=obs.batch_size)

    def act(self, obs: TensorDict) -> torch.Tensor:
        """Sample actions, and let each mirror's hidden states see the mirrored observations."""
        actions = super().act(obs)
        for element in self.mirror.ELEMENTS:
            seen = self.image(obs, element)
            for k, model in enumerate(self.models):
                own, key = model.get_hidden_state(), (element, k)
                self.keep(key, self.states.get(key))
                model.reset(hidden_state=self.states.get(key))
                with torch.no_grad():
                    model(seen)
                self.states[key] = model.get_hidden_state()
                model.reset(hidden_state=own)
        return actions

    def keep(self, key: tuple[str, int], state: State) -> None:
        """Store a hidden state from before the current step: [steps, layers, envs, width] by part."""
        steps, now = self.storage.num_transitions_per_env, self.storage.step
        for part, tensor in enumerate(parts_of(state)):
            buffers = self.saved.setdefault(key, [])
            if part == len(buffers):
                buffers.append(torch.zeros(steps, *tensor.shape, device=tensor.device))
            buffers[part][now] = tensor

    def process_env_step(self, obs: TensorDict, rewards: Any, dones: torch.Tensor, extras: Any) -> None:
        """Record a step; hidden states of episodes that ended begin anew, those of mirrors too."""
        super().process_env_step(obs, rewards, dones, extras)
        for state in self.states.values():
            for tensor in parts_of(state):
                tensor[..., dones == 1, :] = 0.0

    def update(self) -> dict[str, float]:
        """Train on the trajectories and their images; the learning rate follows the divergence on originals alone."""
        generate, divergence = self.storage.recurrent_mini_batch_generator, self.actor.get_kl_divergence
        self.actor.get_kl_divergence = lambda old, new: divergence(old, tuple(x[:, : old[0].shape[1]] for x in new))
        self.storage.recurrent_mini_batch_generator = lambda *args: map(
            self.with_images, self.numbered(generate(*args))
        )
        try:
            return super().update()
        finally:
            del self.storage.recurrent_mini_batch_generator, self.actor.get_kl_divergence

    def numbered(self, batches: Iterator[Any]) -> Iterator[tuple[int, Any]]:
        """Yield each batch with the number of its first trajectory; every epoch counts anew."""
        first = 0
        for k, batch in enumerate(batches):
            first *= k % self.num_mini_batches > 0
            count = batch.masks.shape[1]
            yield first, batch
            first += count

    def with_images(self, numbered: tuple[int, Any]) -> RolloutStorage.Batch:
        """Return a batch followed by its image under each element, along the axis of trajectories and environments."""
        first, batch = numbered
        starts = torch.ones_like(self.storage.dones.squeeze(-1), dtype=torch.bool)
        starts[1:] = self.storage.dones.squeeze(-1)[:-1].bool()
        chosen = slice(first, first + batch.masks.shape[1])
        elements, mirrored = self.mirror.ELEMENTS, self.mirror.mirrored

        def state(k: int) -> State:
            parts = [[part] for part in parts_of(batch.hidden_states[k])]
            for element in elements:
                for part, saved in zip(parts, self.saved.get((element, k), []), strict=True):
                    part.append(saved.permute(2, 0, 1, 3)[starts.T][chosen].transpose(0, 1))
            joined = tuple(torch.cat(part, 1).contiguous() for part in parts)
            return joined[0] if len(joined) == 1 else joined or None

        def images(rows: torch.Tensor) -> torch.Tensor:
            return torch.cat([rows, *(mirrored(rows, element) for element in elements)], 1)

        def again(rows: torch.Tensor) -> torch.Tensor:
            return torch.cat([rows] * (1 + len(elements)), 1)

        batch.hidden_states = (state(0), state(1))
        seen = [batch.observations, *(self.image(batch.observations, element) for element in elements)]
        batch.observations = torch.cat(seen, 1)
        batch.actions, batch.masks = images(batch.actions), again(batch.masks)
        for name in ("values", "advantages", "returns", "old_actions_log_prob"):
            setattr(batch, name, again(getattr(batch, name)))
        return batch
