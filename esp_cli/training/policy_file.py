"""Policy files: the weights of a trained policy, with a description that makes them usable without the run folder."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from esp_cli.defaults import __version__
from esp_cli.training.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from esp_cli.training.config import InitialPolicy, RunConfig
from esp_envs.mpe.frozen_prey import POLICY_FORMAT, POLICY_VERSION, digest
from esp_envs.spec import TaskSpec


def write_policy(path: str | os.PathLike[str], tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
    """Write a policy file; see `save_checkpoint`."""
    save_checkpoint(path, tensors, meta, POLICY_FORMAT, POLICY_VERSION)


def read_policy(path: str | os.PathLike[str], sha256: str | None = None) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read a policy file; see `load_checkpoint`."""
    return load_checkpoint(path, POLICY_FORMAT, POLICY_VERSION, sha256)


def describe_policy(config: RunConfig, spec: TaskSpec, step: int, returns: Sequence[float]) -> dict[str, Any]:
    """Return the description that a policy file holds.

    Args:
        config: of the run, or of the one seed of it that the file holds.
        spec: of the task.
        step: environment steps per seed behind it.
        returns: of greedy episodes, one per seed; NaN where it stopped.
    """
    return {
        "task": config.task,
        "task_version": spec.version,
        "network": config.network.name,
        "activation": getattr(config.network, "activation", None),
        "step": step,
        "greedy_returns": [None if math.isnan(x) else x for x in returns],
        "config": config.model_dump(mode="json"),
        "esp_version": __version__,
    }


def read_initial(path: Path, recorded: InitialPolicy) -> dict[str, Tensor]:
    """Read the weights that a run starts from.

    Raises:
        CheckpointError: they are missing, damaged, or not those that its configuration records.
    """
    tensors, _ = read_policy(path)
    if digest(tensors, {}) != recorded.sha256:
        raise CheckpointError(f"{path} does not hold the policy that the run started from; train anew")
    return tensors
