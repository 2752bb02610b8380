"""Spoilt files of every kind that is read: only the right content or one sentence, in bounded time and memory."""

import contextlib
import copy
import functools
import json
import random
import resource
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from typer.testing import CliRunner

from esp_cli.app import app
from esp_cli.checking import collect
from esp_cli.checking.recorded import read_transitions
from esp_cli.files.documents import DocumentFormat, parse_object
from esp_cli.policies.bundled import MANIFEST, MANIFEST_FORMAT, Manifest, bundled_folder
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.reporting.results import read_results
from esp_cli.studies.catalogue import plan
from esp_cli.studies.plan import STUDY_FORMAT
from esp_cli.studies.space import read_space
from esp_cli.studies.study import StudyFolder, read_evaluation
from esp_cli.symmetry.admission import admitted_elements
from esp_cli.training.checkpoint import load_checkpoint, save_checkpoint
from esp_cli.training.config import resolve_config
from esp_cli.training.folder_names import FINAL
from esp_cli.training.metrics import column, read_last_row, read_metrics
from esp_cli.training.run_folder import RUN_FORMAT, RunFolder
from esp_cli.training.settings import parse_config, read_config_file
from esp_cli.training.trainer import Trainer
from esp_envs.errors import UserError
from esp_envs.registry import make
from esp_envs.spec import TaskSpec
from tests.studies.small_studies import request
from tests.torture.junk import spoil_bytes, spoil_header, spoil_json, spoil_value
from tests.torture.limits import PROCESSOR_S, TooLongError, time_limit
from tests.torture.record import Part
from tests.training.runs import tiny_folder

