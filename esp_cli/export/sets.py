"""The layer of exports that reads sets of things: a table for each, with any number of rows; see `networks.sets`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from esp_cli.export.layers import Floats, Layer
from esp_cli.networks.set_features import distances_among, nearest_things


@dataclass(frozen=True)
class SetOf:
    """One set of things, and the weights that embed each of them."""

    name: str
    columns: tuple[tuple[int, ...], ...]  # of an observation, for each thing those of its numbers [K, W]
    place: int | None  # the number at which a thing's place begins; None where it has none
    reader: int | None  # the own number at which the reader's place begins; None where it is the origin
    arrays: tuple[Floats, ...]  # W_1 [W + distances, H] of a thing, V [own, H] of the own numbers, b_1, W_2, b_2

    @property
    def width(self) -> int:
        """W, numbers of a thing."""
        return len(self.columns[0])


def named(sets: Sequence[str]) -> list[str]:
    """Return the names of sets in C and ONNX."""
    return [name if name.isidentifier() and name.isascii() else str(k) for k, name in enumerate(sets)]


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
        c=_c(sets, bool(own), kept, inputs, beside, near, kind),
        torch=pooled,
        arrays=(*own, *(array for each in sets for array in each.arrays)),
        numbers=(
            ("sets", structure),
            ("kept", list(kept)),
            ("inputs", inputs),
            ("near", near),
            ("activation", kind),
            ("embeds_own", bool(own)),
        ),
        width=max(inputs + beside, outputs),
    )


def _each(things: Tensor, weight: Tensor) -> Tensor:
    """Return things [rows, K, W] times a weight, in a form that an archive takes for any K."""
    return torch.bmm(things, weight.expand(things.shape[0], -1, -1))


def _c(
    sets: Sequence[SetOf], embeds_own: bool, kept: Sequence[int], inputs: int, beside: int, near: int, kind: str
) -> str:
    """Return the C of a row, in which `set_NAME` has `num_NAME` things: each is described, embedded and pooled."""
    features, (num_own, _) = sets[0].arrays[3].shape[0], sets[0].arrays[1].shape
    located = [(k, each) for k, each in enumerate(sets) if each.place is not None]
    nearest = located if near else []
    lines = [
        "static const float origin[2] = {0.0f, 0.0f};",
        f"static float own[{len(kept)}], thing[{max(len(each.arrays[0]) for each in sets)}];",
        f"static float shared[{features}], first[{features}], second[{features}];",
        *(f"static float near{k}[{near * each.width}];" for k, each in nearest),
        "float none = 0.0f;",
    ]
    for k, name in enumerate(named([each.name for each in sets])):
        lines += [f"const float *things{k} = set_{name};", f"int count{k} = num_{name};"]
    for k, each in nearest:
        reader = "origin" if each.reader is None else f"x + {each.reader}"
        chosen = f"nearest_things(things{k}, count{k}, {each.width}, {each.place}, {reader}, {near}, near{k})"
        lines += [f"count{k} = {chosen};", f"things{k} = near{k};"]
    for k, each in located:
        lines.append(f"none = farthest(things{k} + {each.place}, count{k}, {each.width}, origin, none);")
    lines += [f"own[{k}] = x[{column}];" for k, column in enumerate(kept)]
    if embeds_own:
        lines += [f"affine(w0, w1, {len(kept)}, {num_own}, own, y);", f"apply_{kind}(y, {num_own});"]
    else:
        lines.append("memcpy(y, own, sizeof(own));")
    array, column = 2 * embeds_own, num_own
    for k, each in enumerate(sets):
        w = [f"w{array + i}" for i in range(5)]
        far = []
        if each.place is not None:
            far.append(f"thing[{each.width}] = sqrtf(apart(at + {each.place}, origin));")
            for column_of, (j, other) in enumerate(located, each.width + 1):
                given = f"at + {each.place}, things{j} + {other.place}, count{j}, {other.width}, 4.0f * none"
                far.append(f"thing[{column_of}] = sqrtf(nearest({given}));")
        lines += [
            f"affine({w[1]}, {w[2]}, {num_own}, {features}, y, shared);",
            f"for (i = 0; i < count{k}; i++) {{",
            f"const float *at = things{k} + i * {each.width};",
            f"memcpy(thing, at, sizeof(float) * {each.width});",
            *far,
            f"affine({w[0]}, shared, {len(each.arrays[0])}, {features}, thing, first);",
            f"apply_{kind}(first, {features});",
            f"affine({w[3]}, {w[4]}, {features}, {features}, first, second);",
            f"apply_{kind}(second, {features});",
            f"pool({features}, i, count{k}, second, y + {column});",
            "}",
        ]
        array, column = array + 5, column + 2 * features
    lines += [f"memcpy(y + {column}, x + {inputs}, sizeof(float) * {beside});"] if beside else []
    return "\n".join(["{", *lines, "}", "SWAP;"])
