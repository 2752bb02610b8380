"""Exports of a policy: written, checked against the policy itself, and only then put into the user's folder.

A format is one entry of `FORMATS`; `templates/README.md.jinja` says how its files are used.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from esp_cli.export import c_file, epuck
from esp_cli.export.card import EXPORT, describe, shortly, words
from esp_cli.export.check import Agreement, Runner, Sample, compare, take_sample
from esp_cli.export.numpy_file import numpy_runner, numpy_source
from esp_cli.export.onnx_file import onnx_model, onnx_runner
from esp_cli.export.program import Program, program_of
from esp_cli.export.templates import RUNTIME, filled
from esp_cli.export.torch_file import torch_archive, torch_runner
from esp_cli.files.formatting import escaped
from esp_cli.files.writing import replace_file
from esp_cli.policies.loading import TrainedPolicy
from esp_envs.errors import UserError

DESCRIPTION = "policy.json"
Files = dict[str, bytes]


@dataclass(frozen=True)
class Job:
    """What every format is written from."""

    trained: TrainedPolicy  # one seed's policy
    program: Program  # the same as plain arrays
    sample: Sample  # of what it does
    description: dict[str, Any]  # what `policy.json` holds
    words: dict[str, Any]  # what templates say of it
    seen: float | None  # of poses, see `Export`; None unless the policy can drive an e-puck
    note: str | None  # why it cannot, where its task can


@dataclass(frozen=True)
class Format:
    """How a policy is written for another program."""

    files: tuple[str, ...]  # that may be written
    write: Callable[[Job], Files]
    run: Callable[[Path, Program], Runner]  # makes what acts by the files in a folder


@dataclass(frozen=True)
class Export:
    """One format, as it was written."""

    name: str
    files: tuple[str, ...]
    size: int  # of the files together, bytes
    agreement: Agreement | None  # with the policy; None where it could not be run here
    note: str | None = None  # why it could not, or why no e-puck can be driven
    seen: float | None = None  # largest difference between an observation built from poses, if any, and the task's


@dataclass(frozen=True)
class Exported:
    """All formats."""

    formats: tuple[Export, ...]
    parameters: int  # learned numbers


def _c(job: Job) -> Files:
    example = {"policy_example.c": c_file.example_source(job.program, job.description["example"])}
    files = c_file.c_source(job.program, _summary(job)) | example
    return {name: c_file.of_role(source, job.trained.role) for name, source in files.items()}


def _numpy(job: Job) -> Files:
    source = numpy_source(job.program, _summary(job), job.description)
    beside = {} if job.seen is None else {"esp_epuck.py": (RUNTIME / "esp_epuck.py").read_bytes()}
    return {"policy.py": source} | beside


def _summary(job: Job) -> str:
    """Return title, layouts and memory as plain lines, for the top of a source file."""
    return escaped(filled("summary.txt", **job.words).decode().rstrip())


FORMATS = {
    "onnx": Format(
        ("policy.onnx",),
        lambda job: {"policy.onnx": onnx_model(job.program, json.dumps(job.description))},
        lambda folder, _: onnx_runner(folder / "policy.onnx"),
    ),
    "torch": Format(
        ("policy.pt2",),
        lambda job: {"policy.pt2": torch_archive(job.program, json.dumps(job.description))},
        lambda folder, _: torch_runner(folder / "policy.pt2"),
    ),
    "c": Format(
        ("policy.h", "policy.c", "policy_example.c"),
        _c,
        lambda folder, program: c_file.c_runner(folder / "policy.c", program),
    ),
    "numpy": Format(("policy.py", "esp_epuck.py"), _numpy, lambda folder, _: numpy_runner(folder / "policy.py")),
}
"""The formats by name; `esp export` lists them without importing them."""


def export(trained: TrainedPolicy, formats: Sequence[str], folder: Path, force: bool = False) -> Exported:
    """Write one seed's policy in some formats, with `policy.json` and a README, after checking each."""
    return export_all({folder: trained}, formats, force)[folder]


def export_all(
    policies: Mapping[Path, TrainedPolicy], formats: Sequence[str], force: bool = False
) -> dict[Path, Exported]:
    """Write policies into a folder each, as of a task's roles: all of them or, where one cannot be, none."""
    refuse_taken(policies, formats, force)
    ready = {folder: _made(trained, formats) for folder, trained in policies.items()}
    for folder, (_, files) in ready.items():
        _put(files, folder)
    return {folder: exported for folder, (exported, _) in ready.items()}


