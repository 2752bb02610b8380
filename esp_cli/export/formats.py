"""The formats of an export: what writes each and runs it. Adding one is one entry of `FORMATS`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.export import epuck, epuck_files
from esp_cli.export.c_check import c_runner
from esp_cli.export.c_source import c_source, example_source
from esp_cli.export.card import summary
from esp_cli.export.check import Runner, Sample
from esp_cli.export.layers import Program
from esp_cli.export.numpy_file import numpy_runner, numpy_source
from esp_cli.export.onnx_file import onnx_model, onnx_runner
from esp_cli.export.templates import RUNTIME
from esp_cli.export.torch_file import torch_archive, torch_runner
from esp_cli.policies.loading import TrainedPolicy
from esp_envs.errors import UserError

Files = dict[str, bytes]


@dataclass(frozen=True)
class Job:
    """What every format is written from.

    Attributes:
        trained: one seed's policy.
        program: the same as plain arrays.
        sample: of what it does.
        description: what `policy.json` holds.
        scenes: states of the task; None unless the policy can drive an e-puck.
    """

    trained: TrainedPolicy
    program: Program
    sample: Sample
    description: dict[str, Any]
    scenes: epuck.Scenes | None

    @property
    def comment(self) -> str:
        """What the policy is, as plain lines for the top of a source file."""
        return summary(self.trained, self.program)

    @property
    def text(self) -> str:
        """The description as JSON."""
        return json.dumps(self.description)


@dataclass(frozen=True)
class Format:
    """How a policy is written for another program; `templates/README.md.jinja` says how it is used.

    Attributes:
        write: returns its files.
        run: makes what acts by the files in a folder, to be compared with the policy.
        observer: makes what builds observations from poses by the files in a folder; None where the format has no such.
    """

    write: Callable[[Job], Files]
    run: Callable[[Path, Program], Runner]
    observer: Callable[[Path, Job], epuck.Observer] | None = None


def _c(job: Job) -> Files:
    example = job.description["example"]
    rows = (np.ravel(example.get(name, [])).tolist() for name in ("observation", "action", "action_mask"))
    files = c_source(job.program, job.comment) | {"policy_example.c": example_source(job.program, *rows)}
    return files if job.scenes is None else files | epuck_files.c_files(job.description)


def _policy(job: Job) -> Files:
    return {"policy.py": numpy_source(job.program, job.comment, job.text)}


def _numpy(job: Job) -> Files:
    beside = {} if job.scenes is None else {"esp_epuck.py": (RUNTIME / "esp_epuck.py").read_bytes()}
    return _policy(job) | beside


def _robot(job: Job, kind: str) -> Files:
    """Return the numpy policy with what a robot's program needs around it."""
    spec = job.trained.spec
    prior = job.trained.config.prior.effective()
    if compass := prior.compass:
        label = f" and the agent's number, from {-compass:g} to {compass:g}" if "agents" in prior.transforms else ""
        raise UserError(
            f"webots and ros2 build what a robot sees from poses, and know no compass; train without prior.compass, or "
            f"export numpy or c and end each observation with {compass:g}, 0, 0, {compass:g}{label}"
        )
    if "robot" not in job.description:
        raise UserError(f"webots and ros2 drive e-pucks, but this policy is for {spec.name}; export one of formation")
    if not epuck.builds_observations(spec.settings):
        raise UserError(
            "webots and ros2 build what a robot sees from poses, without heading_offset_rad and blind_sector_rad; "
            "train without them, or export numpy or c"
        )
    if job.program.memory_width:
        raise UserError("webots and ros2 take policies that remember nothing; export one without --network gru")
    return epuck_files.project_files(kind, _policy(job), spec.settings)


def _run_numpy(folder: Path, _: Program) -> Runner:
    return numpy_runner(folder / "policy.py")


def _observe_in_python(_: Path, job: Job) -> epuck.Observer:
    return epuck.python_observer(job.description)


FORMATS = {
    "onnx": Format(
        lambda job: {"policy.onnx": onnx_model(job.program, job.text)},
        lambda folder, _: onnx_runner(folder / "policy.onnx"),
    ),
    "torch": Format(
        lambda job: {"policy.pt2": torch_archive(job.program, job.text)},
        lambda folder, _: torch_runner(folder / "policy.pt2"),
    ),
    "c": Format(
        _c,
        lambda folder, program: c_runner(folder / "policy.c", program),
        lambda folder, job: epuck.c_observer(folder, job.program.num_inputs),
    ),
    "numpy": Format(_numpy, _run_numpy, _observe_in_python),
    "webots": Format(lambda job: _robot(job, "webots"), _run_numpy, _observe_in_python),
    "ros2": Format(lambda job: _robot(job, "ros2"), _run_numpy, _observe_in_python),
}
"""The formats by name; `esp export` lists them without importing them, and -f policy beside them."""
