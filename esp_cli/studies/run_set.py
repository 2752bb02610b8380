"""A set of runs in one folder that one process at a time works on: what a study and a search have in common.

What is done and what is not is read off the folder alone, so a process may be killed at any moment, and the next one
goes on with what is there.
"""

from __future__ import annotations

import contextlib
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

from esp_cli.files.documents import Strict
from esp_cli.files.opening import holding, is_held
from esp_cli.files.writing import TEMPORARY_PREFIX
from esp_cli.training.config import RunConfig
from esp_cli.training.folder_names import CONFIG, FRESH, LOCK, LOG, METRICS, POLICY, STUDY_LOCK
from esp_cli.training.metrics import elapsed_s, read_last_row
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_envs.errors import UserError

FOLDER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")  # so that nothing is written outside of the set


class Cell(Strict):
    """One run of a study, and where it stands in tables and pictures."""

    name: str  # of its folder
    panel: str  # the picture that its curve is in, and one axis of the table
    variant: str  # its name in that picture, and the other axis
    config: RunConfig  # what is run
    reference: str | None = None  # name of the cell that it is compared with; None for such a cell itself
    # place of the paper's number, see `paper.reported`; None where there is none that compares
    paper: tuple[str, ...] | None = None


class RunSet(ABC):
    """Runs in a folder, with a title of one line for people."""

    document: ClassVar[str]  # name of the file that makes a folder one
    runs: ClassVar[str]  # name of the folder of its run folders
    noun: ClassVar[str]  # what messages call it

    def __init__(self, path: Path, title: str) -> None:
        self.path, self.title = path, title
        self.check = True  # whether runs take a short look at a task that is not built in

    @classmethod
    def is_one(cls, path: Path) -> bool:
        return (path / cls.document).is_file()

    @classmethod
    def refuse_foreign(cls, path: Path) -> None:
        """Refuse a folder that is neither new nor empty nor one of these, or that has a link where its runs belong."""
        if path.is_file():
            raise UserError(f"{path} is a file; choose another --out")
        if (path / cls.runs).is_symlink():
            raise UserError(f"{path / cls.runs} is a link, which is not followed; put the folder itself there")
        if not cls.is_one(path) and path.is_dir():
            names = (entry.name for entry in path.iterdir())
            foreign = [name for name in names if name != STUDY_LOCK and not name.startswith(TEMPORARY_PREFIX)]
            if foreign:
                raise UserError(f"{path} is not empty and no {cls.noun} (it has {foreign[0]!r}); choose another --out")

    @classmethod
    @contextlib.contextmanager
    def held(cls, path: Path) -> Iterator[None]:
        """Hold the folder, made if missing, so that no second process plans or works in it.

        Half-written documents that a killed process left are removed, those of the fresh study of a search too.
        """
        cls.refuse_foreign(path)
        path.mkdir(parents=True, exist_ok=True)
        with holding(path / STUDY_LOCK):
            for folder in (path, path / FRESH):
                for file in folder.glob(f"{TEMPORARY_PREFIX}*"):
                    file.unlink(missing_ok=True)
            yield

    def run_path(self, cell: Cell) -> Path:
        return self.path / self.runs / cell.name

    def log_path(self, cell: Cell) -> Path:
        """Return the file that the processes of a cell write to."""
        return self.run_path(cell) / LOG

    def prepare(self, cell: Cell) -> RunFolder:
        """Make the run folder of a cell, or open the one that is there, unless that is damaged or another run."""
        path = self.run_path(cell)
        if not (path / CONFIG).exists():
            return RunFolder.create(path, cell.config.model_dump(mode="json"))
        folder = RunFolder.open(path)
        if parse_config(folder.config, path) != cell.config:
            raise UserError(f"{path} holds a run of another configuration; move it away, or choose another --out")
        return folder

    def progress(self, cell: Cell) -> tuple[int, float]:
        """Return how many steps per seed a run has done in how many seconds, which it may redo from a checkpoint."""
        row = read_last_row(self.run_path(cell) / METRICS)
        return min(int(row.get("step", 0)), cell.config.steps), elapsed_s(row)

    def is_in_use(self, cell: Cell) -> bool:
        """Return whether a process works on a cell, such as one that a killed scheduler left."""
        return is_held(self.run_path(cell) / LOCK)

    def is_trained(self, cell: Cell) -> bool:
        """Return whether a cell's training is done; the policy file is the last that a run writes."""
        return (self.run_path(cell) / POLICY).is_file()

    @abstractmethod
    def is_finished(self, cell: Cell) -> bool:
        """Return whether nothing is left to do for a cell, by what is on the disk."""

    @abstractmethod
    def begin(self, cell: Cell) -> Cell:
        """Make the run folder of a cell before its next process starts; return what it runs, or raise RefusedError."""

    @abstractmethod
    def goes_on(self, cell: Cell) -> bool:
        """Look at what a run has written since the last look; return whether anything is left to do for it."""

    @abstractmethod
    def end(self, cell: Cell) -> None:
        """Tidy up after a cell for which nothing is left to do."""

    def next_command(self, cell: Cell) -> list[str]:
        """Return the arguments of the next process of a cell whose run folder is there."""
        unseen = [] if self.check else ["--no-check"]
        return ["train", "--resume", str(self.run_path(cell)), *unseen, *cell.config.own_words()]


class RefusedError(Exception):
    """A cell has nothing to run; the text says why."""
