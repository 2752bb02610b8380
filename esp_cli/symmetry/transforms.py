"""Transforms of whole batches: L_g on observations and states, K_g on actions, and the way back for outputs.

A `Transform` holds one element per seed as stacked matrices and index tables, so that a batch of any size costs one
matrix product or one gather. Observations, states and actions are pushed forward (`obs`, `state`, `action`,
`per_agent`); what a network returned on transformed inputs is pulled back (`pull_back`, `pull_back_mean`, `values`)
to stand beside what it returns on the originals: an equivariant policy has pull_back(policy(obs(x))) == policy(x).

Multiplying by a signed permutation matrix (every element of D4 and every agent permutation on scalars and vectors)
is exact in floating point, as long as the device does not round the factors (TF32 does).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from esp_cli.symmetry.admission import admitted_elements
from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.groups import Group
from esp_cli.symmetry.representation import action_map, rows_matrix, rows_permutation, state_matrix
from esp_envs.spec import Discrete, TaskSpec

_STACK_LIMIT = 512
"""Stacks of at most this many elements are built once; longer ones (d4*agents with N >= 5) at each draw."""


@dataclass(frozen=True)
class Transform:
    """One element per seed; with a single element it acts on any number of seeds alike.

    The first axis of every argument is S; any batch axes may follow. Where agents stay in their places, rows may come
    without an agent axis too. Results are new tensors, and gradients flow through.

    Attributes:
        elements: the element of each seed.
        num_agents: N.
        places: [S, N] int64, agent i moves to places[i]; None where all agents stay.
        came_from: [S, N] int64, the inverse of `places`.
        obs_matrix: L_g, [S, D, D], or [S, N * D, N * D] where agents move; None for observations with pictures.
        obs_source: of these L_g as a signed permutation, [S, D] or [S, N * D] int64: where each number comes from.
        obs_sign: likewise, what it is multiplied by.
        state_matrix: L_g of the global state, [S, Ds, Ds].
        action_index: K_g of a discrete action space, [S, A] int64: what action j becomes.
        pull_index: [S, A] (or [S, N * A]) int64, the place of each pulled-back number among a policy's outputs.
        push_index: its inverse.
        action_matrix: K_g of a continuous action space, [S, width, width], or [S, N * width, N * width].
    """

    elements: tuple[Element, ...]
    num_agents: int
    places: Tensor | None
    came_from: Tensor | None
    obs_matrix: Tensor | None
    obs_source: Tensor | None
    obs_sign: Tensor | None
    state_matrix: Tensor
    action_index: Tensor | None
    pull_index: Tensor | None
    push_index: Tensor | None
    action_matrix: Tensor | None

    @property
    def num_seeds(self) -> int:
        """S, or 1 for a transform that is the same for all seeds."""
        return len(self.elements)

    @property
    def moves_agents(self) -> bool:
        """Whether agents may change places."""
        return self.places is not None

    def select(self, indices: Sequence[int]) -> Transform:
        """Return the transform made of the elements at these positions, one per seed."""
        index = torch.tensor(indices, dtype=torch.int64).to(self.state_matrix.device, non_blocking=True)
        chosen: dict[str, Any] = {"elements": tuple(self.elements[i] for i in indices)}
        for f in fields(self):
            if isinstance(tensor := getattr(self, f.name), Tensor):
                chosen[f.name] = tensor.index_select(0, index)
        return replace(self, **chosen)

    def obs(self, x: Tensor) -> Tensor:
        """Apply L_g to observations [S, ..., N, D]; row i moves to row sigma(i)."""
        if self.obs_matrix is not None:
            return self._multiply(x, self.obs_matrix, rows=True)
        assert self.obs_source is not None
        assert self.obs_sign is not None
        if self.moves_agents:
            self._require_agents(x, -2)
        self._require_width(x, self.obs_source.shape[-1] // (self.num_agents if self.moves_agents else 1))
        flat = x.reshape(self._seeds_of(x), -1, self.obs_source.shape[-1])
        moved = flat.gather(2, self.obs_source[:, None, :].expand(flat.shape))
        return (moved * self.obs_sign[:, None, :].to(x.dtype)).reshape(x.shape)

    def state(self, x: Tensor) -> Tensor:
        """Apply L_g to global states [S, ..., Ds]."""
        return self._multiply(x, self.state_matrix, rows=False)

    def action(self, action: Tensor) -> Tensor:
        """Apply K_g to actions: [S, ..., N] int64 (discrete) or [S, ..., N, width]."""
        if self.action_index is None:
            return self._multiply(action, self._continuous(), rows=True)
        flat = action.reshape(self._seeds_of(action), -1)
        return self.per_agent(self.action_index.gather(1, flat).reshape(action.shape))

    def action_one_hot(self, one_hot: Tensor) -> Tensor:
        """Apply K_g to what counts over actions, such as the one-hot of a previous action or a mask [S, ..., N, A]."""
        return self._gather(one_hot, self._discrete(self.push_index))

    def per_agent(self, x: Tensor) -> Tensor:
        """Let a number per agent [S, ..., N] (reward, advantage, log-probability) move with its agent."""
        return x if self.came_from is None else self._gather(x, self.came_from, agent_axis=-1)

    def pull_back(self, logits: Tensor) -> Tensor:
        """Bring logits or action values on transformed inputs home: out[..., n, a] = logits[..., sigma(n), K_g a].

        Shape:
            [S, ..., N, A] to the same.
        """
        return self._gather(logits, self._discrete(self.pull_index))

    def pull_back_mean(self, mean: Tensor) -> Tensor:
        """Bring continuous actions (a Gaussian's mean) on transformed inputs home, by K_g^-1.

        Shape:
            [S, ..., N, width] to the same.
        """
        return self._multiply(mean, self._continuous().transpose(1, 2), rows=True)

    def pull_back_variance(self, variance: Tensor) -> Tensor:
        """Return the variance of each number of a pulled-back Gaussian with independent numbers.

        Exact for any element; the pulled-back numbers stay independent under D4, and under any rotation if both
        numbers of a vector have one variance.

        Shape:
            [S, ..., N, width] to the same.
        """
        return self._multiply(variance, self._continuous().square().transpose(1, 2), rows=True)

    def values(self, values: Tensor) -> Tensor:
        """Bring invariant values home: one per world is left alone, one per agent goes back to its agent.

        Shape:
            [S, ..., 1] or [S, ..., N] to the same.
        """
        if self.places is None or values.shape[-1] == 1:
            return values
        return self._gather(values, self.places, agent_axis=-1)

    def _multiply(self, x: Tensor, matrix: Tensor, rows: bool) -> Tensor:
        """Multiply every row (where agents move: every run of N rows) by its seed's matrix."""
        if rows and self.moves_agents:
            self._require_agents(x, -2)
        width = matrix.shape[-1]
        joint = rows and self.moves_agents
        self._require_width(x, width // self.num_agents if joint else width)
        flat = x.reshape(self._seeds_of(x), -1, width)
        return torch.bmm(flat, matrix.to(x.dtype).transpose(1, 2)).reshape(x.shape)

    def _gather(self, x: Tensor, index: Tensor, agent_axis: int = -2) -> Tensor:
        """Reorder the last numbers (where agents move: the last N times as many) by each seed's table."""
        if self.moves_agents:
            self._require_agents(x, agent_axis)
        size = index.shape[-1]
        flat = x.reshape(self._seeds_of(x), -1, size)
        return flat.gather(2, index[:, None, :].expand(flat.shape)).reshape(x.shape)

    def _seeds_of(self, x: Tensor) -> int:
        """Return the size of the first axis to compute with: one element for all seeds makes seeds part of a batch."""
        if self.num_seeds not in (1, x.shape[0]):
            raise ValueError(f"a transform of {self.num_seeds} seeds was given data of {x.shape[0]}")
        return self.num_seeds

    def _require_width(self, x: Tensor, expected: int) -> None:
        if x.shape[-1] != expected:
            raise ValueError(f"a transform of {expected} numbers was given rows of {x.shape[-1]}")

    def _require_agents(self, x: Tensor, axis: int) -> None:
        if x.dim() < 1 - axis or x.shape[axis] != self.num_agents:
            raise ValueError(f"agents change places: axis {axis} of {list(x.shape)} must hold {self.num_agents} agents")

    def _discrete(self, index: Tensor | None) -> Tensor:
        if index is None:
            raise ValueError("this task's actions are continuous; pull back a mean, not logits")
        return index

    def _continuous(self) -> Tensor:
        if self.action_matrix is None:
            raise ValueError("this task's actions are discrete; pull back logits, not a mean")
        return self.action_matrix


def build_transform(elements: Sequence[Element], spec: TaskSpec, device: torch.device | str = "cpu") -> Transform:
    """Stack the representations of some elements, one per seed, on a task's spaces.

    Raises:
        ValueError: no element, or the task's actions or layouts cannot carry one.
    """
    if not elements:
        raise ValueError("a transform needs one element per seed, got none")
    planar = np.stack([e.matrix for e in elements])
    places = None
    if any(e.permutation is not None for e in elements):
        stay = tuple(range(spec.num_agents))
        places = np.array([e.permutation or stay for e in elements], dtype=np.int64)
    index = pull = matrix = source = sign = obs_matrix = None
    if any(f.pixels is not None for f in spec.observation.fields):
        source, sign = rows_permutation(spec.observation, planar, places)
    else:
        obs_matrix = rows_matrix(spec.observation, planar, places)
    if isinstance(spec.action, Discrete):
        index = pull = action_map(spec.action, elements)
        if places is not None:
            pull = (places[:, :, None] * spec.action.count + index[:, None, :]).reshape(len(elements), -1)
    else:
        matrix = rows_matrix(spec.action.layout, planar, places)

    def numbers(array: NDArray[np.float64] | None) -> Tensor | None:
        return None if array is None else torch.as_tensor(array, dtype=torch.float32, device=device)

    def indices(array: NDArray[np.int64] | None) -> Tensor | None:
        return None if array is None else torch.as_tensor(array, device=device)

    return Transform(
        elements=tuple(elements),
        num_agents=spec.num_agents,
        places=indices(places),
        came_from=indices(None if places is None else np.argsort(places, axis=1)),
        obs_matrix=numbers(obs_matrix),
        obs_source=indices(source),
        obs_sign=numbers(sign),
        state_matrix=torch.as_tensor(state_matrix(spec, planar, places), dtype=torch.float32, device=device),
        action_index=indices(index),
        pull_index=indices(pull),
        push_index=indices(None if pull is None else np.argsort(pull, axis=1)),
        action_matrix=numbers(matrix),
    )


class TransformSet:
    """The transforms that a learner may use: listed elements, or a group that is sampled.

    Attributes:
        names: the elements' names; the group's name alone where it is sampled.
        is_finite: whether the elements are listed; False for continuous groups and for more than `LISTED_LIMIT`.
        size: how many elements are listed, the identity not counted; 0 where the group is sampled.
    """

    def __init__(self, elements: Sequence[Element] | Group, spec: TaskSpec, device: torch.device | str = "cpu") -> None:
        self.spec = spec
        self.device = device
        self._group = elements if isinstance(elements, Group) else None
        self._elements = () if isinstance(elements, Group) else tuple(elements)
        self.is_finite = self._group is None
        self.size = len(self._elements)
        self.names = (self._group.name,) if self._group else tuple(e.name for e in self._elements)
        # Built once where it fits: a draw is then a selection.
        stacked = 0 < self.size <= _STACK_LIMIT
        self._stack = build_transform(self._elements, spec, device) if stacked else None

    def draw(self, generators: Sequence[torch.Generator]) -> Transform:
        """Draw one element per seed, uniformly among those that are not the identity.

        The identity is left out because a copy of the batch that equals the batch adds nothing: a consistency loss of
        zero and a second gradient on the same rows. Each seed draws from its own generator, so seed k draws the
        same alone and among ten.

        Args:
            generators: one per seed, on the CPU.
        """
        if self._group is not None:
            return build_transform([_draw_moving(self._group, g) for g in generators], self.spec, self.device)
        picks = [int(torch.randint(self.size, (), generator=g)) for g in generators]
        if self._stack is not None:
            return self._stack.select(picks)
        return build_transform([self._elements[i] for i in picks], self.spec, self.device)

    def each(self) -> list[Transform]:
        """Return every element in order, each the same for all seeds.

        Raises:
            ValueError: the group is sampled.
        """
        if not self.is_finite:
            raise ValueError(f"{self.names[0]} cannot be listed; draw from it or choose a finite group")
        if self._stack is not None:
            return [self._stack.select([i]) for i in range(self.size)]
        return [build_transform([e], self.spec, self.device) for e in self._elements]


def transform_set(text: str, spec: TaskSpec, device: torch.device | str = "cpu") -> TransformSet:
    """Read transforms from text and build them for a task.

    Args:
        text: see `parse_elements`.
        spec: the task.
        device: where the tensors live.

    Raises:
        ValueError: the text means nothing, or the task cannot carry what it means.
    """
    return TransformSet(admitted_elements(text, spec), spec, device)


def _draw_moving(group: Group, generator: torch.Generator) -> Element:
    element = group.draw(generator)
    while element.is_identity:
        element = group.draw(generator)
    return element
