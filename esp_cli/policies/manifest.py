"""The manifest of the bundled policies: what each is, how well it does, and where the folder is; imports no torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from esp_cli.defaults import PriorKind
from esp_cli.files.documents import DocumentFormat, Strict
from esp_cli.files.formatting import file_name
from esp_envs.errors import UserError

MANIFEST_FORMAT = DocumentFormat("esp-checkpoints", 1, "a manifest of policies")
MANIFEST = "manifest.json"
_FOLDER = "checkpoints"
NAME_PATTERN = r"[a-z0-9]+(-[a-z0-9]+)*"


class Score(Strict):
    """How well the policy does greedily; mean, s.e.m. and interval are over episodes, as there is one seed."""

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
    metrics: dict[str, float]
    command: str = Field(description="that trains such a run")
    esp_version: str
    config: dict[str, Any]

    @property
    def is_standard(self) -> bool:
        """Whether it goes by the name that its task, algorithm and prior give, and not by one of its own."""
        return self.name == standard_name(self.task, self.algorithm, self.prior)


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
    """Return what the manifest lists; nothing where there is no manifest.

    Args:
        folder: of the manifest; by default that of this installation.

    Raises:
        UserError: the manifest is damaged or of a newer version.
    """
    file = (folder or bundled_folder()) / MANIFEST
    if not file.is_file():
        return ()
    entries = MANIFEST_FORMAT.parse(file, Manifest).policies
    if len({entry.name for entry in entries}) < len(entries):
        raise UserError(f"{file} is damaged: it names a policy twice")
    return entries


def write_bundled(folder: Path, entries: tuple[Entry, ...]) -> None:
    """Write a manifest, sorted by name."""
    listed = [entry.model_dump(mode="json") for entry in sorted(entries, key=lambda entry: entry.name)]
    MANIFEST_FORMAT.write(folder / MANIFEST, {"policies": listed})
