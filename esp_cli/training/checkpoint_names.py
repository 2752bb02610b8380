"""The checkpoint files of a run: their names, the run that they are of, and which of them a newer one supersedes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from esp_cli.training.checkpoint import CheckpointError, read_description
from esp_cli.training.folder_names import CHECKPOINTS, CONFIG
from esp_envs.mpe.frozen_prey import digest

_FILE_NAME = re.compile(r"step-(\d{12})(-final)?\.safetensors")
KEPT_CHECKPOINTS = 2
"""Two, so that a damaged newest one leaves another to go on from."""
RUN_ID, CONFIG_SHA256 = "run_id", "config_sha256"
"""Keys of `config.json` and of a checkpoint's description; folders and checkpoints of esp 0.1 may lack them."""


@dataclass(frozen=True)
class Stamp:
    """What a checkpoint says of the run that it is of: the identity, and a digest of the configuration.

    Example:
        >>> Stamp.of("a1", {"task": "navigation", "device": "cpu"}) == Stamp.of("a1", {"task": "navigation"})
        True
    """

    identity: str | None
    config_sha256: str

    @classmethod
    def of(cls, identity: str | None, config: Mapping[str, Any]) -> Stamp:
        """Return the stamp of a run; its device is left out, as a run may go on on another one."""
        return cls(identity, digest({}, {key: value for key, value in config.items() if key != "device"}))

    def entries(self) -> dict[str, Any]:
        """Return the entries of a checkpoint's description."""
        return {RUN_ID: self.identity, CONFIG_SHA256: self.config_sha256}

    def require(self, file: Path, description: Mapping[str, Any]) -> None:
        """Refuse a checkpoint of another run, or one that was written under another configuration.

        Raises:
            CheckpointError: it is one.
        """
        if description.get(RUN_ID) != self.identity:
            raise CheckpointError(f"{file} is a checkpoint of another run; move it out of this folder")
        if description.get(CONFIG_SHA256, self.config_sha256) != self.config_sha256:
            config = file.parents[1] / CONFIG
            raise CheckpointError(
                f"{file} was written under another configuration than that in {config}; restore that file, or train "
                "anew under another --out"
            )

    def is_foreign(self, file: Path) -> bool:
        """Return whether a checkpoint is of another run; a damaged one does not say so."""
        with suppress(CheckpointError):
            return bool(read_description(file).get(RUN_ID) != self.identity)
        return False


def file_name(step: int, final: bool) -> str:
    """Return the name of the checkpoint at a step (env steps per seed); `final` means that training is done."""
    return f"step-{step:012d}{'-final' if final else ''}.safetensors"


def checkpoints_in(run: Path) -> list[Path]:
    """Return the checkpoint files of a run folder, oldest first."""
    folder = run / CHECKPOINTS
    return sorted(file for file in folder.iterdir() if _FILE_NAME.fullmatch(file.name)) if folder.is_dir() else []


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
