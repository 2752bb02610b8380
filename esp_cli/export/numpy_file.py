"""A program as one Python file that needs numpy alone."""

from __future__ import annotations

import base64
import inspect
import json
import textwrap
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from esp_cli.export import numpy_policy
from esp_cli.export.check import Numbers, Runner
from esp_cli.export.layers import Floats
from esp_cli.export.program import Program
from esp_cli.export.templates import filled


def numpy_source(program: Program, comment: str, description: dict[str, Any]) -> bytes:
    """Write a program as a Python file: a comment, the runtime as it is, then this policy's description and numbers."""
    return filled(
        "policy.py",
        comment=comment.replace("\\", "/").replace('"""', "'''"),
        runtime=inspect.getsource(numpy_policy).partition("annotations\n\n")[2],
        description=json.dumps(description, indent=1),
        program=json.dumps(program.describe()),
        weights="\n".join(textwrap.wrap(base64.b64encode(program.weights).decode(), 112)),
    )


def numpy_runner(file: Path) -> Runner:
    """Run a written Python file."""
    spec = spec_from_file_location(f"esp_exported_{id(file)}", file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    policy = module.POLICY

    def run(
        obs: Floats, memory: Floats, mask: Numbers | None = None, sets: dict[str, Floats] | None = None
    ) -> tuple[Numbers, Numbers, Numbers]:
        count, team = len(obs), policy.program["team"]
        lead = (count // team, team) if team > 1 else (count,)
        inputs = [rows.reshape(*lead, rows.shape[1]) for rows in (obs, memory)]
        allowed = None if mask is None else mask.reshape(*lead, mask.shape[1])
        results = (*policy.step(*inputs, allowed, sets), policy.outputs(*inputs, sets)[0])
        action, after, outputs = (rows.reshape(count, *rows.shape[len(lead) :]) for rows in results)
        return action, outputs, after

    return run
