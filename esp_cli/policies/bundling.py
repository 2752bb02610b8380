"""Adding a trained policy to the bundled ones: the best seed of a run, evaluated on worlds that did not select it."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import torch

from esp_cli.defaults import __version__
from esp_cli.files.opening import taking_turns
from esp_cli.policies.bundled import NAME_PATTERN, Entry, Score, read_bundled, standard_name, write_bundled
from esp_cli.policies.evaluation import evaluate, play_batches
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.policies.statistics import EpisodeSpread, normalised
from esp_cli.training.build import PolicyController
from esp_cli.training.checkpoint import describe_policy, write_policy
from esp_cli.training.folder_names import CONFIG
from esp_envs.errors import UserError


def best_seed(trained: TrainedPolicy, episodes: int) -> int:
    """Return the seed with the largest mean greedy return over episodes that no evaluation uses."""
    if len(trained.config.seeds) == 1:
        return trained.config.seeds[0]
    returns = play_batches(trained.config, PolicyController(trained.policy), "selection", episodes).returns.mean(1)
    if len(trained.stopped) < len(returns):
        returns[list(trained.stopped)] = -torch.inf
    return trained.config.seeds[int(returns.argmax())]


def bundle(
    trained: TrainedPolicy,
    folder: Path,
    episodes: int,
    seed: int | None = None,
    name: str | None = None,
    force: bool = False,
) -> Entry:
    """Write one seed's policy, by default the best, list it in the folder's manifest, and return its entry."""
    config = trained.config
    name = standard_name(config.task, config.algorithm, config.prior.kind) if name is None else name
    if not re.fullmatch(NAME_PATTERN, name) or len(name) > 100:
        raise UserError(f"'{name}' is not a valid policy name; write words of a-z and 0-9 with - between them")
    _others(folder, name, force)  # before the episodes are played; they take minutes
    own = trained.single_seed(best_seed(trained, episodes) if seed is None else seed)
    found = evaluate(own, episodes)
    spread = found.over_episodes.get("greedy", EpisodeSpread(None, None))
    if found.greedy.mean is None or spread.sem is None or spread.ci95 is None:
        raise UserError(
            "these episodes all brought the same return, or this seed stopped; take more of them, or another"
        )
    score = Score(mean=found.greedy.mean, sem=spread.sem, ci95=spread.ci95, episodes=episodes)
    scaled = normalised(score.mean, found.anchors)
    folder.mkdir(parents=True, exist_ok=True)
    with taking_turns(folder):
        others = _others(folder, name, force)  # again: another export may have added its policy meanwhile
        file = folder / f"{name}.safetensors"
        write_policy(file, own.policy.state_dict(), describe_policy(own.config, own.spec, own.step, [score.mean]))
        entry = Entry(
            name=name,
            file=file.name,
            sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
            task=config.task,
            task_version=own.spec.version,
            convention=own.spec.convention,
            algorithm=config.algorithm,
            prior=config.prior.kind,
            seed=own.config.seeds[0],
            chosen_from=len(config.seeds),
            step=own.step,
            score=score,
            normalised=None if scaled is None else float(scaled),
            metrics={name: value for name, value in found.metrics.items() if value is not None},
            command=config.command(),
            esp_version=__version__,
            config=config.model_dump(mode="json"),
        )
        write_bundled(folder, (*others, entry))
    return entry


def _others(folder: Path, name: str, force: bool) -> tuple[Entry, ...]:
    """Return what a folder lists besides the policy of a name; refuse the folder of a run, or a name that is taken."""
    if os.path.lexists(folder / CONFIG):
        raise UserError(f"{folder} is the folder of a run, whose own policies have such names; choose another --out")
    entries = read_bundled(folder)
    if not force and (any(entry.name == name for entry in entries) or os.path.lexists(folder / f"{name}.safetensors")):
        raise UserError(f"{folder} has {name} already; choose another --name, or replace it with --force")
    return tuple(entry for entry in entries if entry.name != name)
