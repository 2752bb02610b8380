"""The memory that a run needs at least, so that a slip of the keyboard is refused before the memory is taken."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import torch

from esp_cli.algorithms.learner import LearnerConfig
from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.training.config import RunConfig
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec

_FLOAT_BYTES = 4
_COPIES_OF_WEIGHTS = 4  # weights, gradients, and the two moments of Adam
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
"""Where Linux says what the processes of a container may take, in its second and first version of control groups."""
_PROCESS_BYTES = 500 * 2**20  # of a process with torch and its libraries, before it trains


def refuse_what_does_not_fit(config: RunConfig, settings: LearnerConfig, spec: TaskSpec) -> None:
    """Refuse a run that needs more memory than the machine has; the error names the setting that needs most of it."""
    needed = least_bytes(config, settings, spec)
    available = machine_bytes(config.device)
    if sum(needed.values()) > available:
        name = max(needed, key=lambda key: needed[key])
        raise UserError(
            f"this run needs at least {_gigabytes(sum(needed.values()))} of memory, {_gigabytes(needed[name])} of it "
            f"for '{name}' with {len(config.seeds)} seeds, but {config.device} has {_gigabytes(available)}; choose a "
            f"smaller {name}, or fewer seeds"
        )


def least_bytes(config: RunConfig, settings: LearnerConfig, spec: TaskSpec) -> dict[str, int]:
    """Return, by setting, bytes that a run needs at least: what every seed, world and step has to hold."""
    algorithm, plain = config.algorithm, settings.model_dump()
    steps = int(plain.get("num_steps", spec.horizon))
    rows = {
        f"{algorithm}.num_envs": settings.num_envs * steps,
        f"{algorithm}.replay_episodes": int(plain.get("replay_episodes", 0)) * spec.horizon,
        f"{algorithm}.batch_episodes": int(plain.get("batch_episodes", 0)) * spec.horizon,
        "evaluation.episodes": config.evaluation.episodes,
    }
    row_bytes = _FLOAT_BYTES * (spec.num_agents * spec.observation.width + spec.state.width)
    weights = config.network.least_parameters(spec.observation.width) * _FLOAT_BYTES * _COPIES_OF_WEIGHTS
    sizes = {name: count * row_bytes for name, count in rows.items()} | {"network.hidden": weights}
    return {name: size * len(config.seeds) for name, size in sizes.items()}


def process_bytes(config: RunConfig, spec: TaskSpec) -> int:
    """Return the memory for a process that trains a run on a cluster: twice what it has to hold, and torch."""
    settings = ALGORITHMS[config.algorithm].config_class(**config.algorithm_settings)
    return _PROCESS_BYTES + 2 * sum(least_bytes(config, settings, spec).values())


def machine_bytes(device: str) -> int:
    """Return the memory of the device that trains; in a container what the container may take."""
    if device == "cuda":
        return torch.cuda.get_device_properties(0).total_memory
    installed = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for file in _LIMITS:
        with contextlib.suppress(OSError, ValueError):  # there is no such file, or it says "max"
            installed = min(installed, int(file.read_text()))
    return installed


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:,.1f} GB"
