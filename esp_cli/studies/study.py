"""A study: a named list of runs in one folder, each of which is compared with another one and with the paper.

Layout::

    study.json          what is to be run, and the command that said so
    runs/NAME/          one run folder per cell, see esp_cli.training.run_folder
    runs/NAME/final-evaluation.json   the trained policies beside the reference policies, on episodes of their own
    runs/NAME/log.txt   what the processes that trained and evaluated it said
    study.lock          held by the process that works on the study
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, ValidationError

from esp_cli.defaults import __version__
from esp_cli.files.documents import MAX_DOCUMENT_BYTES, DocumentError, DocumentFormat, Strict, parse_object, validate
from esp_cli.files.formatting import shortened
from esp_cli.files.opening import open_own, read_regular
from esp_cli.policies.evaluation import FinalEvaluation
from esp_cli.studies.run_set import FOLDER_NAME, Cell, RunSet
from esp_cli.training.config import RunConfig, completed
from esp_cli.training.folder_names import FINAL, LOG, STUDY
from esp_envs.errors import UserError
from esp_envs.registry import make

STUDY_FORMAT = DocumentFormat("esp-study", 1, "a study")


class Study(Strict):
    """A named list of runs."""

    kind: str  # what it reproduces, such as "table1" or "ablate-transforms"; "runs" for runs put together by hand
    title: str  # one line for people
    command: str  # the command that plans it again; one a line where several added to it
    episodes: int = Field(ge=1)  # per seed, of the final evaluation of a trained policy
    esp_version: str = __version__  # of the program that planned it
    rows: Literal["panels", "variants"] = Field(description="what the rows of the table are; the other are columns")
    cells: tuple[Cell, ...]  # in the order in which they are run and shown
    left_out: dict[str, str] = Field({})  # by "TASK: METHOD" why there is no such cell

    @property
    def panels(self) -> list[str]:
        return list(dict.fromkeys(cell.panel for cell in self.cells))


def _completed(cell: Cell) -> Cell:
    """Return a stored cell with the settings that came later; one whose task is not at hand stays as it is."""
    with contextlib.suppress(UserError):
        return cell.model_copy(update={"config": completed(cell.config)})
    return cell


class StudyFolder(RunSet):
    """A folder that holds a study, all that was ever planned in it.

    Example:
        >>> folder = StudyFolder.open(Path("runs/table1"))  # doctest: +SKIP
        >>> [cell.name for cell in folder.study.cells if not folder.is_finished(cell)]  # doctest: +SKIP
    """

    document, runs, noun = STUDY, "runs", "study"

    def __init__(self, path: Path, study: Study) -> None:
        names = [cell.name for cell in study.cells]
        for name in names:
            if not FOLDER_NAME.fullmatch(name) or names.count(name) > 1:
                raise UserError(f"{path / STUDY} is damaged: {shortened(repr(name))} is not the name of one run")
        super().__init__(path, study.title)
        self.study = study

    @classmethod
    def create(cls, path: Path, study: Study, keep: bool = True) -> Self:
        """Make a study folder, or go on with the one that is there; cells that it does not have yet are added.

        Cells that are there and not in the study stay, unless `keep` is False; their runs stay on the disk.
        """
        folder, differs = cls.planned(path, study, keep)
        path.mkdir(parents=True, exist_ok=True)
        if differs:
            STUDY_FORMAT.write(path / STUDY, folder.study.model_dump(mode="json"))
        return folder

    @classmethod
    def planned(cls, path: Path, study: Study, keep: bool = True) -> tuple[Self, bool]:
        """Return what `create` makes of a study, and whether that differs from what is there; writes nothing."""
        # As JSON shows it, so that it equals what is read again: a tuple in a task's settings becomes a list.
        study = Study.model_validate_json(study.model_dump_json())
        cls.refuse_foreign(path)
        if not cls.is_one(path):
            return cls(path, study), True
        there = cls.open(path).study
        known = {cell.name: cell for cell in there.cells}
        again = [(cell, known[cell.name]) for cell in study.cells if cell.name in known]
        told = {"reference", "paper"}  # what runs are compared with
        changed = [new.name for new, old in again if new != old.model_copy(update=new.model_dump(include=told))]
        if there.kind != study.kind or there.episodes != study.episodes or changed:
            which = f" ({changed[0]} has other seeds or settings)" if changed else ""
            raise UserError(
                f"{path} holds another study{which}; go on with it by '{there.command.splitlines()[-1]}', or choose "
                "another --out"
            )
        for cell, _ in again:
            cls(path, there)._refuse_old_rules(cell)
        wanted = {cell.name for cell in study.cells}
        # a panel of variants has one reference, else its table and its answer compare with two
        alike = study.cells if study.rows == "variants" else ()
        firsts = {cell.panel: cell.name for cell in reversed(alike) if cell.reference is None}
        rest = tuple(
            cell.model_copy(update={"reference": firsts.get(cell.panel, cell.reference)})
            for cell in there.cells
            if keep and cell.name not in wanted
        )
        if {cell.name: cell for cell in (*study.cells, *rest)} == known:
            return cls(path, there), False
        commands = [*there.command.splitlines(), study.command] if rest else [study.command]
        merged: dict[str, object] = {"cells": study.cells + rest, "command": "\n".join(dict.fromkeys(commands))}
        merged |= {"left_out": there.left_out | study.left_out}
        return cls(path, study.model_copy(update=merged)), True

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open an existing study, unless it is missing, damaged, foreign, or of a newer version."""
        if not path.is_dir():
            raise UserError(f"{path} is no study: there is no such folder")
        study = STUDY_FORMAT.parse(path / STUDY, Study)
        if not study.cells:
            raise UserError(f"{path / STUDY} is damaged: it names no run; plan the study again under another --out")
        return cls(path, study.model_copy(update={"cells": tuple(map(_completed, study.cells))}))

    def _refuse_old_rules(self, cell: Cell) -> None:
        """Refuse a finished run of an earlier version of its task, which other runs are not to stand beside."""
        final = read_evaluation(self.run_path(cell))
        if final is not None and final.task_version != (version := _task_version(cell.config)):
            raise UserError(
                f"{self.run_path(cell)} was evaluated on {final.task} version {final.task_version}, but this is "
                f"version {version}; choose another --out"
            )

    def evaluation_path(self, cell: Cell) -> Path:
        """Return the file that the final evaluation of a cell's trained policy is written to."""
        return self.run_path(cell) / FINAL

    def is_finished(self, cell: Cell) -> bool:
        return self.is_trained(cell) and read_evaluation(self.run_path(cell)) is not None

    def begin(self, cell: Cell) -> Cell:
        self.prepare(cell)
        return cell

    def goes_on(self, cell: Cell) -> bool:
        return not self.is_finished(cell)

    def end(self, cell: Cell) -> None:
        """Leave a finished cell as it is: training has removed what nothing goes on from."""

    def next_command(self, cell: Cell) -> list[str]:
        """Return the arguments that train a cell, or that evaluate it once it is trained."""
        if not self.is_trained(cell):
            return super().next_command(cell)
        final = self.evaluation_path(cell)
        final.unlink(missing_ok=True)  # a damaged one is made again, and a link there is not followed
        words = ["eval", str(self.run_path(cell)), "--episodes", str(self.study.episodes), "--json", str(final)]
        return words + cell.config.own_words()

    def cells_of(self, study: Study) -> list[Cell]:
        """Return the cells here that a study names, with the settings and references that they have here."""
        names = {cell.name for cell in study.cells}
        return [cell for cell in self.study.cells if cell.name in names]

    def unlike(self, cells: Sequence[Cell]) -> list[Cell]:
        """Return the cells to run: of those that train the same, the first, and any that has begun."""
        return [
            cell
            for k, cell in enumerate(cells)
            if self.run_path(cell).exists() or all(cell.config != earlier.config for earlier in cells[:k])
        ]

    def adopt_finished(self, cells: Sequence[Cell], others: Sequence[StudyFolder]) -> list[tuple[Cell, Path]]:
        """Take finished runs of the same configuration over; return the cells that have one now, and where from."""
        twins = [(cell, twin) for cell in cells if (twin := self.find_twin(cell, others)) is not None]
        for cell, twin in twins:
            self.adopt(cell, twin)
        return twins

    def find_twin(self, cell: Cell, others: Sequence[StudyFolder]) -> Path | None:
        """Return the folder of a finished run of the same configuration and number of episodes in other studies."""
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
            if final is not None and final.task_version == _task_version(cell.config):
                return path
        return None

    def adopt(self, cell: Cell, twin: Path) -> None:
        """Take a finished run over as this cell's, without links, which bring in files from anywhere; its log tells."""
        part = self.path / self.runs / f".{cell.name}.part"
        shutil.rmtree(part, ignore_errors=True)  # what a kill left
        shutil.copytree(twin, part, ignore=lambda folder, names: [n for n in names if Path(folder, n).is_symlink()])
        with os.fdopen(open_own(part / LOG, os.O_WRONLY | os.O_APPEND), "a", encoding="utf-8") as log:
            log.write(f"taken over from {twin}\n")
        part.rename(self.run_path(cell))


def read_evaluation(run: Path) -> FinalEvaluation | None:
    """Read the final evaluation of the trained policy in a run folder; None where there is none, or half of one."""
    with contextlib.suppress(OSError, DocumentError, ValidationError):
        text = read_regular(run / FINAL, MAX_DOCUMENT_BYTES) or b""
        return validate(FinalEvaluation, parse_object(text, "text"))
    return None


def _task_version(config: RunConfig) -> int:
    return make(config.task, 1, (0,), config.task_settings).spec.version
