"""Rows for a centralised critic: agents in a circle, and joint actions in which one of them is exchanged.

A centralised critic is asked for the value of N joint actions in each of which another agent's action is exchanged. All
of them have nearly all of the first layer's sums in common.
"""

from __future__ import annotations

import torch
from torch import Tensor

from esp_cli.networks.layers import SeedLinear, SeedMLP, affine


def in_a_circle(items: Tensor) -> Tensor:
    """Put N items in a row once for each of them, in the order of a circle that ends with it.

    Args:
        items: [..., N, A].

    Returns:
        [..., N, N A]; row i holds items i + 1, ..., N, 1, ..., i.
    """
    count = items.shape[-2]
    agents = torch.arange(count, device=items.device)
    order = (agents.unsqueeze(1) + agents + 1) % count
    return items[..., order, :].flatten(-2)


def with_one_exchanged(network: SeedMLP, rows: Tensor, items: Tensor, others: Tensor) -> Tensor:
    """Return the outputs for rows that end in N items, with each item in turn replaced by each of K others.

    Gradients flow to `others` alone; the network's own parameters have to be frozen.

    Args:
        network: of inputs of width D + N A.
        rows: [S, R, D] what stands before the items.
        items: [S, R, N, A] what stands there.
        others: [S, R, N, K, A] what each is replaced by.

    Returns:
        [S, R, N, K, outputs].
    """
    if network.norms is not None:  # a normalised input is another for every exchange
        return _one_by_one(network, rows, items, others)
    first: SeedLinear = network.layers[0]  # type: ignore[assignment]
    precision, (num_rows, num_items, num_others, width) = network.precision, others.shape[1:]
    weight = first.weight.to(precision)
    with torch.no_grad():
        common = affine(first.bias.to(precision), torch.cat([rows, items.flatten(2)], -1).to(precision), weight)
    columns = weight[:, rows.shape[-1] :].unflatten(1, (num_items, width)).flatten(0, 1)
    change = (others - items.unsqueeze(3)).to(precision).transpose(1, 2)  # [S, N, R, K, A]
    change = torch.bmm(change.flatten(0, 1).flatten(1, 2), columns).view(
        -1, num_items, num_rows, num_others, columns.shape[-1]
    )
    sums = change.add_(common.view(-1, 1, num_rows, 1, columns.shape[-1]))
    values = network.from_first_sums(sums.flatten(1, 3))
    return values.unflatten(1, (num_items, num_rows, num_others)).transpose(1, 2)


def _one_by_one(network: SeedMLP, rows: Tensor, items: Tensor, others: Tensor) -> Tensor:
    """Build every row as it is, and ask the network for each."""
    num_rows, num_items, num_others = others.shape[1:4]
    own = torch.eye(num_items, dtype=torch.bool, device=rows.device).view(num_items, 1, num_items, 1)
    joint = torch.where(own, others.unsqueeze(4), items.view(-1, num_rows, 1, 1, *items.shape[2:])).flatten(-2)
    full = torch.cat([rows.view(-1, num_rows, 1, 1, rows.shape[-1]).expand(*joint.shape[:-1], -1), joint], -1)
    return network(full.flatten(1, 3)).unflatten(1, (num_rows, num_items, num_others))
