"""Transforms of whole batches: L_g on observations and states, K_g on actions, and the way back for outputs.

Observations, states and actions are pushed forward (`obs`, `state`, `action`, `per_agent`); what a network returns on
transformed inputs is pulled back (`pull_back`, `values`) and compared with what it returns on the originals: an
equivariant policy has pull_back(policy(obs(x))) == policy(x). A batch of any size costs one matrix product or one
gather for each space.

Multiplying by a signed permutation matrix (every element of D4 and every agent permutation on scalars and vectors)
is exact in floating point, as long as the device does not round the factors (TF32 does).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from esp_cli.symmetry import representation
from esp_cli.symmetry.admission import admitted_elements
from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.groups import Group
from esp_cli.symmetry.maps import Gather, Map, gather_of, map_of
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Layout, Spaces

_STACK_LIMIT = 512  # most elements that are built once; of more (d4*agents with N >= 5) those that are drawn


@dataclass(frozen=True)
class Transform:
    """One element per seed, on data [S, ...]. A single element acts on any leading axes: [B, ...] or [S, B, ...].

    Where agents stay in their places, rows may come without an agent axis. Results are new, and gradients flow through.
    """

    elements: tuple[Element, ...]  # the element of each seed
    agents: Gather | None  # how agents change places, on one number for each; None where all stay
    obs_map: Map  # L_g of an observation, or where agents move of all agents' observations end to end
    state_map: Map  # L_g of the global state
    output_map: Map  # K_g of one number per discrete action, or of a continuous action, likewise
    # K_g of a discrete action, [S, A] int64: what action j becomes; None of continuous ones
    action_index: Tensor | None
    spaces: Spaces  # whose sorted items are sorted anew

    @property
    def num_seeds(self) -> int:
        """S, or 1 for a transform that is the same for all seeds."""
        return len(self.elements)

    @cached_property
    def orders(self) -> Tensor | None:
        """Which output is each action's, at s and at L_g s, [S, 2, A] int64; None where signs change or agents move."""
        by = self.output_map
        if self.agents is not None or not isinstance(by, Gather) or by.sign is not None:
            return None
        return torch.stack([torch.arange(by.width, device=by.back.device).expand_as(by.back), by.back], 1)

    @property
    def num_outputs(self) -> int:
        """Numbers that a policy says of one agent: one per discrete action, or those of a continuous one."""
        return self.output_map.width // (1 if self.agents is None else self.agents.width)

    def select(self, indices: Sequence[int]) -> Transform:
        """Return the transform of the elements at these positions, one per seed."""
        index = torch.tensor(indices, dtype=torch.int64)

        def pick(tensor: Tensor) -> Tensor:
            return tensor.index_select(0, index.to(tensor.device, non_blocking=True))

        return Transform(
            elements=tuple(self.elements[i] for i in indices),
            agents=None if self.agents is None else self.agents.apply(pick),
            obs_map=self.obs_map.apply(pick),
            state_map=self.state_map.apply(pick),
            output_map=self.output_map.apply(pick),
            action_index=None if self.action_index is None else pick(self.action_index),
            spaces=self.spaces,
        )

    def obs(self, x: Tensor) -> Tensor:
        """Apply L_g to observations [S, ..., N, D]; row i moves to row sigma(i)."""
        return sorted_anew(self._move(x, self.obs_map, agent_axis=-2), self.spaces.observation)

    def state(self, x: Tensor) -> Tensor:
        """Apply L_g to global states [S, ..., Ds]."""
        return sorted_anew(self._move(x, self.state_map), self.spaces.state)

    def action(self, action: Tensor) -> Tensor:
        """Apply K_g to actions: [S, ..., N] int64 (discrete) or [S, ..., N, width]."""
        if self.action_index is None:
            return self.push_outputs(action)
        flat = action.reshape(self._seeds_of(action), -1)
        moved = self.action_index.gather(1, flat).reshape(action.shape)
        return moved if self.agents is None else self._move(moved, self.agents, agent_axis=-1)

    def per_agent(self, x: Tensor) -> Tensor:
        """Let a number per agent [S, ..., N] (reward, advantage) move with it; one per world [S, ..., 1] stays."""
        return x if self.agents is None or x.shape[-1] == 1 else self._move(x, self.agents, agent_axis=-1)

    def push_outputs(self, outputs: Tensor) -> Tensor:
        """Apply K_g to one number per discrete action, or to those of a continuous one; undoes `pull_back`."""
        return self._move(outputs, self.output_map, agent_axis=-2)

    def pull_back(self, outputs: Tensor) -> Tensor:
        """Apply K_g^-1 to a policy's outputs at L_g s, so that they compare with its outputs at s.

        Logits and action values: out[..., n, a] = outputs[..., sigma(n), K_g a]. Continuous actions: K_g^-1 of each.
        """
        return self._move(outputs, self.output_map, agent_axis=-2, back=True)

    def pull_back_variance(self, variance: Tensor) -> Tensor:
        """Return the diagonal of K_g^-1 diag(variance) K_g: the variances of an action's numbers, pulled back."""
        return self._move(variance, self.output_map.squared, agent_axis=-2, back=True)

    def values(self, values: Tensor) -> Tensor:
        """Return values per agent [S, ..., N] to their agents; one value per world [S, ..., 1] stays."""
        if self.agents is None or values.shape[-1] == 1:
            return values
        return self._move(values, self.agents, agent_axis=-1, back=True)

    def _move(self, x: Tensor, by: Map, agent_axis: int | None = None, back: bool = False) -> Tensor:
        """Apply a map of rows, or its inverse; where agents move, a row holds all N agents' numbers."""
        expected = by.width
        if self.agents is not None and agent_axis is not None:
            num_agents = self.agents.width
            if x.dim() < -agent_axis or x.shape[agent_axis] != num_agents:
                raise UserError(
                    f"agents change places: axis {agent_axis} of {list(x.shape)} must hold {num_agents} agents"
                )
            expected = by.width // num_agents if agent_axis == -2 else by.width
        if x.shape[-1] != expected:
            raise UserError(f"a transform of {expected} numbers was given rows of {x.shape[-1]}")
        if not x.numel():
            return x.clone()
        rows = x.reshape(self._seeds_of(x), -1, by.width)
        return (by.pull(rows) if back else by.push(rows)).reshape(x.shape)

    def _seeds_of(self, x: Tensor) -> int:
        """Return the size of the first axis to compute with: one element for all seeds makes seeds part of a batch."""
        if self.num_seeds not in (1, *x.shape[:1]):
            raise UserError(f"a transform of {self.num_seeds} seeds was given data of {x.shape[0]}")
        return self.num_seeds


