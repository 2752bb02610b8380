"""A study: a named list of runs in one folder, each of which is compared with another one and with the paper.

Layout::

    study.json          what is to be run, and the command that said so
    runs/NAME/          one run folder per cell, see esp_cli.training.run_folder
    runs/NAME/final-evaluation.json   the trained policies beside the reference policies, on episodes of their own
                        (judgement.json in folders of versions before 0.2)
    runs/NAME/log.txt   what the processes that trained and evaluated it said
    study.lock          held by the process that works on the study
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from esp_cli.defaults import __version__
from esp_cli.files.documents import MAX_DOCUMENT_BYTES, DocumentFormat, Strict, parse_object, shortened, validate
from esp_cli.files.locking import acquire, release
from esp_cli.files.opening import open_own, read_regular, require_held
from esp_cli.files.writing import TEMPORARY_PREFIX
from esp_cli.policies.evaluation import FinalEvaluation
from esp_cli.training.build import spec_of
from esp_cli.training.config import RunConfig, completed
from esp_cli.training.config_file import parse_config
from esp_cli.training.folder_names import CONFIG, FINAL, FRESH, LOG, POLICY, STUDY, STUDY_LOCK
from esp_cli.training.run_folder import RunFolder
from esp_envs.errors import UserError

_FOLDER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")
_OLD_FINAL = "judgement.json"


class StudyError(UserError):
    """A study folder cannot be made, opened or used; the text is one sentence for the user."""


STUDY_FORMAT = DocumentFormat("esp-study", 1, "a study", StudyError)


class Cell(Strict):
    """One run of a study, and where it stands in tables and pictures.

    Attributes:
        name: of its folder.
        panel: the picture that its curve is in, and one axis of the table.
        variant: its name in that picture, and the other axis.
        config: what is run.
        reference: name of the cell that it is compared with; None for such a cell itself.
        paper: place of the paper's number, see `paper.reported`; None where there is none that compares.
    """

    name: str
    panel: str
    variant: str
    config: RunConfig
    reference: str | None = None
    paper: tuple[str, ...] | None = None


class Study(Strict):
    """A named list of runs.

    Attributes:
        kind: what it reproduces, such as "table1" or "ablate-transforms"; "runs" for runs put together by hand.
        title: one line for people.
        command: the command that plans it again; one a line where several added to it.
        episodes: per seed, of the final evaluation of a trained policy.
        esp_version: of the program that planned it.
        cells: in the order in which they are run and shown.
    """

    kind: str
    title: str
    command: str
    episodes: int = Field(ge=1)
    esp_version: str = __version__
    rows: Literal["panels", "variants"] = Field(description="what the rows of the table are; the other are columns")
    cells: tuple[Cell, ...]

    @property
    def panels(self) -> list[str]:
        """The panels in order."""
        return list(dict.fromkeys(cell.panel for cell in self.cells))


def _completed(cell: Cell) -> Cell:
    """Return a stored cell with the settings that came later; one whose task is not at hand stays as it is."""
    with contextlib.suppress(ValueError):
        return cell.model_copy(update={"config": completed(cell.config)})
    return cell


class StudyFolder:
    """A folder that holds a study; use :meth:`create` or :meth:`open`.

    Attributes:
        path: the folder.
        study: all that was ever planned in it.
        document: name of the file that makes a folder one.
        runs: name of the folder of its run folders.
        noun: what messages call what it holds.
    """

    document: ClassVar[str] = STUDY
    runs: ClassVar[str] = "runs"
    noun: ClassVar[str] = "study"

    def __init__(self, path: Path, study: Study) -> None:
        names = [cell.name for cell in study.cells]
        for name in names:
            # A name is that of a folder inside the study: nothing is written outside it.
            if not _FOLDER_NAME.fullmatch(name) or names.count(name) > 1:
                raise StudyError(f"{path / STUDY} is damaged: {shortened(repr(name))} is not the name of one run")
        self.path, self.study = path, study

    @classmethod
    def is_one(cls, path: Path) -> bool:
        """Return whether a folder holds one."""
        return (path / cls.document).is_file()

    @classmethod
    def create(cls, path: Path, study: Study) -> StudyFolder:
        """Make a study folder, or go on with the one that is there; cells that it does not have yet are added.

        Raises:
            StudyError: as `planned`.
        """
        folder, differs = cls.planned(path, study)
        path.mkdir(parents=True, exist_ok=True)
        if differs:
            STUDY_FORMAT.write(path / STUDY, folder.study.model_dump(mode="json"))
        return folder

    @classmethod
    def planned(cls, path: Path, study: Study) -> tuple[StudyFolder, bool]:
        """Return what `create` makes of a study, and whether that differs from what is there; writes nothing.

        A cell that the folder has keeps its run, and may be compared with another one than before.

        Raises:
            StudyError: the folder holds another study, a run under other rules of its task, or something foreign.
        """
        # As JSON shows it, so that it equals what is read again: a tuple in a task's settings becomes a list.
        study = Study.model_validate_json(study.model_dump_json())
        cls.refuse_foreign(path)
        if not cls.is_one(path):
            return cls(path, study), True
        there = cls.open(path).study
        known = {cell.name: cell for cell in there.cells}
        again = [(cell, known[cell.name]) for cell in study.cells if cell.name in known]
        changed = [new.name for new, old in again if new != old.model_copy(update={"reference": new.reference})]
        if there.kind != study.kind or there.episodes != study.episodes or changed:
            which = f" ({changed[0]} has other seeds or settings)" if changed else ""
            raise StudyError(
                f"{path} holds another study{which}; go on with it by '{there.command.splitlines()[-1]}', or choose "
                "another --out"
            )
        for cell, _ in again:
            cls(path, there)._refuse_old_rules(cell)
        wanted = {cell.name for cell in study.cells}
        rest = tuple(cell for cell in there.cells if cell.name not in wanted)
        if not wanted - set(known) and all(new == old for new, old in again):
            return cls(path, there), False
        commands = [*there.command.splitlines(), study.command] if rest else [study.command]
        merged = {"cells": study.cells + rest, "command": "\n".join(dict.fromkeys(commands))}
        return cls(path, study.model_copy(update=merged)), True

    @classmethod
    def open(cls, path: Path) -> StudyFolder:
        """Open an existing study.

        Raises:
            StudyError: it is missing, damaged, foreign, or of a newer version.
        """
        if not path.is_dir():
            raise StudyError(f"{path} is no study: there is no such folder")
        study = STUDY_FORMAT.parse(path / STUDY, Study)
        if not study.cells:
            raise StudyError(f"{path / STUDY} is damaged: it names no run; plan the study again under another --out")
        return cls(path, study.model_copy(update={"cells": tuple(map(_completed, study.cells))}))

    def _refuse_old_rules(self, cell: Cell) -> None:
        """Refuse a finished run of an earlier version of its task, which other runs are not to stand beside."""
        final = read_evaluation(self.run_path(cell))
        if final is not None and final.task_version != (version := spec_of(cell.config).version):
            raise StudyError(
                f"{self.run_path(cell)} was evaluated on {final.task} version {final.task_version}, but this is "
                f"version {version}; choose another --out"
            )

    @classmethod
    def make(cls, path: Path) -> None:
        """Make the folder, empty, unless it is there.

        Raises:
            StudyError: as `refuse_foreign`.
        """
        cls.refuse_foreign(path)
        path.mkdir(parents=True, exist_ok=True)

    @classmethod
    def refuse_foreign(cls, path: Path) -> None:
        """Refuse a folder that is neither new nor empty nor one of these.

        Raises:
            StudyError: it holds something foreign, or a link where its runs belong.
        """
        if path.is_file():
            raise StudyError(f"{path} is a file; choose another --out")
        if (path / cls.runs).is_symlink():
            raise StudyError(f"{path / cls.runs} is a link, which is not followed; put the folder itself there")
        if not cls.is_one(path) and path.is_dir():
            names = (entry.name for entry in path.iterdir())
            foreign = [name for name in names if name != STUDY_LOCK and not name.startswith(TEMPORARY_PREFIX)]
            if foreign:
                raise StudyError(f"{path} is not empty and no {cls.noun} (it has {foreign[0]!r}); choose another --out")

    @classmethod
    @contextlib.contextmanager
    def held(cls, path: Path) -> Iterator[None]:
        """Hold the folder, made if missing, so that no second process plans or works in it.

        Half-written documents that a killed process left are removed, those of the fresh study of a tuning too.

        Raises:
            StudyError: it holds something foreign.
            LockError: another process holds it.
        """
        cls.make(path)
        descriptor = acquire(path / STUDY_LOCK)
        try:
            for folder in (path, path / FRESH):
                for file in folder.glob(f"{TEMPORARY_PREFIX}*"):
                    file.unlink(missing_ok=True)
            yield
        finally:
            release(descriptor)

    def run_path(self, cell: Cell) -> Path:
        """Return the run folder of a cell."""
        return self.path / self.runs / cell.name

    def log_path(self, cell: Cell) -> Path:
        """Return the file that the processes of a cell write to."""
        return self.run_path(cell) / LOG

    def evaluation_path(self, cell: Cell) -> Path:
        """Return the file that the final evaluation of a cell's trained policy is written to."""
        return self.run_path(cell) / FINAL

    def prepare(self, cell: Cell) -> RunFolder:
        """Make the run folder of a cell, or open the one that is there.

        Raises:
            UserError: what is there is damaged or another run.
        """
        path, wanted = self.run_path(cell), cell.config.model_dump(mode="json")
        if not (path / CONFIG).exists():
            return RunFolder.create(path, wanted)
        folder = RunFolder.open(path)
        if parse_config(folder.config, path) != cell.config:
            raise StudyError(f"{path} holds a run of another configuration; move it away, or choose another --out")
        return folder

    def find_twin(self, cell: Cell, others: Sequence[StudyFolder]) -> Path | None:
        """Return the folder of a finished run of the same configuration and number of episodes in other studies.

        None where there is none for this version of the task, or where the cell's own run has begun.
        """
        if self.run_path(cell).exists():
            return None
        alike = (
            other.run_path(theirs)
            for other in others
            if other.study.episodes == self.study.episodes
            for theirs in other.study.cells
            if theirs.config == cell.config and other.is_finished(theirs)
        )
        for path in alike:
            final = read_evaluation(path)
            if final is not None and final.task_version == spec_of(cell.config).version:
                return path
        return None

    def adopt(self, cell: Cell, twin: Path) -> None:
        """Take a finished run of the same configuration over as this cell's; its log says where it is from.

        Links in its folder are left out: they would bring in files from anywhere.
        """
        part = self.path / self.runs / f".{cell.name}.part"
        require_held(part)
        shutil.rmtree(part, ignore_errors=True)  # what a kill left
        shutil.copytree(twin, part, ignore=lambda folder, names: [n for n in names if Path(folder, n).is_symlink()])
        with os.fdopen(open_own(part / LOG, os.O_WRONLY | os.O_APPEND), "a", encoding="utf-8") as log:
            log.write(f"taken over from {twin}\n")
        part.rename(self.run_path(cell))

    def is_trained(self, cell: Cell) -> bool:
        """Return whether a cell's training is done; the policy file is the last that a run writes."""
        return (self.run_path(cell) / POLICY).is_file()

    def is_finished(self, cell: Cell) -> bool:
        """Return whether nothing is left to do for a cell."""
        return self.is_trained(cell) and read_evaluation(self.run_path(cell)) is not None


def read_evaluation(run: Path) -> FinalEvaluation | None:
    """Read the final evaluation of the trained policy in a run folder; None where there is none, or half of one."""
    for name in (FINAL, _OLD_FINAL):
        with contextlib.suppress(OSError, ValueError):
            text = read_regular(run / name, MAX_DOCUMENT_BYTES) or b""
            return validate(FinalEvaluation, parse_object(text, "text"))
    return None
