"""Exports of a policy: written, checked against the policy itself, and only then put where they are wanted."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from esp_cli.deploy import check, epuck
from esp_cli.deploy.c_source import CSource, c_source, example_source
from esp_cli.deploy.card import describe, readme, summary
from esp_cli.deploy.check import Agreement, Sample, take_sample
from esp_cli.deploy.epuck_c import epuck_sources
from esp_cli.deploy.numpy_file import numpy_source
from esp_cli.deploy.onnx_file import onnx_model
from esp_cli.deploy.program import Program
from esp_cli.deploy.torch_file import torch_archive
from esp_cli.deploy.translate import program_of
from esp_cli.files.documents import parse_object
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import replace_file
from esp_cli.training.loading import TrainedPolicy

STM32F4_FLASH_BYTES, STM32F4_RAM_BYTES = 1024 * 1024, 192 * 1024
"""Of the e-puck2's microcontroller, an STM32F407."""

DESCRIPTION = "policy.json"
MAX_DESCRIPTION_BYTES = 1 << 26

Files = dict[str, bytes]


@dataclass(frozen=True)
class Export:
    """One format, as it was written.

    Attributes:
        name: of the format.
        files: names of the files.
        size: of them together, bytes.
        agreement: with the policy; None where it could not be run here.
        note: why it could not.
        seen: largest difference between an observation built from poses and the task's; None where none is built.
    """

    name: str
    files: tuple[str, ...]
    size: int
    agreement: Agreement | None
    note: str | None = None
    seen: float | None = None


@dataclass(frozen=True)
class Exported:
    """All formats, and what an action costs.

    Attributes:
        formats: as they were written.
        parameters: learned numbers.
        flops: operations for one action.
        c: flash and RAM of the C source, where it was written.
    """

    formats: tuple[Export, ...]
    parameters: int
    flops: int
    c: CSource | None


@dataclass(frozen=True)
class _Job:
    """What every format is written from."""

    alone: TrainedPolicy
    program: Program
    sample: Sample
    description: dict[str, Any]
    scenes: epuck.Scenes | None
    """Of a policy that can drive an e-puck."""

    @property
    def comment(self) -> str:
        return summary(self.alone, self.program)

    @property
    def text(self) -> str:
        return json.dumps(self.description)


def _c(job: _Job) -> Files:
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


def _policy(job: _Job) -> Files:
    return {"policy.py": numpy_source(job.program, job.comment, job.text).encode()}


def _numpy(job: _Job) -> Files:
    beside = {} if job.scenes is None else {"esp_epuck.py": (epuck.RUNTIME / "esp_epuck.py").read_bytes()}
    return _policy(job) | beside


def _epuck(job: _Job, kind: str) -> Files:
    """Return the numpy policy with what a robot's program needs around it."""
    spec = job.alone.spec
    prior = job.alone.config.prior.effective()
    if compass := prior.compass:
        label = f" and the agent's number, from {-compass:g} to {compass:g}" if "agents" in prior.transforms else ""
        raise ValueError(
            f"webots and ros2 build what a robot sees from poses, and know no compass; train without prior.compass, or "
            f"export numpy or c and end each observation with {compass:g}, 0, 0, {compass:g}{label}"
        )
    if "robot" not in job.description:
        raise ValueError(f"webots and ros2 drive e-pucks, but this policy is for {spec.name}; export one of formation")
    if not epuck.builds_observations(spec.settings):
        raise ValueError(
            "webots and ros2 build what a robot sees from poses, without heading_offset_rad and blind_sector_rad; "
            "train without them, or export numpy or c"
        )
    if job.program.memory_width:
        raise ValueError("webots and ros2 take policies that remember nothing; export one without --network gru")
    return epuck.controller_files(kind, _policy(job), spec.settings)


WRITERS: dict[str, Callable[[_Job], Files]] = {
    "onnx": lambda job: {"policy.onnx": onnx_model(job.program, job.text)},
    "torch": lambda job: {"policy.pt2": torch_archive(job.program, job.text)},
    "c": _c,
    "numpy": _numpy,
    "webots": lambda job: _epuck(job, "webots"),
    "ros2": lambda job: _epuck(job, "ros2"),
}
"""Format -> what writes its files. Adding one is a line here, one in `_runner` and one in `_USE`."""


