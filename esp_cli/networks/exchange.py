"""A perceptron's answers to rows that differ from each other in a few of their last numbers alone.

A centralised critic is asked for the value of N joint actions in each of which another agent's action is exchanged. All
of them have nearly all of the first layer's sums in common.
"""

from __future__ import annotations

import torch
from torch import Tensor

from esp_cli.networks.layers import SeedLinear, SeedMLP, affine


def with_one_exchanged(network: SeedMLP, rows: Tensor, items: Tensor, others: Tensor) -> Tensor:
    """Return the outputs for rows that end in N items, with each item in turn replaced by another.

    Gradients flow to `others` alone; the network's own parameters have to be frozen.

    Args:
        network: of inputs of width `rows.shape[-1] + N A`.
        rows: [S, R, D] what stands before the items.
        items: [S, R, N, A] what stands there.
        others: [S, R, N, A] what each is replaced by.

    Returns:
        [S, R, N, outputs].
    """
    if network.norms is not None:  # a normalised input is another for every exchange
        return _one_by_one(network, rows, items, others)
    first: SeedLinear = network.layers[0]  # type: ignore[assignment]
    precision = network.precision
    num_items, width = items.shape[2:]
    weight = first.weight.to(precision)
    with torch.no_grad():
        common = affine(first.bias.to(precision), torch.cat([rows, items.flatten(2)], -1).to(precision), weight)
    columns = weight[:, rows.shape[-1] :].unflatten(1, (num_items, width))
    change = (others - items).to(precision).transpose(1, 2)  # [S, N, R, A]
    sums = (
        torch.bmm(change.flatten(0, 1), columns.flatten(0, 1)).unflatten(0, (-1, num_items)).add_(common.unsqueeze(1))
    )
    return network.from_first_sums(sums.flatten(1, 2)).unflatten(1, (num_items, -1)).transpose(1, 2)


def _one_by_one(network: SeedMLP, rows: Tensor, items: Tensor, others: Tensor) -> Tensor:
    """Build every row as it is, and ask the network for each."""
    num_items = items.shape[2]
    own = torch.eye(num_items, dtype=torch.bool, device=rows.device).unsqueeze(-1)
    joint = torch.where(own, others.unsqueeze(3), items.unsqueeze(2)).flatten(-2)  # [S, R, N, N A]
    full = torch.cat([rows.unsqueeze(2).expand(-1, -1, num_items, -1), joint], -1)
    return network(full.flatten(1, 2)).unflatten(1, (-1, num_items))
