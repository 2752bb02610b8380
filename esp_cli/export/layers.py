"""The kinds of layers that exports know, each with its form in C and in torch, of which ONNX is made.

A kind is a function here, an entry of `LAYERS` in `numpy_policy.py` and a function of `layers.c`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from esp_envs.spec import others_of

Floats = NDArray[np.float32]

NORM_EPSILON = 1e-5  # layer normalisation adds this to the variance, as torch does by default


@dataclass(frozen=True)
class Layer:
    """One step of a program: rows x to rows y.

    In C (in the names of `templates/policy.c.jinja`) w0, w1, ... stand for the arrays. `torch` makes y [rows, width]
    of x, the arrays, and the observations [rows, D]; the kind `gru` takes the hidden state [rows, H] instead of the
    latter, `sets` the tables.
    """

    kind: str  # its name in JSON
    c: str
    torch: Callable[[Tensor, list[Tensor], Any], Tensor]
    arrays: tuple[Floats, ...] = ()  # learned numbers, in the order in which exports store them
    numbers: tuple[tuple[str, object], ...] = ()  # what JSON says of it, beside the shapes of the arrays
    width: int = 0  # of the widest row that it reads or writes, where another layer does not tell

    def describe(self) -> dict[str, object]:
        """Return the layer as JSON stores it: without its weights, but with their shapes."""
        return {"kind": self.kind, **dict(self.numbers), "shapes": [list(array.shape) for array in self.arrays]}


def affine(weight: Floats, bias: Floats) -> Layer:
    """Return x W + b with W [in, out] and b [out]."""
    inputs, outputs = weight.shape
    return Layer(
        "affine",
        c=f"EACH affine(w0, w1, {inputs}, {outputs}, X, Y);\nSWAP;",
        torch=lambda x, w, _: torch.addmm(w[1], x, w[0]),
        arrays=(weight, bias),
        width=max(inputs, outputs),
    )


def norm(weight: Floats, bias: Floats) -> Layer:
    """Return (x - mean) / sqrt(variance + 1e-5) * weight + bias over a row."""
    return Layer(
        "norm",
        c=f"EACH normalise(w0, w1, {weight.size}, X);",
        torch=lambda x, w, _: F.layer_norm(x, x.shape[-1:], w[0], w[1], NORM_EPSILON),
        arrays=(weight, bias),
    )


def activation(kind: str, width: int) -> Layer:
    """Return relu or tanh of every number of a row."""
    return Layer(
        kind,
        c=f"EACH apply_{kind}(X, {width});",
        torch=lambda x, *_: torch.relu(x) if kind == "relu" else torch.tanh(x),
        numbers=(("width", width),),
    )


def gru(weight: Floats, bias: Floats, hidden_weight: Floats, hidden_bias: Floats) -> Layer:
    """Return a gated recurrent unit of H numbers: r, z = s(p + q); n = tanh(p + r q); h' = n + z (h - n).

    p = x W + b and q = h U + c, each in the order r, z, n; W, b, U, c in the order of the arguments.
    """
    size = len(hidden_weight)

    def advance(x: Tensor, w: list[Tensor], hidden: Tensor) -> Tensor:
        pr, pz, pn = torch.addmm(w[1], x, w[0]).chunk(3, -1)
        qr, qz, qn = torch.addmm(w[3], hidden, w[2]).chunk(3, -1)
        reset, update = torch.sigmoid(pr + qr), torch.sigmoid(pz + qz)
        candidate = torch.tanh(pn + reset * qn)
        return candidate + update * (hidden - candidate)

    return Layer(
        "gru",
        c=f"affine(w0, w1, {len(weight)}, 3 * {size}, x, into);\n"
        f"affine(w2, w3, {size}, 3 * {size}, memory, back);\n"
        f"recur({size}, into, back, memory);\n"
        f"memcpy(x, memory, sizeof(float) * {size});",
        torch=advance,
        arrays=(weight, bias, hidden_weight, hidden_bias),
    )


def convolution(weight: Floats, bias: Floats, begin: int, shape: tuple[int, ...], side: int, stride: int) -> Layer:
    """Return a filter at every `stride`-th place of pictures [channels, rows, columns] from column `begin` on."""
    (channels, rows, columns), outputs, end = shape, bias.size, begin + math.prod(shape)
    filters = (outputs, channels, side, side)
    said = {"begin": begin, "channels": channels, "rows": rows, "columns": columns, "side": side, "stride": stride}
    return Layer(
        "convolution",
        c=f"EACH convolve(w0, w1, {channels}, {rows}, {columns}, {side}, {stride}, {outputs}, X + {begin}, Y);\nSWAP;",
        torch=lambda x, w, _: F.conv2d(
            x[:, begin:end].unflatten(1, shape), w[0].T.reshape(filters), w[1], stride
        ).flatten(1),
        arrays=(weight, bias),
        numbers=(*said.items(),),
        width=math.prod(convolved(shape, outputs, side, stride)),
    )


def convolved(shape: tuple[int, ...], outputs: int, side: int, stride: int) -> tuple[int, int, int]:
    """Return channels, rows and columns that a convolution makes of a picture."""
    return outputs, (shape[1] - side) // stride + 1, (shape[2] - side) // stride + 1


def global_max_pool(channels: int, places: int) -> Layer:
    """Return the largest number of each channel: [channels x places] to [channels]."""
    return Layer(
        "global_max_pool",
        c=f"EACH global_max_pool({channels}, {places}, X, Y);\nSWAP;",
        torch=lambda x, *_: x.unflatten(1, (channels, places)).amax(2),
        numbers=(("channels", channels), ("places", places)),
    )


def aggregate(begin: int, team: int, width: int, reach_squared: float) -> Layer:
    """Return own features x beside the neighbours' mean message: [x, mean relative position / reach, mean of their x].

    The observation holds others' relative positions from column `begin` on, two numbers each, in team order. Neighbours
    have a squared distance below `reach_squared`. Means divide by their number plus one, for the agent itself.
    """
    index = torch.tensor(others_of(team))

    def hear(x: Tensor, _: list[Tensor], observation: Tensor) -> Tensor:
        ways = observation[:, begin : begin + 2 * (team - 1)].unflatten(1, (-1, 2))
        near = (ways.square().sum(2, keepdim=True) < reach_squared).float()
        share = near / (1 + near.sum(1, keepdim=True))  # [rows, N - 1, 1]
        own = torch.arange(x.shape[0])  # rows and not worlds: an archive with a number of worlds takes no single one
        messages = x[(own - own % team).unsqueeze(1) + index[own % team]]
        return torch.cat([x, (share * (ways / math.sqrt(reach_squared))).sum(1), (share * messages).sum(1)], 1)

    return Layer(
        "aggregate",
        c=f"aggregate(observation + {begin}, {width}, {reach_squared}f, x, y);\nSWAP;",
        torch=hear,
        numbers=(("begin", begin), ("team", team), ("width", width), ("reach_squared", reach_squared)),
    )