BATCH = 100
LIMIT_BYTES = 10**9
COMMAND_SHARE = 1 / 2000
FORGED_SHARE = 1 / 100
"""Of policies and checkpoints whose checksum is right: for them networks are built, which takes milliseconds."""
RUN, STUDY = "run", "study"
ORDERS = {"task": "navigation", "prior": {"kind": "esp", "transforms": "d4*agents-1-0-2,landmarks-1-0-2"}}
SPACE = b"mappo.num_epochs = [5, 10]\n[mappo.learning_rate]\nlow = 1e-4\nhigh = 0.01\nlog = true\n"


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        path: of the sound file, below the scratch folder.
        load: reads the spoilt file as the application does; returns why what it got is wrong, or None.
        command: a command line that reads it.
        spoil: damage by structure.
    """

    path: str
    load: Callable[[Path], str | None]
    command: tuple[str, ...]
    spoil: Callable[[bytes, random.Random], bytes]


class Files(Part):
    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.seed = scratch / "files", seed
        _make_sound_files(self.scratch)
        self.sound = {name: (self.scratch / kind.path).read_bytes() for name, kind in KINDS.items()}
        self._originals = self._load_originals()
        self._most_bytes = _resident_bytes() + LIMIT_BYTES

    def run(self, number: int) -> str | None:
        """Try a batch of one kind; its numbers follow from the seed and the number of the batch."""
        rng = random.Random(f"{self.seed} {number}")
        name = list(KINDS)[number % len(KINDS)]
        path = self.scratch / KINDS[name].path
        try:
            for index in range(BATCH):
                found = self._try(name, path, rng)
                self.done += 1
                if found is not None:
                    keep = Path.cwd() / f"torture-{name}-{self.seed}-{number}-{index}"
                    shutil.copyfile(path, keep)
                    return f"{name} {index}: {found} (kept as {keep.name})"
        finally:
            path.write_bytes(self.sound[name])
        if _resident_bytes() > self._most_bytes:
            self._most_bytes = _resident_bytes() + LIMIT_BYTES
            return f"{name}: a file took more than {LIMIT_BYTES / 1e9} GB of memory"
        return None

    def _try(self, name: str, path: Path, rng: random.Random) -> str | None:
        kind, sound = KINDS[name], self.sound[name]
        forged = name in self._originals and rng.random() < FORGED_SHARE
        if forged:
            self._forge(name, path, rng)
        else:
            spoil = rng.choice((spoil_bytes, kind.spoil))
            path.write_bytes(spoil(sound, rng))
        wrong, command = None, kind.command if rng.random() < COMMAND_SHARE else None
        try:
            with time_limit():
                if command is not None:
                    return _run_command([part.format(scratch=self.scratch) for part in command])
                if name in self._originals and not forged:
                    wrong = _differs(load_checkpoint(path, _format(name)), self._originals[name])
                wrong = wrong or kind.load(path)
        except (ValueError, OSError) as failure:
            return _not_one_sentence(failure)
        except TooLongError:
            return f"takes longer than {PROCESSOR_S} s"
        except BaseException as failure:  # what is no sentence is a finding, MemoryError and the like too
            return f"{type(failure).__name__}: {failure}"
        return wrong

    def _load_originals(self) -> dict[str, Any]:
        return {
            name: load_checkpoint(self.scratch / KINDS[name].path, _format(name))
            for name in ("policy", "checkpoint", "crowd")
        }

    def _forge(self, name: str, path: Path, rng: random.Random) -> None:
        tensors, meta = self._originals[name]
        tensors, described = dict(tensors), dict(meta)
        if rng.random() < 0.5:
            spoilt = spoil_value(copy.deepcopy(described), rng)
            described = spoilt if isinstance(spoilt, dict) else {}
            described = {key: value for key, value in described.items() if key not in ("format", "version", "sha256")}
        else:
            chosen = rng.choice(list(tensors))
            tensor = tensors.pop(chosen)
            changes: list[Callable[[torch.Tensor], torch.Tensor]] = [
                lambda t: t.unsqueeze(0),
                lambda t: t.flatten()[:1].clone(),
                lambda t: t.to(torch.float64),
                lambda t: t.to(torch.bool),
                lambda t: torch.full_like(t, 7),
                lambda t: torch.cat([t.flatten(), t.flatten()]),
            ]
            if rng.random() < 0.8:
                tensors[rng.choice((chosen, chosen, chosen, "x", f"{chosen}.x"))] = rng.choice(changes)(tensor)
        with contextlib.suppress(ValueError):
            save_checkpoint(path, tensors, described, _format(name))


def _make_sound_files(scratch: Path) -> None:
    folder = tiny_folder(scratch / RUN, steps=100)
    with folder.lock():
        Trainer(parse_config(folder.config, folder.path), folder).run(lambda news: True)
    study = StudyFolder.create(
        scratch / STUDY, plan("table1", request(tasks=("navigation",), seeds=(0,), steps=((None, 100),)))
    )
    for cell in study.study.cells:
        run = study.prepare(cell)
        with run.lock():
            Trainer(cell.config, run).run(lambda news: True)
        _run_command(["eval", str(run.path), "--episodes", "4", "--json", str(study.run_path(cell) / FINAL)])
    recorded = collect(make("navigation", 64, [0]), 64, 2)
    arrays = {name: getattr(recorded, name).numpy() for name in ("obs", "action", "reward", "next_obs")}
    np.savez(scratch / "transitions.npz", **arrays)
    many = {"task.num_agents": 12, "task.sees": 3, "task.density": 8.0, "network.name": "set", "network.width": 8}
    crowd = tiny_folder(scratch / "crowd", steps=100, **{name.replace(".", "__"): x for name, x in many.items()})
    with crowd.lock():
        Trainer(parse_config(crowd.config, crowd.path), crowd).run(lambda news: True)
    _run_command(["report", str(study.path), "-o", str(scratch / "page")])
    (scratch / "orders.json").write_text(json.dumps(ORDERS))
    (scratch / "space.toml").write_bytes(SPACE)
    (scratch / "bundled").mkdir()
    manifest = json.loads((bundled_folder() / MANIFEST).read_text())
    manifest["policies"] = manifest["policies"][:2]  # the others are alike
    (scratch / KINDS["manifest"].path).write_text(json.dumps(manifest, indent=2))
    cells = study.study.cells
    (scratch / "evaluation").symlink_to((study.run_path(cells[0]) / FINAL).parent)


def _run_command(arguments: list[str]) -> str | None:
    """Run a command line in this process; return why it is not one sentence, or None."""
    result = CliRunner().invoke(app, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        return f"esp {' '.join(arguments)}: {type(result.exception).__name__}: {result.exception}"
    if result.exit_code not in (0, 2):
        return f"esp {' '.join(arguments)}: exit code {result.exit_code}: {result.stderr[-500:]}"
    last = result.stderr.splitlines()[-1] if result.stderr else ""
    if result.exit_code and not last.startswith("error: "):
        return f"esp {' '.join(arguments)}: {last!r} is not a sentence"
    return None


def _not_one_sentence(failure: Exception) -> str | None:
    text = str(failure)
    if not text or len(text) > 1000:  # the console joins lines
        return f"{type(failure).__name__} is not one sentence: {text[:300]!r}"
    if type(failure).__module__.split(".")[0] in ("pydantic_core", "torch", "safetensors", "json"):
        return f"{type(failure).__name__} of a library: {text[:300]!r}"
    return None


def _differs(found: tuple[dict[str, Any], Any], original: tuple[dict[str, Any], Any]) -> str | None:
    same = found[1] == original[1] and found[0].keys() == original[0].keys()
    same = same and all(_bits(found[0][name]) == _bits(original[0][name]) for name in found[0])
    return None if same else "another content was loaded"


def _bits(tensor: torch.Tensor) -> tuple[Any, ...]:
    return tensor.dtype, tensor.shape, tensor.numpy().tobytes()


def _agrees(text: Any, taken: Any) -> bool:
    """Return whether what was taken says what the file says, wherever it says something."""
    if isinstance(text, dict) and isinstance(taken, dict):
        return all(_agrees(value, taken[key]) for key, value in text.items() if key in taken)
    if isinstance(text, list) and isinstance(taken, list):
        return len(text) == len(taken) and all(map(_agrees, text, taken))
    if isinstance(taken, float) and isinstance(text, int) and not isinstance(text, bool):
        text = float(text)  # an integer of many digits stands for the number that is nearest to it
    return isinstance(text, bool) == isinstance(taken, bool) and text == taken


def _document(kind: DocumentFormat, path: Path, taken: Any) -> str | None:
    return None if _agrees(kind.read(path), taken) else "something else was taken than the file says"


def _policy(path: Path) -> None:
    TrainedPolicy.read(path)


def _checkpoint(path: Path) -> None:
    load_checkpoint(path)
    folder = RunFolder.open(path.parents[1])
    Trainer(parse_config(folder.config, folder.path), folder)


def _config(path: Path) -> str | None:
    config = parse_config(RunFolder.open(path.parent).config, path.parent)
    return _document(RUN_FORMAT, path, config.model_dump(mode="json"))


def _metrics(path: Path) -> None:
    read_last_row(path)
    with contextlib.suppress(UserError):
        column(read_metrics(path), "eval/return_greedy")


def _study(path: Path) -> str | None:
    folder = StudyFolder.open(path.parent)
    return _document(STUDY_FORMAT, path, folder.study.model_dump(mode="json"))


def _evaluation(path: Path) -> str | None:
    found = read_evaluation(path.parent)
    if found is None:
        return None
    taken = found.model_dump(mode="json")
    return None if _agrees(parse_object(path.read_bytes(), "text"), taken) else "something else was taken"


def _manifest(path: Path) -> str | None:
    return _document(MANIFEST_FORMAT, path, MANIFEST_FORMAT.parse(path, Manifest).model_dump(mode="json"))


@functools.cache
def _spec() -> TaskSpec:
    return make("navigation", 1, [0]).spec


def _transitions(path: Path) -> None:
    read_transitions(path, _spec())


def _orders(path: Path) -> None:
    config = resolve_config("navigation", overrides=read_config_file(path).settings)
    admitted_elements(config.prior.transforms, _spec())


def _space(path: Path) -> None:
    read_space(path)


def _results(path: Path) -> None:
    read_results(path)


def _format(name: str) -> str:
    return "esp-checkpoint" if name == "checkpoint" else "esp-policy"


_FINAL = "checkpoints/step-000000000100-final.safetensors"
_ALL = (
    (f"{RUN}/policy.safetensors", _policy, "eval {scratch}/run/policy.safetensors -e 2", spoil_header),
    (f"{RUN}/{_FINAL}", _checkpoint, "train --resume {scratch}/run", spoil_header),
    (f"{RUN}/config.json", _config, "render {scratch}/run -o {scratch}/x.png", spoil_json),
    (f"{RUN}/metrics.jsonl", _metrics, "report {scratch}/run", spoil_json),
    (f"{STUDY}/study.json", _study, "report {scratch}/study --json -", spoil_json),
    ("evaluation/final-evaluation.json", _evaluation, "report {scratch}/study", spoil_json),
    (f"bundled/{MANIFEST}", _manifest, "policies", spoil_json),
    ("transitions.npz", _transitions, "discover {scratch}/transitions.npz --task navigation", spoil_bytes),
    ("crowd/policy.safetensors", _policy, "eval {scratch}/crowd -e 2", spoil_header),
    ("orders.json", _orders, "train --config {scratch}/orders.json --print-config", spoil_json),
    ("space.toml", _space, "tune --space {scratch}/space.toml --out {scratch}/never --budget 1 --dry-run", spoil_bytes),
    ("page/results.json", _results, "report {scratch}/study -o {scratch}/page", spoil_json),
)
_NAMES = (
    "policy",
    "checkpoint",
    "config",
    "metrics",
    "study",
    "evaluation",
    "manifest",
    "transitions",
    "crowd",
    "orders",
    "space",
    "results",
)
KINDS = {
    name: Kind(path, load, tuple(command.split()), spoil)
    for name, (path, load, command, spoil) in zip(_NAMES, _ALL, strict=True)
}


def _resident_bytes() -> int:
    """Return the most memory that this process ever held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
