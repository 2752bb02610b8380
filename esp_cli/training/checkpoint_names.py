"""The names of a run's checkpoint files, and which of them a newer one supersedes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from esp_cli.training.folder_names import CHECKPOINTS

FILE_NAME = re.compile(r"step-(\d{12})(-final)?\.safetensors")
KEPT_CHECKPOINTS = 2
"""Two, so that a damaged newest one leaves another to go on from."""


def file_name(step: int, final: bool) -> str:
    """Return the name of the checkpoint at a step (env steps per seed); `final` means that training is done."""
    return f"step-{step:012d}{'-final' if final else ''}.safetensors"


def place_of(run: Path, name: str) -> Path:
    """Return where a file of a run folder is: checkpoints have a folder of their own."""
    return run / CHECKPOINTS / name if FILE_NAME.fullmatch(name) else run / name


def checkpoints_in(run: Path) -> list[Path]:
    """Return the checkpoint files of a run folder, oldest first."""
    folder = run / CHECKPOINTS
    return sorted(file for file in folder.iterdir() if FILE_NAME.fullmatch(file.name)) if folder.is_dir() else []


def step_of(path: Path) -> int:
    """Return the step that a checkpoint's name says."""
    return int(path.name[len("step-") :][:12])


def is_final(path: Path) -> bool:
    """Return whether a checkpoint was written when training was done."""
    return path.name.endswith("-final.safetensors")


def superseded(files: Sequence[Path], step: int) -> list[Path]:
    """Return the checkpoints that are not needed once there is a good one at `step`.

    The newest two and the newest final one are kept. Those past `step` go, as the run has gone back from there.

    Args:
        files: all checkpoints of a run, oldest first.
        step: env steps per seed.
    """
    past = [file for file in files if step_of(file) > step]
    regular = [file for file in files if file not in past and not is_final(file)]
    finals = [file for file in files if file not in past and is_final(file)]
    return [*past, *regular[:-KEPT_CHECKPOINTS], *finals[:-1]]