def export(alone: TrainedPolicy, formats: Sequence[str], folder: Path, force: bool = False) -> Exported:
    """Write one seed's policy in some formats, with `policy.json` and a README, after checking each.

    Args:
        alone: one seed's policy.
        formats: of `WRITERS`.
        folder: where to; made where it is missing.
        force: replace files of an earlier export.

    Raises:
        ValueError: a file exists already, an earlier export has formats that are not written anew, a library is
            missing, or the format does not support the policy.
    """
    formats = tuple(dict.fromkeys(formats))
    if force:
        _refuse_mixture(formats, folder)
    program = replace(program_of(alone.policy), masked=alone.spec.masks)
    sample = take_sample(alone, program)
    description = describe(alone, program, sample)
    drives = bool({"c", "numpy", "webots", "ros2"} & set(formats)) and not program.memory_width
    robotic = drives and "robot" in description and epuck.builds_observations(alone.spec.settings)
    job = _Job(alone, program, sample, description, epuck.take_scenes(alone) if robotic else None)
    written = {name: WRITERS[name](job) for name in formats}
    c = c_source(program, "") if "c" in formats else None
    results = tuple(_checked(name, files, job) for name, files in written.items())
    sections = [_section(result, job, c) for result in results] + ([epuck.told(description)] if robotic else [])
    beside = {
        DESCRIPTION: (json.dumps(job.description | {"formats": formats}, indent=2) + "\n").encode(),
        "README.md": readme(alone, job.description, sections).encode(),
    }
    _write({name: content for files in written.values() for name, content in files.items()} | beside, folder, force)
    return Exported(results, program.num_parameters, program.flops, c)


def _refuse_mixture(formats: Sequence[str], folder: Path) -> None:
    """Refuse to leave files of an earlier export beside those of another policy."""
    try:
        there = parse_object(read_regular(folder / DESCRIPTION, MAX_DESCRIPTION_BYTES) or b"", "a description")
    except (OSError, ValueError):
        return
    known = there.get("formats")
    left = [name for name in WRITERS if isinstance(known, list) and name in known and name not in formats]
    if left:
        again = " ".join(f"-f {name}" for name in left)
        raise ValueError(
            f"{folder} holds an export with other formats; write them anew too ({again}), or choose another --out"
        )


def _write(files: Files, folder: Path, force: bool) -> None:
    """Put files into a folder, each as a whole."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; name a folder for the export with --out")
    taken = sorted(name for name in files if (folder / name).exists())
    if taken and not force:
        raise ValueError(f"{folder} has {taken[0]} already; choose another --out, or replace it with --force")
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        replace_file(folder / name, content)


def _checked(name: str, files: Files, job: _Job) -> Export:
    """Run a format's files in a folder of their own beside the policy."""
    size = sum(map(len, files.values()))
    if name == "c" and check.compiler() is None:
        return Export(name, tuple(files), size, None, "there is no C compiler cc here, so the source was not run")
    with TemporaryDirectory(prefix="esp-export-") as scratch:
        folder = Path(scratch)
        for file, content in files.items():
            (folder / Path(file).name).write_bytes(content)
        agreement = check.compare(job.sample, _runner(name, folder, job.program))
        if name == "c" and not check.example_runs(folder):
            raise RuntimeError("the worked example of the exported C gives another action; this is a bug")
        seen = _seen(name, folder, job)
    return Export(name, tuple(files), size, agreement, seen=seen)


def _seen(name: str, folder: Path, job: _Job) -> float | None:
    """Compare the observations that a format builds from poses with the task's."""
    if job.scenes is None or name in ("onnx", "torch"):
        return None
    c = name == "c"
    observe = epuck.c_observer(folder, job.program.num_inputs) if c else epuck.python_observer(job.description)
    return epuck.compare_scenes(job.scenes, observe)


