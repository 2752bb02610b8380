"""A program as an ONNX model, which torch makes of its graph of plain operations; needs the extra `export`."""

from __future__ import annotations

import logging
import os
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.defaults import __version__
from esp_cli.export.check import Numbers, Runner, Sample
from esp_cli.export.program import Program
from esp_cli.export.sets import named
from esp_cli.networks.heads import masked, squash
from esp_envs.errors import UserError
from esp_envs.installed import install

OPSET = 20  # the first with layer normalisation, and a maximum of flags; runtimes since 2023 read it


class TorchProgram(nn.Module):
    """The program in torch's own operations.

    It takes observation [rows, D]; of recurrent policies memory [rows, H]; of those with masks action_mask [rows, A]
    bool; of networks over sets tables [rows, K, W] by name. It returns action ([rows] int64 or [rows, width]), outputs
    [rows, outputs] and, if recurrent, memory [rows, H].
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.program = program
        for k, layer in enumerate(program.layers):
            for i, array in enumerate(layer.arrays):
                self.register_buffer(f"w{k}_{i}", torch.from_numpy(array.copy()))
        self.disc = torch.block_diag(*(torch.ones(width, width) for width in program.groups or (1,)))

    def forward(
        self,
        observation: Tensor,
        memory: Tensor | None = None,
        action_mask: Tensor | None = None,
        sets: dict[str, Tensor] | None = None,
    ) -> tuple[Tensor, ...]:
        program, x = self.program, observation
        hidden = x[:, :0] if memory is None else memory[:, : program.hidden]
        if program.previous and memory is not None:
            x = torch.cat([x, memory[:, program.hidden :]], 1)
        for k, layer in enumerate(program.layers):
            arrays = [self.get_buffer(f"w{k}_{i}") for i in range(len(layer.arrays))]
            x = layer.torch(x, arrays, {"gru": hidden, "sets": sets}.get(layer.kind))
            hidden = x if layer.kind == "gru" else hidden
        if program.head == "choose":
            action = masked(x, action_mask).argmax(-1)
            encoded = nn.functional.one_hot(action, program.num_outputs).float()
        else:
            action = encoded = squash(x, self.disc)
        if memory is None:
            return action, x
        return action, x, torch.cat([hidden, encoded], 1) if program.previous else hidden


def exported_program(program: Program) -> torch.export.ExportedProgram:
    """Return a program as a graph of plain operations, for any number of rows."""
    rows = torch.export.Dim("rows", min=1)
    inputs = {"observation": torch.zeros(2, program.num_inputs)}
    if program.memory_width:
        inputs["memory"] = torch.zeros(2, program.memory_width)
    named = dict[str, Any]()
    if program.masked:
        named["action_mask"] = torch.ones(2, program.num_outputs, dtype=torch.bool)
    shapes: dict[str, Any] = {name: {0: rows} for name in inputs | named}
    if program.sets:
        widths = {name: len(columns[0]) for name, columns in program.sets}
        named["sets"] = {name: torch.zeros(2, 3 + k, width) for k, (name, width) in enumerate(widths.items())}
        shapes["sets"] = {name: {0: rows, 1: torch.export.Dim(f"things{k}")} for k, name in enumerate(widths)}
    return torch.export.export(TorchProgram(program).eval(), (*inputs.values(),), named, dynamic_shapes=shapes)


def library(name: str) -> Any:
    """Import onnx, onnxscript or onnxruntime; the latter reports nothing to its makers."""
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # else it writes to the home folder too
    try:
        return import_module(name)
    except ImportError:
        raise UserError(f"an ONNX export needs the package {name}: {install('export')}") from None


def onnx_model(program: Program, description: str) -> bytes:
    """Write a program as an ONNX model.

    Inputs: `observation` [rows, D]; of a recurrent policy `memory` [rows, H]; of one with masks `action_mask` [rows, A]
    bool; of a network over sets `set_NAME` [rows, K, W]. Outputs: `action` ([rows] int64 or [rows, width] float32),
    `outputs` [rows, outputs] of the last layer, and `memory_out` [rows, H].

    The description, which is JSON, goes into the model's metadata.
    """
    onnx, _ = library("onnx"), library("onnxscript")
    remembers = program.memory_width > 0
    inputs = ["observation", *["memory"] * remembers, *["action_mask"] * program.masked]
    inputs += [f"set_{name}" for name in named(name for name, _ in program.sets).values()]
    outputs = ["action", "outputs", *["memory_out"] * remembers]
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # else it tells what no policy uses
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = torch.onnx.export(
            exported_program(program),
            dynamo=True,
            verbose=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=outputs,
        )
    assert made is not None
    model = made.model_proto
    model.producer_name, model.producer_version = "esp", __version__
    for node in model.graph.node:  # where in torch and in this package it comes from
        node.ClearField("metadata_props")
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {"esp": description})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def onnx_runner(file: Path) -> Runner:
    """Run a written ONNX model with onnxruntime."""
    session = library("onnxruntime").InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]

    def run(sample: Sample) -> tuple[Numbers, Numbers, Numbers]:
        rows = {"observation": sample.obs, "memory": sample.memory, "action_mask": sample.mask}
        rows |= {f"set_{name}": sample.sets[given] for given, name in named(sample.sets).items()}
        results = session.run(None, {name: rows[name] for name in names})
        return results[0], results[1], results[2] if len(results) > 2 else sample.memory

    return run