def _made(trained: TrainedPolicy, formats: Sequence[str]) -> tuple[Exported, Files]:
    """Make the files of an export and check each format; nothing is written yet."""
    formats = tuple(dict.fromkeys(formats))
    program = program_of(trained.policy)
    if not program.num_inputs and (empty := {"c", "torch"}.intersection(formats)):
        formats = " and ".join(sorted(empty))
        raise UserError(f"{trained.source} sees no number, which {formats} cannot hold; choose onnx or numpy")
    sample = take_sample(trained, program)
    description = describe(trained, program, sample)
    drives = "robot" in description and "numpy" in formats and not (program.memory_width or program.sets)
    seen, note = epuck.seen_from_poses(trained, description) if drives else (None, None)
    job = Job(trained, program, sample, description, words(trained, program, description), seen, note)
    files = {name: FORMATS[name].write(job) for name in formats}
    results = tuple(_checked(name, own, job) for name, own in files.items())
    written = {name: content for own in files.values() for name, content in own.items()}
    written[DESCRIPTION] = (json.dumps(job.description | {"formats": formats}, indent=2) + "\n").encode()
    written["README.md"] = _readme(job, results)
    return Exported(results, job.program.num_parameters), written


def refuse_taken(folders: Iterable[Path], formats: Sequence[str], force: bool) -> None:
    """Refuse a file in a folder's place and, unless forced, files in the place of those of an export."""
    names = ["README.md", DESCRIPTION, *(file for name in formats for file in FORMATS[name].files)]
    for folder in folders:
        if folder.exists() and not folder.is_dir():
            raise UserError(f"{folder} is a file; name a folder for the export with --out")
        blocked = next((folder / name for name in names if (folder / name).is_dir()), None)
        if blocked is not None:
            raise UserError(f"{blocked} is a folder in the place of a file; move it away, or choose another --out")
        taken = [name for name in dict.fromkeys(names) if (folder / name).exists()]
        if taken and not force:
            raise UserError(
                f"{folder} has {', '.join(taken)} already; choose another --out, or replace it with --force"
            )


def _put(files: Files, folder: Path) -> None:
    """Put files into a folder, each as a whole, in the place of all files of an export that is there.

    The description goes first and comes last: a folder with one is never half of an old export and half of a new one.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*sorted(_exported(folder) - files.keys()), DESCRIPTION):
        (folder / name).unlink(missing_ok=True)
    for name in sorted(files, key=DESCRIPTION.__eq__):
        replace_file(folder / name, files[name])


def _exported(folder: Path) -> set[str]:
    """Return the files that an export wrote into a folder, by its own description; none where there is none."""
    try:
        told = EXPORT.read(folder / DESCRIPTION).get("formats")
    except UserError:
        return set()
    return {file for name, known in FORMATS.items() if isinstance(told, list) and name in told for file in known.files}


def _checked(name: str, files: Files, job: Job) -> Export:
    """Run a format's files in a folder of their own beside the policy."""
    size, form = sum(map(len, files.values())), FORMATS[name]
    if name == "c" and c_file.compiler() is None:
        return Export(name, tuple(files), size, None, "there is no C compiler cc here, so the source was not run")
    with TemporaryDirectory(prefix="esp-export-") as scratch:
        folder = Path(scratch)
        for file, content in files.items():
            (folder / file).write_bytes(content)
        agreement = compare(job.sample, form.run(folder, job.program))
        if name == "c" and not c_file.example_runs(folder):
            raise RuntimeError("the worked example of the exported C gives another action; this is a bug")
    note, seen = (job.note, job.seen) if name == "numpy" else (None, None)
    return Export(name, tuple(files), size, agreement, note, seen)


def _readme(job: Job, results: Sequence[Export]) -> bytes:
    example = job.description["example"]
    readme = filled(
        "README.md",
        **job.words,
        example=[(k, shortly(v)) for k, v in example.items() if not k.startswith(("memory", "sets"))],
        results=results,
        states=epuck.STATES,
        robot=None if job.seen is None else job.description["robot"],
    )
    return c_file.of_role(readme, job.trained.role)
