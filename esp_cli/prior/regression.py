"""Ridge regressions of one step: what happens, from what agents see and do and the products of two of these numbers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from esp_envs.spec import Discrete, Spaces, others_of

_WIDEST_PAIRS = 48
"""Up to so many numbers of one agent, products of two of them are looked at too."""
_WIDEST_OTHERS = 160
"""Up to so many numbers that all other agents see and do, what they see is looked at too; else what they do alone."""


def own_inputs(spaces: Spaces, obs: Tensor, action: Tensor) -> Tensor:
    """Return 1, what each agent sees and does, and the products of two of these numbers: [..., N, features]."""
    return _side_by_side(_columns(spaces, obs, action), [])


def inputs_of(spaces: Spaces, obs: Tensor, action: Tensor) -> Tensor:
    """Return `own_inputs` with what the other agents see and do, on which an agent's next observation depends.

    Args:
        spaces: what the numbers are.
        obs: [M, T, N, D].
        action: [M, T, N] int64, or [M, T, N, width] float32.

    Returns:
        [M, T, N, features].
    """
    columns = _columns(spaces, obs, action)
    orders = orders_of_others(spaces.num_agents)
    known = columns if len(orders) * len(columns) <= _WIDEST_OTHERS else columns[spaces.observation.width :]
    return _side_by_side(columns, [known[..., order] for order in orders])


def orders_of_others(num_agents: int) -> list[list[int]]:
    """Return who is each agent's first other, second other and so on, in index order: N - 1 lists of N agents."""
    return [list(order) for order in zip(*others_of(num_agents), strict=True)]


def _columns(spaces: Spaces, obs: Tensor, action: Tensor) -> Tensor:
    """Return what each agent sees and does, one number after the other: [numbers, ..., N]."""
    acted = F.one_hot(action, spaces.action.count).float()[..., 1:] if isinstance(spaces.action, Discrete) else action
    return torch.cat([obs, acted], -1).movedim(-1, 0).contiguous()


def _side_by_side(columns: Tensor, others: Sequence[Tensor]) -> Tensor:
    """Return 1, the columns [numbers, ..., N], their products, and others: [..., N, features], features outermost."""
    count = len(columns)
    paired = count if count <= _WIDEST_PAIRS else 0
    sizes = [1, count, *range(paired, 0, -1), *map(len, others)]
    features = columns.new_empty(sum(sizes), *columns.shape[1:])
    one, own, *rest = features.split(sizes)
    one.fill_(1)
    own.copy_(columns)
    for k in range(paired):
        torch.mul(columns[k:], columns[k], out=rest[k])
    for part, other in zip(rest[paired:], others, strict=True):
        part.copy_(other)
    return features.movedim(0, -1)


def moments(inputs: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return X^T X [N, F, F] and X^T Y [N, F, O] of inputs [M, T, N, F] and outputs [M, T, N, O], in float64."""
    x, y = (part.flatten(0, 1).transpose(0, 1) for part in (inputs, outputs))
    return (x.mT @ x).double(), (x.mT @ y).double()


def ridge(gram: Tensor, cross: Tensor, strength: float = 1e-4, floor: float = 1e-9) -> Tensor:
    """Return the weights [N, F, O] of ridge regressions, each feature held back in proportion to its own square.

    Args:
        gram: X^T X, [N, F, F].
        cross: X^T Y, [N, F, O].
        strength: share of its square that is added to each feature's diagonal entry.
        floor: what a square counts at least; of a feature that is always 0.
    """
    held = strength * torch.diag_embed(gram.diagonal(dim1=-2, dim2=-1).clamp_min(floor))
    return torch.linalg.solve(gram + held, cross).float()
