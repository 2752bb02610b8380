"""A program as an ONNX model, built node by node; needs the extra `export`."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

from esp_cli.defaults import __version__
from esp_cli.export import layers
from esp_cli.export.program import Program
from esp_envs.errors import UserError
from esp_envs.extras import install
from esp_envs.spec import others_of

OPSET = 17
"""The first with layer normalisation; runtimes since 2022 read it."""
IR_VERSION = 8


def library(name: str) -> Any:
    """Import onnx or onnxruntime; the latter reports nothing to its makers.

    Raises:
        UserError: it is not installed.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # else it writes to the home folder too
    try:
        return import_module(name)
    except ImportError:
        raise UserError(f"an ONNX export needs the package {name}: {install('export')}") from None


def onnx_model(program: Program, description: str) -> bytes:
    """Write a program as an ONNX model.

    Inputs: `observation` [rows, D]; of a recurrent policy `memory` [rows, H]; of one with masks `action_mask` [rows, A]
    bool. Outputs: `action` ([rows] int64 or [rows, width] float32), `outputs` [rows, outputs] of the last layer, and
    `memory_out` [rows, H]. A team's rows stand side by side, world after world.

    Args:
        program: the policy.
        description: JSON that goes into the model's metadata.

    Raises:
        UserError: onnx is not installed.
    """
    onnx = library("onnx")
    graph = _Graph(onnx)
    float_type, int_type = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
    value = onnx.helper.make_tensor_value_info
    inputs = [value("observation", float_type, ["rows", program.num_inputs])]
    x, hidden = "observation", ""
    if program.memory_width:
        inputs.append(value("memory", float_type, ["rows", program.memory_width]))
        hidden = graph.slice("memory", 0, program.hidden)
    if program.previous:
        x = graph.node("Concat", [x, graph.slice("memory", program.hidden, program.memory_width)], axis=1)
    for layer in program.layers:
        if isinstance(layer, layers.Recurrent):
            x = hidden = graph.recur(graph.affine(x, layer.input), graph.affine(hidden, layer.recurrent), hidden)
        else:
            x = graph.layer(x, layer)
    graph.name(x, "outputs")
    outputs = [value("outputs", float_type, ["rows", program.num_outputs])]
    if program.head == "choose":
        if program.masked:
            inputs.append(value("action_mask", onnx.TensorProto.BOOL, ["rows", program.num_outputs]))
            x = graph.allowed(x, "action_mask")
        done = graph.name(graph.node("ArgMax", [x], axis=-1, keepdims=0), "action")
        outputs.insert(0, value("action", int_type, ["rows"]))
    else:
        done = graph.name(graph.squash(x, program.groups), "action")
        outputs.insert(0, value("action", float_type, ["rows", program.num_outputs]))
    if program.memory_width:
        after = graph.node("Concat", [hidden, graph.encode(done, program)], axis=1) if program.previous else hidden
        graph.name(after, "memory_out")
        outputs.append(value("memory_out", float_type, ["rows", program.memory_width]))
    model = onnx.helper.make_model(
        onnx.helper.make_graph(graph.nodes, "policy", inputs, outputs, graph.constants),
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="esp",
        producer_version=__version__,
    )
    onnx.helper.set_model_props(model, {"esp": description})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


