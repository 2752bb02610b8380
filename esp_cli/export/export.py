"""Exports of a policy: written, checked against the policy itself, and only then put where they are wanted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from esp_cli.export import check, epuck
from esp_cli.export.c_source import CSource, c_source
from esp_cli.export.card import describe, readme
from esp_cli.export.check import Agreement, take_sample
from esp_cli.export.formats import FORMATS, Files, Job
from esp_cli.export.program import Program
from esp_cli.export.translate import program_of
from esp_cli.files.documents import parse_object
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import replace_file
from esp_cli.policies.loading import TrainedPolicy
from esp_envs.errors import UserError

STM32F4_FLASH_BYTES, STM32F4_RAM_BYTES = 1024 * 1024, 192 * 1024
"""Of the e-puck2's microcontroller, an STM32F407."""

DESCRIPTION = "policy.json"
MAX_DESCRIPTION_BYTES = 1 << 26


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


def export(alone: TrainedPolicy, formats: Sequence[str], folder: Path, force: bool = False) -> Exported:
    """Write one seed's policy in some formats, with `policy.json` and a README, after checking each.

    Args:
        alone: one seed's policy.
        formats: of `FORMATS`.
        folder: where to; made where it is missing.
        force: replace files of an earlier export.

    Raises:
        UserError: a file exists already, an earlier export has formats that are not written anew, a library is
            missing, or the format does not support the policy.
    """
    formats = tuple(dict.fromkeys(formats))
    if force:
        _refuse_mixture(formats, folder)
    program = replace(program_of(alone.policy), masked=alone.spec.masks)
    sample = take_sample(alone, program)
    description = describe(alone, program, sample)
    drives = any(FORMATS[name].observer for name in formats) and not program.memory_width
    robotic = drives and "robot" in description and epuck.builds_observations(alone.spec.settings)
    job = Job(alone, program, sample, description, epuck.take_scenes(alone) if robotic else None)
    written = {name: FORMATS[name].write(job) for name in formats}
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
    left = [name for name in FORMATS if isinstance(known, list) and name in known and name not in formats]
    if left:
        again = " ".join(f"-f {name}" for name in left)
        raise UserError(
            f"{folder} holds an export with other formats; write them anew too ({again}), or choose another --out"
        )


def _write(files: Files, folder: Path, force: bool) -> None:
    """Put files into a folder, each as a whole."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file; name a folder for the export with --out")
    taken = sorted(name for name in files if (folder / name).exists())
    if taken and not force:
        raise UserError(f"{folder} has {taken[0]} already; choose another --out, or replace it with --force")
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        replace_file(folder / name, content)


def _checked(name: str, files: Files, job: Job) -> Export:
    """Run a format's files in a folder of their own beside the policy."""
    size, form = sum(map(len, files.values())), FORMATS[name]
    if name == "c" and check.compiler() is None:
        return Export(name, tuple(files), size, None, "there is no C compiler cc here, so the source was not run")
    with TemporaryDirectory(prefix="esp-export-") as scratch:
        folder = Path(scratch)
        for file, content in files.items():
            (folder / Path(file).name).write_bytes(content)
        agreement = check.compare(job.sample, form.run(folder, job.program))
        if name == "c" and not check.example_runs(folder):
            raise RuntimeError("the worked example of the exported C gives another action; this is a bug")
        seen = None
        if job.scenes is not None and form.observer is not None:
            seen = epuck.compare_scenes(job.scenes, form.observer(folder, job))
    return Export(name, tuple(files), size, agreement, seen=seen)


def _section(result: Export, job: Job, c: CSource | None) -> str:
    """Return the README's section on a format."""
    remembers = job.program.memory_width > 0
    mask, meaning = FORMATS[result.name].mask if job.program.masked else ("", "")
    use = FORMATS[result.name].use[remembers].format(mask=mask) + meaning
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
