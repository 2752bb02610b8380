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
import itertools
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

from esp_cli.files.documents import MAX_DOCUMENT_BYTES, parse_object, validate
from esp_cli.files.formatting import shortened
from esp_cli.files.opening import holding, is_held, open_own, read_regular
from esp_cli.files.writing import TEMPORARY_PREFIX
from esp_cli.policies.evaluation import FinalEvaluation
from esp_cli.studies.plan import STUDY_FORMAT, Cell, Study
from esp_cli.training.config import RunConfig, is_same, known_settings
from esp_cli.training.folder_names import CONFIG, FINAL, FRESH, LOCK, LOG, METRICS, POLICY, RUNS, STUDY, STUDY_LOCK
from esp_cli.training.metrics import RETURN, elapsed_s, read_last_row
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_envs.errors import UserError
from esp_envs.registry import make

FOLDER_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}")  # so that nothing is written outside of the study


class StudyFolder:
    """A folder that holds a study, all that was ever planned in it, and that one process at a time works on.

    What is done and what is not is read off the folder alone, so a process may be killed at any moment, and the next
    one goes on with what is there.

    Example:
        >>> folder = StudyFolder.open(Path("runs/table1"))  # doctest: +SKIP
        >>> [cell.name for cell in folder.study.cells if not folder.is_finished(cell)]  # doctest: +SKIP
    """

    def __init__(self, path: Path, study: Study) -> None:
        names = [cell.name for cell in study.cells]
        for name in names:
            if not FOLDER_NAME.fullmatch(name) or names.count(name) > 1:
                raise UserError(f"{path / STUDY} is damaged: {shortened(repr(name))} is not the name of one run")
        self.path, self.study = path, study
        self.check = True  # whether runs take a short look at a task that is not built in

    @classmethod
    def is_one(cls, path: Path) -> bool:
        return (path / STUDY).is_file()

    @classmethod
    def refuse_foreign(cls, path: Path) -> None:
        """Refuse a folder that is neither new nor empty nor a study, or that has a link where its runs belong."""
        if path.is_file():
            raise UserError(f"{path} is a file; choose another --out")
        if (path / RUNS).is_symlink():
            raise UserError(f"{path / RUNS} is a link, which is not followed; put the folder itself there")
        if not cls.is_one(path) and path.is_dir():
            names = (entry.name for entry in path.iterdir())
            foreign = [name for name in names if name != STUDY_LOCK and not name.startswith(TEMPORARY_PREFIX)]
            if foreign:
                raise UserError(f"{path} is not empty and no study (it has {foreign[0]!r}); choose another --out")

    @classmethod
    @contextlib.contextmanager
    def held(cls, path: Path) -> Iterator[None]:
        """Hold the folder, made if missing, so that no second process plans or works in it.

        Half-written documents that a killed process left are removed, those of the study that judges a search too.
        """
        cls.refuse_foreign(path)
        path.mkdir(parents=True, exist_ok=True)
        with holding(path / STUDY_LOCK):
            for folder in (path, path / FRESH):
                for file in folder.glob(f"{TEMPORARY_PREFIX}*"):
                    file.unlink(missing_ok=True)
            yield

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
        cls.refuse_foreign(path)
        if not cls.is_one(path):
            return cls(path, study), True
        there = cls.open(path).study
        known = {cell.name: cell for cell in there.cells}
        again = [(cell, known[cell.name]) for cell in study.cells if cell.name in known]
        told = {"reference", "paper", "given"}  # what runs are compared with, and whether they may be
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
        for new, old in itertools.product(study.cells, rest):
            if (new.panel, new.config.algorithm) == (old.panel, old.config.algorithm):
                cls._refuse_unlike(path, new, old)
        cells = study.cells + rest
        found = {f"{cell.panel.partition(', ')[0]}: {cell.variant}" for cell in cells}
        earlier = {name: why for name, why in there.left_out.items() if keep and name not in found}
        left_out = earlier | study.left_out
        if {cell.name: cell for cell in cells} == known and left_out == there.left_out:
            return cls(path, there), False
        commands = [*there.command.splitlines(), study.command] if rest else [study.command]
        command = "\n".join(dict.fromkeys(commands))
        merged: dict[str, object] = {"cells": cells, "command": command, "left_out": left_out}
        return cls(path, study.model_copy(update=merged)), True

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open an existing study, unless it is missing, damaged, foreign, or of a newer version."""
        if not path.is_dir():
            raise UserError(f"{path} is no study: there is no such folder")
        study = STUDY_FORMAT.parse(path / STUDY, Study)
        if not study.cells:
            raise UserError(f"{path / STUDY} is damaged: it names no run; plan the study again under another --out")
        cells = tuple(cell.model_copy(update={"config": known_settings(cell.config)}) for cell in study.cells)
        return cls(path, study.model_copy(update={"cells": cells}))

    @staticmethod
    def _refuse_unlike(path: Path, new: Cell, old: Cell) -> None:
        """Refuse a run beside one for which the user gave other settings, since a table compares the two."""
        if new.given is None or old.given is None:
            return
        ours, theirs = ({"preset": cell.config.preset, **cell.config.by_name()} for cell in (new, old))
        for name in ("preset", *sorted({*new.given, *old.given})):
            if ours.get(name) != theirs.get(name) and not any(name in c.config.without_effect() for c in (new, old)):
                raise UserError(
                    f"{old.name} in {path} has {name} {theirs.get(name)}, and a table would compare it with "
                    f"{new.name}, which has {ours.get(name)}; give both the same, or choose another --out"
                )

    def _refuse_old_rules(self, cell: Cell) -> None:
        """Refuse a finished run of an earlier version of its task, which other runs are not to stand beside."""
        version = self._version(cell) if self.is_finished(cell) else None
        if version is not None and version != (present := _task_version(cell.config)):
            raise UserError(
                f"{self.run_path(cell)} holds a run of {cell.config.task} version {version}, but this is version "
                f"{present}; choose another --out"
            )

    def _version(self, cell: Cell) -> int | None:
        """Return the version of its task under which a cell ended; None where no good file states it."""
        final = self.evaluation(cell)
        return RunFolder.open(self.run_path(cell)).task_version() if final is None else final.task_version

    def run_path(self, cell: Cell) -> Path:
        return self.path / RUNS / cell.name

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

    def has_stopped(self, cell: Cell) -> bool:
        """Return whether a cell's training ended without a policy, since every seed stopped."""
        last = read_last_row(self.run_path(cell) / METRICS).get(RETURN)
        return isinstance(last, list) and all(value is None for value in last)

    def is_own(self, cell: Cell) -> bool:
        """Return whether the run folder of a cell holds its run, and no other or a damaged one."""
        with contextlib.suppress(UserError):
            return is_same(cell.config, RunFolder.open(self.run_path(cell)).config)
        return False

    def evaluation(self, cell: Cell) -> FinalEvaluation | None:
        """Read the final evaluation of a cell's policy; None where there is none, or one of anything else."""
        final = read_evaluation(self.run_path(cell))
        fits = final is not None and final.is_of(cell.config, self.study.episodes) and self.is_own(cell)
        return final if fits else None

    def is_finished(self, cell: Cell) -> bool:
        """Return whether a cell has ended: its policy is evaluated, or every seed stopped."""
        if self.is_trained(cell):
            return self.evaluation(cell) is not None
        return self.has_stopped(cell) and self.is_own(cell)

    def next_command(self, cell: Cell) -> list[str]:
        """Return the arguments that train a cell, or that evaluate it once it is trained."""
        if not self.is_trained(cell):
            unseen = [] if self.check else ["--no-check"]
            return ["train", "--resume", str(self.run_path(cell)), *unseen, *cell.config.own_words()]
        final = self.run_path(cell) / FINAL
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
            (other.run_path(theirs), other._version(theirs))
            for other in others
            if other.study.episodes == self.study.episodes
            for theirs in other.study.cells
            if theirs.config == cell.config and other.is_finished(theirs)
        )
        return next((path for path, version in alike if version in (None, _task_version(cell.config))), None)

    def adopt(self, cell: Cell, twin: Path) -> None:
        """Take a finished run over as this cell's, without links, which bring in files from anywhere; its log tells."""
        part = self.path / RUNS / f".{cell.name}.part"
        shutil.rmtree(part, ignore_errors=True)  # what a kill left
        try:
            shutil.copytree(twin, part, ignore=lambda folder, names: [n for n in names if Path(folder, n).is_symlink()])
        except shutil.Error as error:  # of several files; the first tells, as where the disk is full
            shutil.rmtree(part, ignore_errors=True)
            raise UserError(f"{twin} cannot be copied to {self.run_path(cell)}: {error.args[0][0][2]}") from None
        with os.fdopen(open_own(part / LOG, os.O_WRONLY | os.O_APPEND), "a", encoding="utf-8") as log:
            log.write(f"taken over from {twin}\n")
        part.rename(self.run_path(cell))


def read_evaluation(run: Path) -> FinalEvaluation | None:
    """Read the final evaluation of the trained policy in a run folder; None where there is none, or half of one."""
    with contextlib.suppress(OSError, UserError):
        text = read_regular(run / FINAL, MAX_DOCUMENT_BYTES) or b""
        return validate(FinalEvaluation, parse_object(text, "text"))
    return None


def _task_version(config: RunConfig) -> int:
    return make(config.task, 1, (0,), config.task_settings).spec.version
