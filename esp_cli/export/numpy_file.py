"""A program as one Python file that needs numpy alone."""

from __future__ import annotations

import base64
import inspect
import json
import runpy
import textwrap
from pathlib import Path
from typing import Any

from esp_cli.export import numpy_policy
from esp_cli.export.check import Numbers, Runner, Sample
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
    policy = runpy.run_path(str(file))["POLICY"]

    def run(sample: Sample) -> tuple[Numbers, Numbers, Numbers]:
        count, team = len(sample.obs), policy.program["team"]
        lead = (count // team, team) if team > 1 else (count,)
        obs, memory = (rows.reshape(*lead, rows.shape[1]) for rows in (sample.obs, sample.memory))
        mask = None if sample.mask is None else sample.mask.reshape(*lead, sample.mask.shape[1])
        results = (*policy.step(obs, memory, mask, sample.sets), policy.outputs(obs, memory, sample.sets)[0])
        action, after, outputs = (rows.reshape(count, *rows.shape[len(lead) :]) for rows in results)
        return action, outputs, after

    return run
