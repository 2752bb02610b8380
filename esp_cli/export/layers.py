"""The kinds of layers that exports know, each with its form in C and in torch, of which ONNX is made.

A kind is a function here, an entry of `LAYERS` in `numpy_policy.py` and a function of `layers.c`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

Floats = NDArray[np.float32]

NORM_EPSILON = 1e-5  # layer normalisation adds this to the variance, as torch does by default


@dataclass(frozen=True)
class Layer:
    """One step of a program: rows x to rows y.

    In C (in the names of `templates/policy.c.jinja`) w0, w1, ... stand for the arrays. `torch` makes y [rows, width]
    of x, the arrays, and what the kind asks for: `gru` for the hidden state [rows, H], `sets` for the tables.
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
        c=f"affine(w0, w1, {inputs}, {outputs}, x, y);\nSWAP;",
        torch=lambda x, w, _: torch.addmm(w[1], x, w[0]),
        arrays=(weight, bias),
        width=max(inputs, outputs),
    )


def norm(weight: Floats, bias: Floats) -> Layer:
    """Return (x - mean) / sqrt(variance + 1e-5) * weight + bias over a row."""
    return Layer(
        "norm",
        c=f"normalise(w0, w1, {weight.size}, x);",
        torch=lambda x, w, _: F.layer_norm(x, x.shape[-1:], w[0], w[1], NORM_EPSILON),
        arrays=(weight, bias),
    )


def activation(kind: str, width: int) -> Layer:
    """Return relu or tanh of every number of a row."""
    return Layer(
        kind,
        c=f"apply_{kind}(x, {width});",
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
