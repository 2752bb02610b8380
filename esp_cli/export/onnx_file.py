"""A program as an ONNX model, written in ONNX's text format; needs the extra `export`."""

from __future__ import annotations

import json
import os
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.defaults import __version__
from esp_cli.export.check import Numbers, Runner
from esp_cli.export.layers import Floats, Layer
from esp_cli.export.program import SQUASH_EPSILON, Program
from esp_cli.export.sets import named
from esp_envs.errors import UserError
from esp_envs.installed import install

OPSET, IR_VERSION = 17, 8  # the first with layer normalisation; runtimes since 2022 read it

_MASK = """
    flags = Cast<to = 1>(action_mask)
    largest = ReduceMax<axes = [1], keepdims = 1>(flags)
    some = Cast<to = 9>(largest)
    none = Not(some)
    allowed = Or(action_mask, none)
    scores = Where(allowed, outputs, -Infinity)"""
_ENCODE = """
    column = Unsqueeze(action, [1])
    equal = Equal(column, {every})
    encoded = Cast<to = 1>(equal)"""
_SQUASH = f"""
    squares = Mul(outputs, outputs)
    sums = MatMul(squares, same_group)
    positive = Add(sums, {SQUASH_EPSILON})
    length = Sqrt(positive)
    bounded = Tanh(length)
    scale = Div(bounded, length)
    action = Mul(outputs, scale)"""


def library(name: str) -> Any:
    """Import onnx or onnxruntime; the latter reports nothing to its makers."""
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # else it writes to the home folder too
    try:
        return import_module(name)
    except ImportError:
        raise UserError(f"an ONNX export needs the package {name}: {install('export')}") from None


def onnx_model(program: Program, description: str) -> bytes:
    """Write a program as an ONNX model.

    Inputs: `observation` [rows, D]; of a recurrent policy `memory` [rows, H]; of one with masks `action_mask` [rows, A]
    bool; of a network over sets `set_NAME` [rows, K, W]. Outputs: `action` ([rows] int64 or [rows, width] float32),
    `outputs` [rows, outputs] of the last layer, and `memory_out` [rows, H]. A team's rows stand side by side, world
    after world.

    The description, which is JSON, goes into the model's metadata.
    """
    onnx, graph = library("onnx"), _Graph()
    choose, row = program.head == "choose", f"float[rows, {program.num_outputs}]"
    inputs = [f"float[rows, {program.num_inputs}] observation"]
    outputs = ["int64[rows] action" if choose else f"{row} action", f"{row} outputs"]
    x = "observation"
    if program.memory_width:
        inputs.append(f"float[rows, {program.memory_width}] memory")
        outputs.append(f"float[rows, {program.memory_width}] memory_out")
        graph.add(f"hidden = Slice(memory, [0], [{program.hidden}], [1])")
    tables = zip(named([name for name, _ in program.sets]), program.sets, strict=True)
    inputs += [f"float[rows, things{k}, {len(c[0])}] set_{name}" for k, (name, (_, c)) in enumerate(tables)]
    if program.previous:
        graph.add(f"previous = Slice(memory, [{program.hidden}], [{program.memory_width}], [1])")
        graph.add("start = Concat<axis = 1>(observation, previous)")
        x = "start"
    hidden = "hidden"
    for k, layer in enumerate(program.layers):
        x = graph.add_layer(k, layer, x)
        hidden = x if layer.kind == "gru" else hidden
    graph.add(f"outputs = Identity({x})")
    encoded = "action"
    if choose:
        if program.masked:
            inputs.append(f"bool[rows, {program.num_outputs}] action_mask")
            graph.add(_MASK)
        graph.add(f"action = ArgMax<axis = -1, keepdims = 0>({'scores' if program.masked else 'outputs'})")
        if program.previous:
            graph.add(_ENCODE.format(every=str([list(range(program.num_outputs))]).replace(" ", "")))
            encoded = "encoded"
    else:
        groups = np.repeat(np.arange(len(program.groups)), program.groups)
        graph.constants["same_group"] = (groups[:, None] == groups).astype(np.float32)
        graph.add(_SQUASH)
    if program.memory_width:
        after = f"Concat<axis = 1>({hidden}, {encoded})" if program.previous else f"Identity({hidden})"
        graph.add(f"memory_out = {after}")
    head = f'ir_version: {IR_VERSION}, opset_import: ["": {OPSET}], producer_name: "esp"'
    text = f"policy ({', '.join(inputs)}) => ({', '.join(outputs)})"
    lines = "\n".join(graph.lines)
    model = onnx.parser.parse_model(f'<{head}, producer_version: "{__version__}"> {text} {{\n{lines}\n}}')
    arrays = (onnx.numpy_helper.from_array(np.ascontiguousarray(a), name) for name, a in graph.constants.items())
    model.graph.initializer.extend(arrays)
    onnx.helper.set_model_props(model, {"esp": description})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


class _Graph:
    """Lines of ONNX's text format, and the constants that they name."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.constants: dict[str, Any] = {}

    def add(self, text: str) -> None:
        """Add lines `name = Operation(argument, ...)`; an argument may be a number, or integers without spaces."""
        for line in filter(None, map(str.strip, text.splitlines())):
            start, arguments = line.removesuffix(")").rsplit("(", 1)
            self.lines.append(f"{start}({', '.join(map(self._named, arguments.split(', ')))})")

    def add_layer(self, k: int, layer: Layer, x: str) -> str:
        arrays = layer.onnx_arrays or layer.arrays
        self.constants |= {f"w{i}_{k}": array for i, array in enumerate(arrays)}
        names = [name for line in layer.onnx.splitlines() for name in line.partition(" = ")[0].strip().split(", ")]
        renamed = {name: f"{name}_{k}" for name in (*names, *(f"w{i}" for i in range(len(arrays))))} | {"x": x}
        self.add(re.sub(r"\b[a-z]\w*", lambda match: renamed.get(match[0], match[0]), layer.onnx))
        return f"y_{k}"

    def _named(self, argument: str) -> str:
        try:
            value = json.loads(argument)
        except json.JSONDecodeError:
            return argument
        name = f"c{len(self.constants)}"
        self.constants[name] = np.array(value, np.int64 if isinstance(value, list) else np.float32)
        return name


def onnx_runner(file: Path) -> Runner:
    """Run a written ONNX model with onnxruntime."""
    session = library("onnxruntime").InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]

    def run(
        obs: Floats, memory: Floats, mask: Numbers | None = None, sets: dict[str, Floats] | None = None
    ) -> tuple[Numbers, Numbers, Numbers]:
        rows = {"observation": obs, "memory": memory, "action_mask": mask}
        rows |= {
            f"set_{name}": table for name, table in zip(named([*(sets or {})]), (sets or {}).values(), strict=True)
        }
        results = session.run(None, {name: rows[name] for name in names})
        return results[0], results[1], results[2] if len(results) > 2 else memory

    return run
