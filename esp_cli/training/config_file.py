"""What a file says about a run: the `config.json` of any run, or a small file with only what differs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.defaults import __version__
from esp_cli.files.documents import flat, one_sentence, read_table, validate
from esp_cli.files.formatting import did_you_mean, shortened
from esp_cli.training.config import SECTIONS, RunConfig, completed
from esp_cli.training.run_folder import RunFolder, read_run_config
from esp_envs.errors import UserError
from esp_envs.registry import task_class

CHOICES = ("task", "algorithm", "preset", "steps", "seeds", "device", "init_from")  # of a file, beside settings


@dataclass(frozen=True)
class ConfigFile:
    """What a file says."""

    path: Path
    choices: dict[str, Any]  # of `CHOICES`, those that it names; numbers of steps and seeds may be text, as 500k
    settings: dict[str, Any]  # dotted names to values, as `--set` takes them
    config: RunConfig | None = None  # of the run, where it is the configuration of one, and so says everything


def read_config_file(path: Path) -> ConfigFile:
    """Read the configuration of a run (its folder or its config.json), or a small file as JSON or TOML.

    A small file names settings flat, {"mappo.learning_rate": 5e-4}, or nested, {"mappo": {"learning_rate": 5e-4}},
    beside choices such as {"task": "navigation", "steps": "500k"}. Anything else is a UserError.
    """
    if path.is_dir():
        return _of_run(path, parse_config(RunFolder.open(path).config, path))
    table = read_table(path)
    if "format" in table:
        return _of_run(path, parse_config(read_run_config(path)[0], path))
    choices, settings = {}, {}
    for name, value in flat(table, whole=("prior.weights",)):
        if name in CHOICES:
            choices[name] = value
        elif "." in name:
            # TOML cannot hold the name of the task and a table of its settings under one key
            setting = name.replace("task_settings.", "task.", 1)
            if setting in settings:
                raise UserError(f"{path} sets '{shortened(setting)}' twice; leave one of them out")
            settings[setting] = value
        else:
            hint = did_you_mean(name, CHOICES) or f"; write one of {', '.join(CHOICES)}, or a setting as SECTION.NAME"
            raise UserError(f"{path} sets '{shortened(name)}', which is not a choice of a run{hint}")
    return ConfigFile(path, choices, settings)


def _of_run(path: Path, config: RunConfig) -> ConfigFile:
    """Return everything that the configuration of a run says."""
    stored = config.model_dump(mode="json")
    choices = {name: stored[name] for name in CHOICES if name != "init_from"}
    if config.init_from is not None:
        choices["init_from"] = config.init_from.source
    sections = {config.algorithm: "algorithm_settings"} | SECTIONS
    settings = {f"{section}.{name}": value for section, key in sections.items() for name, value in stored[key].items()}
    return ConfigFile(path, choices, settings, config)


def parse_config(data: object, source: Path, writer: object = __version__) -> RunConfig:
    """Validate a configuration that a run folder or file holds, as JSON gave it and a version of esp wrote it."""
    try:
        config = validate(RunConfig, data)
    except ValidationError as error:
        # Another version may have had another name for a setting; of one version that is damage.
        other = "" if writer == __version__ else f" (written by esp {str(writer)[:20]}, this is {__version__})"
        raise UserError(f"{source}: {one_sentence(error, RunConfig, 'config')}{other}") from None
    try:
        learner = ALGORITHMS[config.algorithm]
    except UserError as error:
        raise UserError(f"{source}: {error}") from None
    _check_settings(task_class(config.task).Settings, config.task_settings, "task", source)
    _check_settings(learner.config_class, config.algorithm_settings, config.algorithm, source)
    return completed(config)


def _check_settings(model: type[BaseModel], settings: object, section: str, source: Path) -> None:
    try:
        validate(model, settings)
    except ValidationError as error:
        raise UserError(f"{source}: {one_sentence(error, model, section)}") from None
