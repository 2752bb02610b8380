"""The layer of exports that reads sets of things: a table for each, with any number of rows; see `networks.sets`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.export.layers import Floats, Layer
from esp_cli.export.templates import filled
from esp_cli.networks.set_features import distances_among, nearest_things


@dataclass(frozen=True)
class SetOf:
    """One set of things, and the weights that embed each of them."""

    name: str
    columns: Sequence[Sequence[int]]  # of an observation, for each thing those of its numbers [K, W]
    place: int | None  # the number at which a thing's place begins; None where it has none
    reader: int | None  # the own number at which the reader's place begins; None where it is the origin
    arrays: tuple[Floats, ...]  # W_1 [W + distances, H] of a thing, V [own, H] of the own numbers, b_1, W_2, b_2

    @property
    def width(self) -> int:
        """W, numbers of a thing."""
        return len(self.columns[0])


def named(sets: Iterable[str]) -> dict[str, str]:
    """Return the names of sets in C and ONNX."""
    return {name: name if name.isidentifier() and name.isascii() else str(k) for k, name in enumerate(sets)}


def pool_sets(
    sets: Sequence[SetOf], own: tuple[Floats, ...], kept: Sequence[int], inputs: int, beside: int, near: int, kind: str
) -> Layer:
    """Return the own numbers, mean and maximum over each set's embedded things, and what stands beside.

    `own` has W and b of a layer that embeds the own numbers, and is empty where they enter as they are; `kept` are the
    columns that are read, of `inputs`. The `beside` numbers behind them are passed on: the previous action. `near`
    things of each set are read, the nearest ones; 0 for all.
    """
    features, num_own = len(sets[0].arrays[-1]), own[1].size if own else len(kept)
    outputs = num_own + 2 * features * len(sets) + beside
    said = {"kept": list(kept), "inputs": inputs, "near": near, "embeds_own": bool(own)}
    structure = [(each.name, each.place, each.reader) for each in sets]

    def pooled(x: Tensor, w: list[Tensor], tables: Mapping[str, Tensor]) -> Tensor:
        weights, act = iter(w[len(own) :]), torch.relu if kind == "relu" else torch.tanh
        seen = x[:, list(kept)]
        seen = act(torch.addmm(w[1], seen, w[0])) if own else seen
        things = []
        for name, place, reader in structure:
            table = tables[name].unsqueeze(0)
            if near and place is not None:
                ways = table[..., place : place + 2] - (0 if reader is None else x[:, None, reader : reader + 2])
                table = nearest_things(table, ways, min(near, table.shape[2]))
            things.append(table)
        places = [t[..., p : p + 2] for t, (_, p, _) in zip(things, structure, strict=True) if p is not None]
        far = iter(distances_among(places) if places else [])
        parts = [seen]
        for table, (_, place, _) in zip(things, structure, strict=True):
            first, shared, bias, second, second_bias = (next(weights) for _ in range(5))
            described = (table if place is None else torch.cat([table, next(far)], -1)).squeeze(0)
            hidden = act(_each(described, first) + torch.addmm(bias, seen, shared).unsqueeze(1))
            embedded = act(_each(hidden, second) + second_bias)
            parts += [embedded.mean(1), embedded.amax(1)]
        return torch.cat([*parts, x[:, inputs:]], 1)

    return Layer(
        "sets",
        c=filled(
            "sets.c", sets=sets, names=named([each.name for each in sets]), **said, beside=beside, kind=kind
        ).decode(),
        torch=pooled,
        arrays=(*own, *(array for each in sets for array in each.arrays)),
        numbers=(("sets", structure), *said.items(), ("activation", kind)),
        width=max(inputs + beside, outputs),
    )


def _each(things: Tensor, weight: Tensor) -> Tensor:
    """Return things [rows, K, W] times a weight, in a form that ONNX takes for any K."""
    return torch.bmm(things, weight.expand(things.shape[0], -1, -1))
