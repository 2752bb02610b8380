"""Getting a trained policy back from a run folder or a policy file; loading never runs code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from torch import Tensor

from esp_cli.networks.policy import Policy
from esp_cli.training.checkpoint import load_checkpoint
from esp_cli.training.config import RunConfig, one_sentence
from esp_cli.training.run_folder import POLICY_FORMAT, RunFolder
from esp_cli.training.streams import generators
from esp_cli.training.trainer import build_environment
from esp_envs.spec import TaskSpec


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy and what it was trained for.

    Attributes:
        config: of the run.
        policy: S policies, in evaluation mode.
        spec: of the task it was trained on.
        step: environment steps per seed behind it.
        source: the run folder or file.
    """

    config: RunConfig
    policy: Policy
    spec: TaskSpec
    step: int
    source: Path


def parse_config(data: Mapping[str, Any], source: Path) -> RunConfig:
    """Read a stored configuration.

    Raises:
        ValueError: it is damaged or of another version.
    """
    try:
        return RunConfig.model_validate(dict(data))
    except ValidationError as error:
        raise ValueError(f"{source}: {one_sentence(error, RunConfig, 'config')}") from None


def load_policy(path: Path) -> TrainedPolicy:
    """Load the policy of a run folder (its newest checkpoint) or of a policy file.

    Raises:
        ValueError: nothing there, not one of ours, damaged, or of another version of the task.
    """
    if path.is_file():
        tensors, meta = load_checkpoint(path, format_name=POLICY_FORMAT)
        return _build(path, parse_config(meta.get("config", {}), path), tensors, meta)
    folder = RunFolder.open(path)
    found = folder.latest_checkpoint()
    if found is None:
        raise ValueError(f"{path} holds no checkpoint yet; train on with esp train --resume {path}")
    tensors, meta = found
    own = {name.removeprefix("policy."): t for name, t in tensors.items() if name.startswith("policy.")}
    return _build(path, parse_config(folder.config, path), own, meta)


def _build(path: Path, config: RunConfig, tensors: dict[str, Tensor], meta: Mapping[str, Any]) -> TrainedPolicy:
    spec = build_environment(config, 1, "shape").spec
    version = meta.get("task_version", spec.version)
    if version != spec.version:
        raise ValueError(f"{path} was trained on {config.task} version {version}, but this is version {spec.version}")
    policy = Policy(spec, config.network, generators(config.seeds, "shape")).to(config.device).eval()
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1].strip()
        raise ValueError(f"{path}: the weights do not fit the configuration beside them ({reason})") from None
    return TrainedPolicy(config, policy, spec, int(meta.get("step", 0)), path)