def build_transform(
    elements: Sequence[Element], spaces: Spaces, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Transform:
    """Stack the representations of some elements, one per seed, on a task's spaces."""
    if not elements:
        raise UserError("a transform needs one element per seed, got none")
    representation.require_items(elements, spaces)
    places = representation.agent_places(elements, spaces.num_agents)
    image = representation.action_map(spaces.action, elements) if isinstance(spaces.action, Discrete) else None
    state, outputs = representation.state_operator(spaces, elements), representation.output_operator(spaces, elements)
    seen = representation.rows_operator(spaces.observation, elements, spaces.num_agents)
    return Transform(
        elements=tuple(elements),
        agents=None if places is None else gather_of(representation.Operator.moving(places), device),
        obs_map=map_of(seen, device, dtype),
        state_map=map_of(state, device, dtype),
        output_map=map_of(outputs, device, dtype) if image is None else gather_of(outputs, device),
        action_index=None if image is None else torch.as_tensor(image, device=device),
        spaces=spaces,
    )


def sorted_anew(rows: Tensor, layout: Layout) -> Tensor:
    """Return rows [..., D] with the items of fields in the order that `Field.sorted_by` says."""
    for field in (field for field in layout.fields if field.sorted_by):
        where = layout.slices()[field.name]
        items = rows[..., where].unflatten(-1, (field.count, -1))
        for key in reversed(field.sorted_by):
            order = items[..., abs(key) - 1].argsort(dim=-1, descending=key < 0, stable=True)
            items = items.gather(-2, order.unsqueeze(-1).expand_as(items))
        rows = torch.cat([rows[..., : where.start], items.flatten(-2), rows[..., where.stop :]], -1)
    return rows


class TransformSet:
    """The transforms that a learner may use, and the draw of one: listed elements, or a group that is sampled.

    A sampled group has the `names` of the group alone, and the `size` 0; else that is without the identity.
    """

    def __init__(
        self,
        elements: Sequence[Element] | Group,
        spaces: Spaces,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.spaces, self.device, self.dtype = spaces, device, dtype
        self._group = elements if isinstance(elements, Group) else None
        self._elements = () if isinstance(elements, Group) else tuple(elements)
        self.is_finite = self._group is None
        self.size = len(self._elements)
        self.names = (self._group.name,) if self._group else tuple(e.name for e in self._elements)
        fits = 0 < self.size <= _STACK_LIMIT  # then a draw is a selection; the identity is the last
        self._stack = self._build([*self._elements, Element()]) if fits else None
        self._singles: dict[int, Transform] = {}

    def draw(self, generators: Sequence[torch.Generator], keep: Sequence[float] = ()) -> Transform:
        """Draw one element per seed, uniformly among those that are not the identity.

        The identity is left out because a copy of the batch that equals the batch adds nothing. Each seed draws from
        its own generator on the CPU, so seed k draws the same alone and among ten. `keep` has by listed element (one
        number for a sampled group) how likely it is beside the others, 0 to 1; with probability 1 - max(keep) the
        identity takes the place of the drawn one. Empty: all alike, and all stay.
        """
        if self._group is None:
            return self.chosen([self._pick(keep, g) for g in generators])
        elements = []
        for generator in generators:
            while (element := self._group.draw(generator)).is_identity:
                pass
            elements.append(element if not keep or _stays(keep[0], generator) else Element())
        return self._build(elements)

    def _pick(self, keep: Sequence[float], generator: torch.Generator) -> int:
        """Draw an index by rejection; with equal weights the random stream equals the unweighted one."""
        most = max(keep, default=1.0)
        while most > 0:
            index = int(torch.randint(self.size, (), generator=generator))
            if not keep or _stays(keep[index] / most, generator):
                return index if _stays(most, generator) else self.size
        return self.size

    def kept(self, index: int, strength: float, generators: Sequence[torch.Generator]) -> Transform:
        """Return one of the listed elements, for each seed with probability `strength`, else the identity."""
        return self.chosen([index if _stays(strength, g) else self.size for g in generators])

    def chosen(self, picks: Sequence[int]) -> Transform:
        """Return the listed element of each seed by its index; `size` stands for the identity."""
        if self._stack is None:
            elements = (*self._elements, Element())
            return self._build([elements[i] for i in picks])
        if len(picks) > 1:
            return self._stack.select(picks)
        if picks[0] not in self._singles:
            self._singles[picks[0]] = self._stack.select(picks)
        return self._singles[picks[0]]

    def each(self) -> list[Transform]:
        """Return every element of a finite group in order, each the same for all seeds."""
        if not self.is_finite:
            raise UserError(f"{self.names[0]} cannot be listed; draw from it or choose a finite group")
        return [self.chosen([i]) for i in range(self.size)]

    def _build(self, elements: Sequence[Element]) -> Transform:
        return build_transform(elements, self.spaces, self.device, self.dtype)


def transform_set(
    text: str, spaces: Spaces, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> TransformSet:
    """Read transforms from text (see `parse_elements`) and build them for a task.

    transform_set("d4", spec).draw([torch.Generator()]).obs(obs)
    """
    return TransformSet(admitted_elements(text, spaces), spaces, device, dtype)


def _stays(strength: float, generator: torch.Generator) -> bool:
    return strength >= 1 or float(torch.rand((), generator=generator)) < strength
