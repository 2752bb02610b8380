"""A run's folder: its configuration, its metrics as they come, its checkpoints, and a lock that one process holds.

Layout::

    config.json                             the resolved configuration, and the identity of the run
    metrics.jsonl                           a row per update, see esp_cli.training.metrics
    checkpoints/step-000000500000.safetensors   the newest two; only step-...-final.safetensors when training is done
    policy.safetensors                      the trained policy
    initial-policy.safetensors              the policy that the run started from, where it started from one
    run.lock                                held by the process that trains; says which

Every file but the metrics is replaced as a whole, so that a process may be killed at any moment: the next one goes on
from the newest checkpoint that is good. A checkpoint carries the identity of its run and a digest of its configuration;
that of another run is neither resumed nor removed. What the user can correct is a UserError.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from shlex import quote
from typing import Any

from torch import Tensor

from esp_cli.files.documents import DocumentFormat
from esp_cli.files.formatting import attempting
from esp_cli.files.opening import holding, open_own
from esp_cli.files.writing import TEMPORARY_PREFIX
from esp_cli.training.checkpoint import (
    CHECKPOINT_FORMAT,
    POLICY_FORMAT,
    digest,
    load_checkpoint,
    read_description,
    save_checkpoint,
)
from esp_cli.training.folder_names import CHECKPOINTS, CONFIG, INITIAL, LOCK, METRICS, POLICY
from esp_envs.errors import UserError

KEPT_CHECKPOINTS = 2  # so that a damaged newest one leaves another to go on from
RUN_ID, CONFIG_SHA256 = "run_id", "config_sha256"  # keys of `config.json` and of checkpoints, but of esp 0.1
_CHECKPOINT_NAME = re.compile(r"step-(\d{12})(-final)?\.safetensors")


RUN_FORMAT = DocumentFormat("esp-run", 1, "the configuration of a run")


def read_run_config(path: Path) -> tuple[dict[str, Any], str | None]:
    """Return the configuration that the `config.json` of a run holds, and its identity where it has one."""
    config = RUN_FORMAT.read(path)
    identity = config.pop(RUN_ID, None)
    if not isinstance(identity, str | None):
        raise UserError(f"{path} is damaged: its {RUN_ID} is not a text")
    return config, identity


class RunFolder:
    """A folder that holds one run, made by :meth:`create` or :meth:`open` with its resolved configuration.

    Its identity was drawn when it was made; it is None of a run of esp 0.1.
    """

    def __init__(self, path: Path, config: dict[str, Any], identity: str | None = None) -> None:
        self.path, self.config, self.identity = path, config, identity
        self.metrics_path, self.policy_path = path / METRICS, path / POLICY
        self.initial_path, self.lock_path = path / INITIAL, path / LOCK
        # the device is left out, as a run may go on on another one
        self._config_sha256 = digest({}, {key: value for key, value in config.items() if key != "device"})

    @classmethod
    def create(
        cls, path: str | os.PathLike[str], config: dict[str, Any], initial: Mapping[str, Tensor] | None = None
    ) -> RunFolder:
        """Make a run folder; its configuration is written last, so that a folder with one is complete."""
        path = Path(path)
        with attempting("make the run folder", path):
            if path.exists() and not path.is_dir():
                raise UserError(f"{path} is a file; choose another --out")
            path.mkdir(parents=True, exist_ok=True)
            _refuse_taken(path)
            folder = cls(path, config, secrets.token_hex(16))
            with folder.lock():
                # a second time, as another process may have made a run here in between
                _refuse_taken(path)
                folder.initial_path.unlink(missing_ok=True)
                (path / CHECKPOINTS).mkdir(exist_ok=True)
                os.close(open_own(folder.metrics_path, os.O_WRONLY))
                if initial is not None:
                    save_checkpoint(folder.initial_path, initial, {}, POLICY_FORMAT)
                RUN_FORMAT.write(path / CONFIG, {RUN_ID: folder.identity, **config})
        return folder

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> RunFolder:
        path = Path(path)
        if (path / CONFIG).is_file():
            return cls(path, *read_run_config(path / CONFIG))
        what = "is a file, not a run folder" if path.exists() else "does not exist"
        what = f"is no run folder: it has no {CONFIG}" if path.is_dir() else what
        raise UserError(f"{path} {what}; give the folder that esp train --out made")

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the folder, so that no second process writes to it; what a killed one left half-written is removed."""
        checkpoints = self.path / CHECKPOINTS
        if checkpoints.is_symlink():
            raise UserError(f"{checkpoints} is a link, which is not followed; put the folder itself there")
        with holding(self.lock_path):
            with attempting("tidy up", self.path):
                for folder in (self.path, checkpoints):
                    for file in folder.glob(f"{TEMPORARY_PREFIX}*"):
                        file.unlink(missing_ok=True)
                if self.policy_path.is_file():  # a process was killed before it came to this
                    self._remove_superseded()
            yield

    def checkpoint_path(self, step: int, final: bool = False) -> Path:
        return self.path / CHECKPOINTS / f"step-{step:012d}{'-final' if final else ''}.safetensors"

    def checkpoints(self) -> list[Path]:
        return checkpoints_in(self.path)

    def write_checkpoint(
        self, step: int, tensors: Mapping[str, Tensor], meta: Mapping[str, Any], final: bool = False
    ) -> None:
        """Write a checkpoint at a step (env steps per seed), then remove those that are not needed any more.

        Write the metrics of the step first: they are flushed to the disk before the checkpoint that stands for them.
        The newest two and the newest final one, written when training is done, are kept. Those past ``step`` go, as
        the run has gone back from there; those of another run stay.
        """
        path = self.checkpoint_path(step, final)
        with attempting("write", path):
            path.parent.mkdir(exist_ok=True)
            if self.metrics_path.exists():
                with self.metrics_path.open("rb+") as metrics:
                    os.fsync(metrics.fileno())
        stamp = {RUN_ID: self.identity, CONFIG_SHA256: self._config_sha256}
        save_checkpoint(path, tensors, {**meta, **stamp, "step": step})
        regular, finals, past = list[Path](), list[Path](), list[Path]()
        for file in self.checkpoints():
            (past if step_of(file) > step else finals if _is_final(file) else regular).append(file)
        self._remove([*past, *regular[:-KEPT_CHECKPOINTS], *finals[:-1]])

    def write_policy(self, tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
        """Write the trained policy as a file of its own that needs no run folder; training is done with that."""
        save_checkpoint(self.policy_path, tensors, meta, POLICY_FORMAT)
        self._remove_superseded()

    def latest_checkpoint(self, note: Callable[[str], object]) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """Return the newest good checkpoint; `note` is told, in a sentence, of a damaged one that is passed over.

        It is tensors, on the CPU, and a description, with ``step``. None where the run has written none yet, or where
        all are damaged but its policy file is there; without that, or where the newest good one is of another run or
        configuration, that is an error.
        """
        problem = None
        for file in reversed(self.checkpoints()):
            try:
                tensors, meta = load_checkpoint(file)
                if meta.get("step") != step_of(file):
                    raise UserError(f"{file} does not hold the step that its name says")
            except UserError as error:
                if file.exists():  # another process may have ended the run, and removed it, since it was listed
                    problem = problem or str(error)
                continue
            self._require_own(file, meta)
            if problem:
                note(f"{problem}; going back to step {step_of(file)}")
            return tensors, {key: value for key, value in meta.items() if key not in (RUN_ID, CONFIG_SHA256)}
        if problem and not self.policy_path.is_file():
            raise UserError(f"{self.path} has no good checkpoint ({problem}); train anew under another --out")
        if problem:
            note(f"{problem}; taking {self.policy_path}")
        return None

    def task_version(self) -> int | None:
        """Return the version of the task that the run was trained on; None where no good file states it."""
        for file in (self.policy_path, *reversed(self.checkpoints())):
            with contextlib.suppress(UserError):
                about = read_description(file, POLICY_FORMAT if file == self.policy_path else CHECKPOINT_FORMAT)
                if type(version := about.get("task_version")) is int:
                    return version
        return None

    def _require_own(self, file: Path, meta: Mapping[str, Any]) -> None:
        """Refuse a checkpoint of another run, or one that was written under another configuration."""
        if meta.get(RUN_ID) != self.identity:
            raise UserError(f"{file} is a checkpoint of another run; move it out of this folder")
        if meta.get(CONFIG_SHA256, self._config_sha256) != self._config_sha256:
            raise UserError(
                f"{file} was written under another configuration than that in {self.path / CONFIG}; restore that "
                "file, or train anew under another --out"
            )

    def _remove_superseded(self) -> None:
        files = self.checkpoints()
        if any(map(_is_final, files)):
            self._remove(file for file in files if not _is_final(file))

    def _remove(self, checkpoints: Iterable[Path]) -> None:
        for file in checkpoints:
            own = True
            with contextlib.suppress(UserError):
                own = read_description(file).get(RUN_ID) == self.identity
            if own:
                with attempting("remove", file):
                    file.unlink(missing_ok=True)


def checkpoints_in(run: Path) -> list[Path]:
    """Return the checkpoint files of a run folder, oldest first."""
    folder = run / CHECKPOINTS
    files = folder.iterdir() if folder.is_dir() else ()
    return sorted(file for file in files if _CHECKPOINT_NAME.fullmatch(file.name))


def step_of(checkpoint: Path) -> int:
    """Return the step that a checkpoint's name says."""
    return int(checkpoint.name[len("step-") :][:12])


def _is_final(checkpoint: Path) -> bool:
    return checkpoint.name.endswith("-final.safetensors")


def _refuse_taken(path: Path) -> None:
    """Refuse a folder that holds a run or files that no run has."""
    if (path / CONFIG).exists():
        raise UserError(f"{path} exists: resume with esp train --resume {quote(str(path))} or choose another --out")
    foreign = sorted(entry.name for entry in path.iterdir() if not _is_leftover(entry))
    if foreign:
        raise UserError(f"{path} is not empty and no run folder (it has {foreign[0]!r}); choose another --out")


def _is_leftover(entry: Path) -> bool:
    if entry.name == CHECKPOINTS:
        return entry.is_dir() and not any(entry.iterdir())
    if entry.name == METRICS:
        return entry.is_file() and entry.stat().st_size == 0
    if entry.name == INITIAL:  # a killed process left its lock beside it
        return (entry.parent / LOCK).exists()
    return entry.name == LOCK or entry.name.startswith(TEMPORARY_PREFIX)
