"""The formats of an export: what writes each, runs it and says how it is used. Adding one is one entry of `FORMATS`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.export import check, epuck
from esp_cli.export.c_source import c_source, example_source
from esp_cli.export.card import summary
from esp_cli.export.check import Sample
from esp_cli.export.epuck_c import epuck_sources
from esp_cli.export.numpy_file import numpy_source
from esp_cli.export.onnx_file import onnx_model
from esp_cli.export.program import Program
from esp_cli.export.torch_file import torch_archive
from esp_cli.policies.loading import TrainedPolicy
from esp_envs.errors import UserError

Files = dict[str, bytes]


@dataclass(frozen=True)
class Job:
    """What every format is written from."""

    alone: TrainedPolicy
    program: Program
    sample: Sample
    description: dict[str, Any]
    scenes: epuck.Scenes | None
    """Of a policy that can drive an e-puck."""

    @property
    def comment(self) -> str:
        """What the policy is, as plain lines for the top of a source file."""
        return summary(self.alone, self.program)

    @property
    def text(self) -> str:
        """The description as JSON."""
        return json.dumps(self.description)


def _c(job: Job) -> Files:
    written, example = c_source(job.program, job.comment), job.description["example"]
    observation, action, allowed = (
        np.ravel(example.get(name, [])).tolist() for name in ("observation", "action", "action_mask")
    )
    files = {
        "policy.h": written.header.encode(),
        "policy.c": written.source.encode(),
        "policy_example.c": example_source(job.program, observation, action, allowed).encode(),
    }
    return files if job.scenes is None else files | epuck_sources(job.description)


def _policy(job: Job) -> Files:
    return {"policy.py": numpy_source(job.program, job.comment, job.text).encode()}


def _numpy(job: Job) -> Files:
    beside = {} if job.scenes is None else {"esp_epuck.py": (epuck.RUNTIME / "esp_epuck.py").read_bytes()}
    return _policy(job) | beside


def _epuck(job: Job, kind: str) -> Files:
    """Return the numpy policy with what a robot's program needs around it."""
    spec = job.alone.spec
    prior = job.alone.config.prior.effective()
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
    return epuck.controller_files(kind, _policy(job), spec.settings)


@dataclass(frozen=True)
class Format:
    """How a policy is written for another program.

    Attributes:
        write: returns its files.
        run: makes what acts by the files in a folder, to be compared with the policy.
        use: for the README, of a policy that remembers nothing and of one that does; a mask stands where {mask} is.
        mask: how the calls in `use` name the mask of a policy that has one, and what it means.
        observer: makes what builds observations from poses by the files in a folder; None where the format has no such.
    """

    write: Callable[[Job], Files]
    run: Callable[[Path, Program], check.Runner]
    use: tuple[str, str]
    mask: tuple[str, str] = ("", "")
    observer: Callable[[Path, Job], epuck.Observer] | None = None


def _numpy_runner(folder: Path, _: Program) -> check.Runner:
    return check.numpy_runner(folder / "policy.py")


def _python_observer(_: Path, job: Job) -> epuck.Observer:
    return epuck.python_observer(job.description)


_NUMPY_USE = "Needs numpy alone; running the file checks its worked example. `import policy`, then "
_ROBOT_USE = (
    " Positions of all robots in, wheel speeds out; robots stand still where a number is not finite. **It was run "
    "against a mocked interface over simulated robots, and never on hardware**: lift the robots before the first start."
    " The controller's head says what it expects."
)
_WEBOTS_USE = "A Webots project around the numpy policy: open `worlds/formation.wbt` (untested in Webots)." + _ROBOT_USE
_ROS2_USE = (
    "A ROS 2 package around the numpy policy (untested in ROS 2): `colcon build`, then `ros2 launch esp_formation "
    "formation.launch.py`." + _ROBOT_USE
)
FORMATS = {
    "onnx": Format(
        write=lambda job: {"policy.onnx": onnx_model(job.program, job.text)},
        run=lambda folder, _: check.onnx_runner(folder / "policy.onnx"),
        use=(
            "Inputs: `observation` [rows, D]{mask}; outputs: `action` and `outputs` (of the last layer).",
            "Inputs: `observation` [rows, D], `memory` [rows, H], zeros at first{mask}; outputs: `action`, `outputs` "
            "(of the last layer) and `memory_out`, the next step's `memory`.",
        ),
        mask=(", `action_mask` [rows, A] bool", " `action_mask` says which actions each row may take."),
    ),
    "torch": Format(
        write=lambda job: {"policy.pt2": torch_archive(job.program, job.text)},
        run=lambda folder, _: check.torch_runner(folder / "policy.pt2"),
        use=(
            '`torch.export.load("policy.pt2").module()(observation{mask})` returns action and outputs of the '
            "last layer.",
            '`torch.export.load("policy.pt2").module()(observation, memory{mask})` returns action, outputs of the last '
            "layer and the next memory.",
        ),
        mask=(", action_mask=action_mask", " `action_mask` [rows, A] bool says which actions each row may take."),
    ),
    "c": Format(
        write=_c,
        run=lambda folder, program: check.c_runner(folder / "policy.c", program),
        use=(
            "C99, float32, no allocation: `esp_policy_act(observation{mask}, ...)`. Link with libm; "
            "`cc policy_example.c policy.c -lm && ./a.out` checks the worked example.",
            "C99, float32, no allocation: `esp_policy_reset(memory)` once an episode, then `esp_policy_act(observation"
            "{mask}, memory, ...)`, with a memory for each agent. Link with libm; `cc policy_example.c policy.c -lm && "
            "./a.out` checks the worked example.",
        ),
        mask=(", allowed", " `allowed` is 1 for each action that may be taken, else 0."),
        observer=lambda folder, job: epuck.c_observer(folder, job.program.num_inputs),
    ),
    "numpy": Format(
        write=_numpy,
        run=_numpy_runner,
        use=(
            f"{_NUMPY_USE}`action = policy.act(obs{{mask}})` with rows [..., D].",
            f"{_NUMPY_USE}`memory = policy.initial_memory(num_agents)` once an episode, and each step `action, memory "
            "= policy.step(obs, memory{mask})` with rows [num_agents, D].",
        ),
        mask=(", action_mask", " `action_mask` [..., A] bool says which actions each row may take."),
        observer=_python_observer,
    ),
    "webots": Format(
        write=lambda job: _epuck(job, "webots"),
        run=_numpy_runner,
        use=(_WEBOTS_USE, _WEBOTS_USE),
        observer=_python_observer,
    ),
    "ros2": Format(
        write=lambda job: _epuck(job, "ros2"),
        run=_numpy_runner,
        use=(_ROS2_USE, _ROS2_USE),
        observer=_python_observer,
    ),
}
"""The formats by name; `esp export` lists them without importing them, and -f policy beside them."""