def _runner(name: str, folder: Path, program: Program) -> check.Runner:
    if name == "onnx":
        return check.onnx_runner(folder / "policy.onnx")
    if name == "torch":
        return check.torch_runner(folder / "policy.pt2")
    if name == "c":
        return check.c_runner(folder / "policy.c", program)
    return check.numpy_runner(folder / "policy.py")


def _section(result: Export, job: _Job, c: CSource | None) -> str:
    """Return the README's section on a format."""
    remembers = job.program.memory_width > 0
    mask, meaning = _MASKS.get(result.name, ("", "")) if job.program.masked else ("", "")
    use = _USE[result.name][remembers].format(mask=mask) + meaning
    told = [f"## {', '.join(f'`{file}`' for file in result.files)}", "", use, ""]
    if result.agreement is None:
        told.append(f"Not compared with the policy: {result.note}.")
    else:
        agreement = result.agreement
        told.append(
            f"Compared with the policy on {agreement.observations} observations: largest difference "
            f"{agreement.max_difference:.1e}"
            + (f", {agreement.other_actions} other choices (ties)." if job.program.head == "choose" else ".")
        )
    if result.seen is not None:
        told.append(
            f"Observations built from poses were compared with the task's in {epuck.STATES} states: largest difference "
            f"{result.seen:.1e}."
        )
    if result.name == "c" and c is not None:
        told += ["", *cost_lines(c, job.program)]
    return "\n".join([*told, ""])


def cost_lines(c: CSource, program: Program) -> list[str]:
    """Return what the C source takes of a microcontroller, as a table."""
    return [
        "| of a microcontroller | | e-puck2 (STM32F407) |",
        "|---|---|---|",
        f"| flash: weights, and about 1 kB of code | {c.flash_bytes} bytes | {STM32F4_FLASH_BYTES} |",
        f"| RAM: scratch and one agent's memory | {c.ram_bytes} bytes | {STM32F4_RAM_BYTES} |",
        f"| operations an action | {program.flops} | |",
    ]


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
_USE = {
    "onnx": (
        "Inputs: `observation` [rows, D]{mask}; outputs: `action` and `outputs` (of the last layer).",
        "Inputs: `observation` [rows, D], `memory` [rows, H], zeros at first{mask}; outputs: `action`, `outputs` (of "
        "the last layer) and `memory_out`, the next step's `memory`.",
    ),
    "torch": (
        '`torch.export.load("policy.pt2").module()(observation{mask})` returns action and outputs of the last layer.',
        '`torch.export.load("policy.pt2").module()(observation, memory{mask})` returns action, outputs of the last '
        "layer and the next memory.",
    ),
    "c": (
        "C99, float32, no allocation: `esp_policy_act(observation{mask}, ...)`. Link with libm; "
        "`cc policy_example.c policy.c -lm && ./a.out` checks the worked example.",
        "C99, float32, no allocation: `esp_policy_reset(memory)` once an episode, then `esp_policy_act(observation"
        "{mask}, memory, ...)`, with a memory for each agent. Link with libm; `cc policy_example.c policy.c -lm && "
        "./a.out` checks the worked example.",
    ),
    "numpy": (
        f"{_NUMPY_USE}`action = policy.act(obs{{mask}})` with rows [..., D].",
        f"{_NUMPY_USE}`memory = policy.initial_memory(num_agents)` once an episode, and each step `action, memory = "
        "policy.step(obs, memory{mask})` with rows [num_agents, D].",
    ),
    "webots": (_WEBOTS_USE, _WEBOTS_USE),
    "ros2": (_ROS2_USE, _ROS2_USE),
}
"""How a format is used: by a policy that remembers nothing, and by one that does; a mask stands where {mask} is."""
_MASKS = {
    "onnx": (", `action_mask` [rows, A] bool", " `action_mask` says which actions each row may take."),
    "torch": (", action_mask=action_mask", " `action_mask` [rows, A] bool says which actions each row may take."),
    "c": (", allowed", " `allowed` is 1 for each action that may be taken, else 0."),
    "numpy": (", action_mask", " `action_mask` [..., A] bool says which actions each row may take."),
}
"""Format -> how its calls name the mask of a policy that has one, and what it means."""
