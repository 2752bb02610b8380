"""A program as an ONNX model, which torch makes of its graph of plain operations; needs the extra `export`."""

from __future__ import annotations

import logging
import os
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from esp_cli.defaults import __version__
from esp_cli.export.check import Numbers, Runner, Sample
from esp_cli.export.program import Program
from esp_cli.export.sets import named
from esp_cli.export.torch_file import exported_program
from esp_envs.errors import UserError
from esp_envs.installed import install

OPSET = 20  # the first with layer normalisation, and a maximum of flags; runtimes since 2023 read it


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
    `outputs` [rows, outputs] of the last layer, and `memory_out` [rows, H]. A team's rows stand side by side.

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
