"""The trained policies that come with the application: files in `checkpoints/`, listed in a manifest; imports no torch.

The folder is beside the packages in a checkout, and inside `esp_cli` in an installed wheel. A policy is found by its
name (`formation-mappo-esp`) or by its task, and then by algorithm and prior.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from pydantic import Field

from esp_cli.defaults import PriorKind
from esp_cli.files.documents import DocumentFormat, Strict
from esp_cli.files.formatting import file_name
from esp_envs.errors import UserError

MANIFEST_FORMAT = DocumentFormat("esp-checkpoints", 1, "a manifest of policies")
MANIFEST = "manifest.json"
NAME_PATTERN = r"[a-z0-9]+(-[a-z0-9]+)*"
_FOLDER = "checkpoints"


class Score(Strict):
    """Greedy return of the policy; mean, s.e.m. and interval are over episodes, as there is one seed."""

    mean: float
    sem: float
    ci95: tuple[float, float]
    episodes: int = Field(ge=2)


class Entry(Strict):
    """One bundled policy, as the manifest describes it."""

    name: str = Field(pattern=f"^{NAME_PATTERN}$", max_length=100)
    file: str = Field(pattern=rf"^{NAME_PATTERN}\.safetensors$", max_length=120)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    task: str
    task_version: int
    convention: str
    algorithm: str
    prior: PriorKind
    seed: int
    chosen_from: int = Field(ge=1, description="seeds of the run, of which this one did best")
    step: int = Field(ge=0, description="environment steps behind it")
    score: Score
    normalised: float | None = Field(None, description="the score, 0 the random policy, 1 the best hand-written one")
    metrics: dict[str, float]
    command: str = Field(description="that trains such a run")
    esp_version: str
    config: dict[str, Any]

    @property
    def rank(self) -> tuple[bool, bool, str, int]:
        """Smallest for the policy that a task's name stands for: a standard name, MAPPO, with the prior."""
        own_name = self.name != standard_name(self.task, self.algorithm, self.prior)
        return own_name, self.algorithm != "mappo", self.algorithm, get_args(PriorKind).index(self.prior)


class Manifest(Strict):
    """What a manifest lists."""

    policies: tuple[Entry, ...]


def standard_name(task: str, algorithm: str, prior: str) -> str:
    """Return the default name of a bundled policy."""
    name = f"{task}-{algorithm}-{'plain' if prior == 'none' else prior}"
    return file_name(name.replace(".", " "))


def bundled_folder() -> Path:
    """Return the folder of the bundled policies: beside the packages in a checkout, else inside `esp_cli`."""
    package = Path(__file__).parents[1]
    inside = package / _FOLDER
    return inside if inside.is_dir() else package.parent / _FOLDER


def read_bundled(folder: Path | None = None) -> tuple[Entry, ...]:
    """Return what the manifest in a folder lists, by default that of this installation; nothing where there is none."""
    file = (folder or bundled_folder()) / MANIFEST
    if not file.is_file():
        return ()
    entries = MANIFEST_FORMAT.parse(file, Manifest).policies
    if len({entry.name for entry in entries}) < len(entries):
        raise UserError(f"{file} is damaged: it names a policy twice")
    return entries


def find(name: str, algo: str | None = None, prior: str | None = None) -> Entry:
    """Find a bundled policy by its name, or by its task, algorithm and kind of prior ("none": the plain learner).

    Of a task's policies MAPPO's and those with the prior come first. Where none fits, a UserError says what there is.
    """
    entries = read_bundled()
    named = [e for e in entries if e.name == name] or [e for e in entries if e.task == name]
    fitting = [e for e in named if algo in (None, e.algorithm) and prior in (None, e.prior)]
    if fitting:
        return min(fitting, key=lambda entry: entry.rank)
    wanted = " ".join([name, *([f"--algo {algo}"] if algo else []), *([f"--prior {prior}"] if prior else [])])
    names = ", ".join(e.name for e in named or entries)
    known = f"the bundled policies are {names}" if names else "no policy is bundled"
    raise UserError(f"no policy fits {wanted}; {known}; train one with esp train, and name its run folder")
