"""The trained policies that come with the application: files in `checkpoints/`, listed in a manifest.

The folder is beside the packages in a checkout, and inside `esp_cli` in an installed wheel. A policy is found by its
name (`formation-mappo-esp`) or by its task, and then by algorithm and prior.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.defaults import PriorKind
from esp_cli.files.documents import shortened
from esp_cli.files.suggesting import did_you_mean
from esp_cli.policies import manifest
from esp_cli.policies.loading import TrainedPolicy, load_policy
from esp_cli.policies.manifest import Entry, read_bundled
from esp_envs.errors import UserError
from esp_envs.registry import task_names


def find(name: str, algo: str | None = None, prior: str | None = None) -> Entry:
    """Find a bundled policy.

    Args:
        name: its own, or that of a task; of a task's policies MAPPO's and those with the prior come first.
        algo: only those that this algorithm trained.
        prior: only those that this kind of prior helped to train ("none": the plain learner).

    Raises:
        UserError: there is none.
    """
    entries = read_bundled()
    named = [e for e in entries if e.name == name]
    asked = named or [e for e in entries if e.task == name]
    found = [e for e in asked if algo in (None, e.algorithm) and prior in (None, e.prior)]
    if found:
        return min(found, key=_rank)
    wanted = " ".join([name, *(f"--algo {algo}" for _ in [0] if algo), *(f"--prior {prior}" for _ in [0] if prior)])
    names = ", ".join(e.name for e in asked or entries)
    there = f"the bundled policies are {names}" if names else "no policy is bundled"
    raise UserError(f"no policy fits {wanted}; {there}; train one with esp train, and name its run folder")


def _rank(entry: Entry) -> tuple[bool, int, int]:
    algorithms = list(ALGORITHMS)
    algorithm = algorithms.index(entry.algorithm) if entry.algorithm in algorithms else len(algorithms)
    return not entry.is_standard, algorithm, get_args(PriorKind).index(entry.prior)


def open_policy(where: Path, algo: str | None = None, prior: str | None = None) -> TrainedPolicy:
    """Open a run folder, a policy file, or a bundled policy by its name or its task's.

    An existing path goes before a bundled policy of that name, unless algorithm or prior is given.

    Args:
        where: path or name.
        algo: of the bundled policies, only those that this algorithm trained; module:Class chooses none.
        prior: likewise this kind of prior.

    Raises:
        UserError: nothing there, damaged, or of another version.
    """
    if algo is not None and ":" in algo:  # an algorithm of the caller, which trained no bundled policy
        algo = None
    choosy = algo is not None or prior is not None
    try:
        there = where.exists()
    except OSError as error:  # a name that no file can have
        raise UserError(f"there is no policy {shortened(str(where))}: {error.strerror}") from None
    if there and not choosy:
        return load_policy(where)
    if str(where) in task_names() or any(entry.name == str(where) for entry in read_bundled()):
        entry = find(str(where), algo, prior)
        trained = load_entry(entry)
        if entry.name == str(where):
            return trained
        return replace(trained, notes=(*trained.notes, f"{where}: taking the bundled policy {entry.name}"))
    if choosy:
        raise UserError(f"--algo and --prior choose among a task's policies, but {where} is not a task; leave them out")
    if not there:
        known = [*task_names(), *(entry.name for entry in read_bundled())]
        hint = did_you_mean(str(where), known) or "; give a run folder, a policy file, or a task's or policy's name"
        raise UserError(f"{where} does not exist{hint}")
    return load_policy(where)


def load_entry(entry: Entry) -> TrainedPolicy:
    """Load a bundled policy.

    Raises:
        UserError: its file is missing, another than the manifest names, or of another version.
    """
    trained = load_policy(manifest.bundled_folder() / entry.file, entry.sha256)
    described = (trained.config.task, trained.config.algorithm, trained.config.prior.kind, trained.config.seeds)
    if described != (entry.task, entry.algorithm, entry.prior, (entry.seed,)):
        raise UserError(f"{trained.source} does not hold the policy that its manifest describes; get both again")
    return trained
