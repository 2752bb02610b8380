"""Transforms of whole batches: L_g on observations and states, K_g on actions, and the way back for outputs.

A `Transform` holds one element per seed as stacked maps, so that a batch of any size costs one matrix product or one
gather for each space. Observations, states and actions are pushed forward (`obs`, `state`, `action`, `per_agent`); what
a network returns on transformed inputs is pulled back (`pull_back`, `values`) and compared with what it returns on the
originals: an equivariant policy has pull_back(policy(obs(x))) == policy(x).

Multiplying by a signed permutation matrix (every element of D4 and every agent permutation on scalars and vectors)
is exact in floating point, as long as the device does not round the factors (TF32 does).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.maps import Gather, Map, gather_of, map_of
from esp_cli.symmetry.operators import Operator
from esp_cli.symmetry.representation import (
    action_map,
    agent_places,
    field_names,
    output_operator,
    rows_operator,
    state_operator,
)
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces


@dataclass(frozen=True)
class Transform:
    """One element per seed, on data [S, ...]. A single element acts on any leading axes: [B, ...] or [S, B, ...].

    Where agents stay in their places, rows may come without an agent axis. Results are new tensors, and gradients flow
    through.

    Attributes:
        elements: the element of each seed.
        agents: how agents change places, on one number for each; None where all stay.
        obs_map: L_g of an observation, or of all agents' observations end to end where agents move.
        state_map: L_g of the global state.
        output_map: K_g of one number per discrete action, or of a continuous action, likewise.
        action_index: K_g of a discrete action, [S, A] int64: what action j becomes; None of continuous ones.
    """

    elements: tuple[Element, ...]
    agents: Gather | None
    obs_map: Map
    state_map: Map
    output_map: Map
    action_index: Tensor | None

    @property
    def num_seeds(self) -> int:
        """S, or 1 for a transform that is the same for all seeds."""
        return len(self.elements)

    @property
    def is_uniform(self) -> bool:
        """Whether all rows of one seed are moved by the same element."""
        return True

    @property
    def is_identity(self) -> bool:
        """Whether it moves no number of the task, as a turn of scalars alone."""
        maps = (self.obs_map, self.state_map, self.output_map)
        return all(m.is_identity for m in maps) and (self.agents is None or self.agents.is_identity)

    def part(self, start: int, stop: int) -> Transform:
        """Return what acts on the rows from `start` to `stop` of a batch."""
        return self

    @property
    def num_outputs(self) -> int:
        """Numbers that a policy says of one agent: one per discrete action, or those of a continuous one."""
        return self.output_map.width // (1 if self.agents is None else self.agents.width)

    def select(self, indices: Sequence[int]) -> Transform:
        """Return the transform made of the elements at these positions, one per seed."""
        index = torch.tensor(indices, dtype=torch.int64)
        chosen = tuple(self.elements[i] for i in indices)

        def pick(tensor: Tensor) -> Tensor:
            return tensor.index_select(0, index.to(tensor.device, non_blocking=True))

        return Transform(
            elements=chosen,
            agents=None if self.agents is None else self.agents.apply(pick),
            obs_map=self.obs_map.apply(pick),
            state_map=self.state_map.apply(pick),
            output_map=self.output_map.apply(pick),
            action_index=None if self.action_index is None else pick(self.action_index),
        )

    def obs(self, x: Tensor) -> Tensor:
        """Apply L_g to observations [S, ..., N, D]; row i moves to row sigma(i)."""
        return self._move(x, self.obs_map.push, self.obs_map.width, agent_axis=-2)

    def state(self, x: Tensor) -> Tensor:
        """Apply L_g to global states [S, ..., Ds]."""
        return self._move(x, self.state_map.push, self.state_map.width)

    def action(self, action: Tensor) -> Tensor:
        """Apply K_g to actions: [S, ..., N] int64 (discrete) or [S, ..., N, width]."""
        if self.action_index is None:
            return self.push_outputs(action)
        flat = action.reshape(self._seeds_of(action), -1)
        return self.per_agent(self.action_index.gather(1, flat).reshape(action.shape))

    def per_agent(self, x: Tensor) -> Tensor:
        """Let a number per agent [S, ..., N] (reward, advantage) move with it; one per world [S, ..., 1] stays."""
        if self.agents is None or x.shape[-1] == 1:
            return x
        return self._move(x, self.agents.push, self.agents.width, agent_axis=-1)

    def push_outputs(self, outputs: Tensor) -> Tensor:
        """Apply K_g to one number per discrete action, or to those of a continuous one; undoes `pull_back`."""
        return self._move(outputs, self.output_map.push, self.output_map.width, agent_axis=-2)

    def pull_back(self, outputs: Tensor) -> Tensor:
        """Apply K_g^-1 to a policy's outputs at L_g s, so that they compare with its outputs at s.

        Logits and action values: out[..., n, a] = outputs[..., sigma(n), K_g a]. Continuous actions: K_g^-1 of each.

        Shape:
            [S, ..., N, A] or [S, ..., N, width] to the same.
        """
        return self._move(outputs, self.output_map.pull, self.output_map.width, agent_axis=-2)

    def pull_back_variance(self, variance: Tensor) -> Tensor:
        """Return the diagonal of K_g^-1 diag(variance) K_g: the variances of an action's numbers, pulled back.

        Shape:
            as of `pull_back`.
        """
        return self._move(variance, self.output_map.squared.pull, self.output_map.width, agent_axis=-2)

    def values(self, values: Tensor) -> Tensor:
        """Return values per agent [S, ..., N] to their agents; one value per world [S, ..., 1] stays."""
        if self.agents is None or values.shape[-1] == 1:
            return values
        return self._move(values, self.agents.pull, self.agents.width, agent_axis=-1)

    def _move(self, x: Tensor, move: Callable[[Tensor], Tensor], width: int, agent_axis: int | None = None) -> Tensor:
        """Apply a map of rows of `width` numbers; where agents move, a row holds all N agents' numbers.

        Raises:
            UserError: the rows have another width, the agent axis another size, or the first axis other seeds.
        """
        if self.agents is not None and agent_axis is not None:
            num_agents = self.agents.width
            if x.dim() < -agent_axis or x.shape[agent_axis] != num_agents:
                raise UserError(
                    f"agents change places: axis {agent_axis} of {list(x.shape)} must hold {num_agents} agents"
                )
            expected = width // num_agents if agent_axis == -2 else width
        else:
            expected = width
        if x.shape[-1] != expected:
            raise UserError(f"a transform of {expected} numbers was given rows of {x.shape[-1]}")
        return move(x.reshape(self._seeds_of(x), -1, width)).reshape(x.shape)

    def _seeds_of(self, x: Tensor) -> int:
        """Return the size of the first axis to compute with: one element for all seeds makes seeds part of a batch."""
        if self.num_seeds not in (1, x.shape[0]):
            raise UserError(f"a transform of {self.num_seeds} seeds was given data of {x.shape[0]}")
        return self.num_seeds


def build_transform(
    elements: Sequence[Element], spaces: Spaces, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Transform:
    """Stack the representations of some elements, one per seed, on a task's spaces.

    Raises:
        UserError: no element, or the task's actions or layouts cannot carry one.
    """
    if not elements:
        raise UserError("a transform needs one element per seed, got none")
    if missing := [name for e in elements for name, _ in e.items if name not in field_names(spaces)]:
        names = ", ".join(field_names(spaces))
        raise UserError(f"{spaces.label} has no field '{missing[0]}' whose items change places, but {names}")
    places = agent_places(elements, spaces.num_agents)
    image = action_map(spaces.action, elements) if isinstance(spaces.action, Discrete) else None
    state, outputs = state_operator(spaces, elements), output_operator(spaces, elements)
    seen = rows_operator(spaces.observation, elements, spaces.num_agents)
    return Transform(
        elements=tuple(elements),
        agents=None if places is None else gather_of(Operator.reordering(places.argsort(1)), device),
        obs_map=map_of(seen, device, dtype),
        state_map=map_of(state, device, dtype),
        output_map=map_of(outputs, device, dtype) if image is None else gather_of(outputs, device),
        action_index=None if image is None else torch.as_tensor(image, device=device),
    )
