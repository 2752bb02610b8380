"""The exact command line behind a configuration, for whoever has the run and not the command."""

from __future__ import annotations

import json
import shlex

from esp_cli.reporting.results import flat
from esp_cli.training.config import RunConfig, resolve_config

_SECTIONS = {"task_settings": "task", "network": "network", "prior": "prior", "evaluation": "evaluation"}


def command_of(config: RunConfig) -> str:
    """Return an `esp train` command line that resolves to a configuration.

    Settings that the preset has already are left out.

    Args:
        config: of a run.
    """
    parts = ["esp", "train", "--task", config.task, "--algo", config.algorithm, "--preset", config.preset]
    parts += ["--steps", str(config.steps), "--seeds", _seeds(config.seeds), "--device", config.device]
    wanted = flat(config.model_dump(mode="json"))
    preset = resolve_config(config.task, config.algorithm, config.preset, config.steps, config.seeds, config.device)
    known = flat(preset.model_dump(mode="json"))
    sections = {**_SECTIONS, "algorithm_settings": config.algorithm}
    for name, value in wanted.items():
        section, _, rest = name.partition(".")
        if rest and known.get(name, ...) != value:
            parts += ["--set", f"{sections[section]}.{rest}={json.dumps(value)}"]
    return shlex.join(parts)


def _seeds(seeds: tuple[int, ...]) -> str:
    whole = seeds == tuple(range(len(seeds)))
    return str(len(seeds)) if whole else ",".join(map(str, seeds)) + ","