class _Graph:
    """Nodes and constants as they come; each method returns the name of what it makes."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, kind: str, inputs: list[str], **attributes: object) -> str:
        name = f"t{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, array: Any) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def name(self, value: str, name: str) -> str:
        """Give a value a second name, as an output of the model."""
        self.nodes.append(self.onnx.helper.make_node("Identity", [value], [name]))
        return name

    def slice(self, value: str, begin: int, end: int) -> str:
        """Return columns of a matrix."""
        bounds = [self.constant(np.array([k], np.int64)) for k in (begin, end, 1)]
        return self.node("Slice", [value, *bounds])

    def affine(self, x: str, layer: layers.Affine) -> str:
        return self.node("Gemm", [x, self.constant(layer.weight), self.constant(layer.bias)])

    def layer(self, x: str, layer: layers.Layer) -> str:
        """Return what a layer without memory makes of x."""
        writers: dict[type, Callable[[str, Any], str]] = {
            layers.Affine: self.affine,
            layers.Activation: lambda x, layer: self.node("Relu" if layer.name == "relu" else "Tanh", [x]),
            layers.Norm: self.normalise,
            layers.Slice: lambda x, layer: self.slice(x, layer.begin, layer.end),
            layers.Convolution: self.convolve,
            layers.GlobalMaxPool: self.global_max_pool,
            layers.MessageAggregation: self.aggregate,
        }
        return writers[type(layer)](x, layer)

    def normalise(self, x: str, layer: layers.Norm) -> str:
        arrays = [self.constant(array) for array in layer.arrays]
        return self.node("LayerNormalization", [x, *arrays], axis=-1, epsilon=layers.NORM_EPSILON)

    def reshape(self, value: str, *shape: int) -> str:
        return self.node("Reshape", [value, self.constant(np.array(shape, np.int64))])

    def reduce(self, kind: str, value: str, axis: int, keepdims: int = 0) -> str:
        if kind == "ReduceSum":  # of these the first whose axes became an input
            return self.node(kind, [value, self.constant(np.array([axis], np.int64))], keepdims=keepdims)
        return self.node(kind, [value], axes=[axis], keepdims=keepdims)

    def convolve(self, x: str, layer: layers.Convolution) -> str:
        shape = (layer.outputs, layer.channels, layer.side, layer.side)
        weight = self.constant(layer.weight.T.reshape(shape))
        pictures = self.reshape(x, -1, layer.channels, layer.rows, layer.columns)
        out = self.node("Conv", [pictures, weight, self.constant(layer.bias)], strides=[layer.stride, layer.stride])
        return self.reshape(out, -1, layer.width)

    def global_max_pool(self, x: str, layer: layers.GlobalMaxPool) -> str:
        """Take the largest number of each channel."""
        return self.reduce("ReduceMax", self.reshape(x, -1, layer.channels, layer.places), 2)

    def aggregate(self, x: str, layer: layers.MessageAggregation) -> str:
        """Return own features beside the means over the near."""
        number = [self.constant(np.array(value, np.float32)) for value in (1, layer.reach_squared, layer.reach)]
        one, reach_squared, reach = number
        others = layer.team - 1
        ways = self.reshape(self.slice("observation", layer.begin, layer.end), -1, others, 2)
        squares = self.reduce("ReduceSum", self.node("Mul", [ways, ways]), 2, keepdims=1)
        near = self.node("Cast", [self.node("Less", [squares, reach_squared])], to=self.onnx.TensorProto.FLOAT)
        count = self.node("Add", [self.reduce("ReduceSum", near, 1, keepdims=1), one])
        share = self.node("Div", [near, count])  # [rows, N - 1, 1]
        mean_way = self.reduce("ReduceSum", self.node("Mul", [share, self.node("Div", [ways, reach])]), 1)
        index = self.constant(np.array(others_of(layer.team), np.int64))
        said = self.node("Gather", [self.reshape(x, -1, layer.team, layer.width), index], axis=1)
        said = self.reshape(said, -1, others, layer.width)
        heard = self.reduce("ReduceSum", self.node("Mul", [share, said]), 1)
        return self.node("Concat", [x, mean_way, heard], axis=1)

    def recur(self, p: str, q: str, hidden: str) -> str:
        """Return the next hidden state from both projections."""
        (pr, pz, pn), (qr, qz, qn) = self._thirds(p), self._thirds(q)
        reset = self.node("Sigmoid", [self.node("Add", [pr, qr])])
        update = self.node("Sigmoid", [self.node("Add", [pz, qz])])
        candidate = self.node("Tanh", [self.node("Add", [pn, self.node("Mul", [reset, qn])])])
        return self.node("Add", [candidate, self.node("Mul", [update, self.node("Sub", [hidden, candidate])])])

    def _thirds(self, value: str) -> list[str]:
        names = [f"t{len(self.nodes)}_{k}" for k in range(3)]
        self.nodes.append(self.onnx.helper.make_node("Split", [value], names, axis=1))
        return names

    def squash(self, x: str, groups: tuple[int, ...]) -> str:
        """Return u tanh|u| / |u| for each group."""
        width = sum(groups)
        same: layers.Floats = np.zeros((width, width), np.float32)
        place = 0
        for size in groups:
            same[place : place + size, place : place + size] = 1
            place += size
        squares = self.node("MatMul", [self.node("Mul", [x, x]), self.constant(same)])
        epsilon = self.constant(np.array(layers.SQUASH_EPSILON, np.float32))
        length = self.node("Sqrt", [self.node("Add", [squares, epsilon])])
        return self.node("Mul", [x, self.node("Div", [self.node("Tanh", [length]), length])])

    def allowed(self, x: str, mask: str) -> str:
        """Return x with -infinity where the mask forbids; where it forbids everything, x."""
        types = self.onnx.TensorProto
        some = self.reduce("ReduceMax", self.node("Cast", [mask], to=types.FLOAT), 1, keepdims=1)
        nothing = self.node("Not", [self.node("Cast", [some], to=types.BOOL)])
        allowed = self.node("Or", [mask, nothing])
        return self.node("Where", [allowed, x, self.constant(np.array(-np.inf, np.float32))])

    def encode(self, action: str, program: Program) -> str:
        """Return an action as the memory holds it."""
        if program.head == "squash":
            return action
        column = self.node("Unsqueeze", [action, self.constant(np.array([1], np.int64))])
        every = self.constant(np.arange(program.num_outputs, dtype=np.int64)[None])
        return self.node("Cast", [self.node("Equal", [column, every])], to=self.onnx.TensorProto.FLOAT)
