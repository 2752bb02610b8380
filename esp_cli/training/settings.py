"""What can be set, read from the models that hold the defaults: `esp settings` and the reference pages show it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from esp_cli.algorithms.presets import ALGORITHMS, FAST, PAPER, PRESETS, SETS, TUNED, Sections
from esp_cli.defaults import __version__
from esp_cli.files.documents import flat, read_table, validate
from esp_cli.files.formatting import did_you_mean, shortened
from esp_cli.networks.build import NETWORKS
from esp_cli.prior.config import PriorConfig
from esp_cli.training.config import SECTIONS, EvaluationConfig, RunConfig, completed
from esp_cli.training.run_folder import RunFolder, read_run_config
from esp_envs.errors import UserError
from esp_envs.installed import Registry
from esp_envs.registry import TASKS, task_class

_UNITS = {
    "_m": "m",
    "_s": "s",
    "_rad": "rad",
    "_steps": "steps",
    "_horizon": "steps",
    "_truncation": "steps",
    "_action_delay": "steps",
    "_episodes": "episodes",
    "_num_epochs": "epochs",
    "_num_envs": "worlds",
    "_num_agents": "agents",
    "_landmark_extent": "length",
}
"""Units by the ending of a setting's name; a field may name another one as `json_schema_extra={"unit": ...}`."""

Kind = Literal["algorithm", "task", "network", "prior", "evaluation"]


@dataclass(frozen=True)
class Setting:
    """One setting."""

    name: str  # as `--set` takes it, "mappo.learning_rate"
    type: str  # "integer", "number", "text", "flag", or "list of ..."
    default: Any  # where neither preset, task, file nor command line says something else
    bounds: str  # of its values in words: "from 1", "above 0 to 1", "relu, tanh"; empty for none
    unit: str  # of its value; empty for a bare number
    description: str
    presets: Mapping[str, Any]  # values that a preset sets instead; "fast on navigation" on this task alone
    tasks: Mapping[str, Any]  # values that the preset default sets on a task instead


@dataclass(frozen=True)
class Section:
    """The settings of one task, algorithm or network, or of every run, in the order of their model."""

    name: str
    kind: Kind
    settings: tuple[Setting, ...]


def sections() -> Iterator[Section]:
    """Yield the sections of everything that is built in: learners, tasks, networks, prior, evaluation."""
    for kind, (registry, _) in _KINDS.items():
        yield from (section_of(kind, name) for name in filter(registry.ships, registry))
    yield Section("prior", "prior", _settings("prior", PriorConfig))
    yield Section("evaluation", "evaluation", _settings("evaluation", EvaluationConfig))


def own_section(name: str) -> Section:
    """Import a task, an algorithm or a network of the caller, named as "module:Class", and return its settings."""
    refusals = []
    for kind, (registry, _) in _KINDS.items():
        try:
            registry.register(name)
        except UserError as refusal:
            refusals.append(str(refusal))
            continue
        return section_of(kind, name)
    strange = f"'{name}' is no task, algorithm or network; check its base class"
    raise UserError(next((said for said in refusals if not said.startswith(f"'{name}' is not a")), strange))


_KINDS: dict[Kind, tuple[Registry[Any], Callable[[str], type[BaseModel]]]] = {
    "algorithm": (ALGORITHMS, lambda name: ALGORITHMS[name].config_class),
    "task": (TASKS, lambda name: task_class(name).Settings),
    "network": (NETWORKS, lambda name: NETWORKS[name]),
}


def section_of(kind: Kind, name: str) -> Section:
    """Return the settings of one algorithm, task or network, which may be of the caller; a UserError if it is none."""
    return Section(name, kind, _settings(name if kind == "algorithm" else kind, _KINDS[kind][1](name)))


def _settings(section: str, model: type[BaseModel]) -> tuple[Setting, ...]:
    schema = model.model_json_schema()["properties"]
    return tuple(
        Setting(
            name=f"{section}.{name}",
            type=kind,
            default=schema[name].get("default"),
            bounds=bounds,
            unit=str(schema[name].get("unit", "")) or next((_UNITS[e] for e in _UNITS if f"_{name}".endswith(e)), ""),
            description=field.description or "",
            presets=_changes(section, name, PRESETS)
            | _changes(section, name, FAST, "fast on ")
            | _changes(section, name, PAPER, "paper on "),
            tasks=_changes(section, name, TUNED) | _changes(section, name, SETS, "sets on "),
        )
        for name, field in model.model_fields.items()
        for kind, bounds in [_values(schema[name])]
        if (section, name) != ("network", "name")
    )


def _changes(section: str, name: str, layers: Mapping[str, Mapping[str, Sections]], prefix: str = "") -> dict[str, Any]:
    return {
        f"{prefix}{layer}" if algorithm == section else f"{algorithm} {prefix}{layer}": values[section][name]
        for algorithm, by_layer in layers.items()
        for layer, values in by_layer.items()
        if name in values.get(section, {})
    }


def _values(schema: Mapping[str, Any]) -> tuple[str, str]:
    """Return the type of a setting and which values it may have: "integer" and "from 1", "text" and "relu, tanh"."""
    types = {"boolean": "flag", "string": "text", "array": "list"}
    limits = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}
    kinds, all_bounds = list[str](), list[str]()
    for shape in schema.get("anyOf", [schema]):
        kind = str(shape.get("type", "text"))
        bounds = " ".join(f"{word} {shape[key]:g}" for key, word in limits.items() if key in shape)
        if "enum" in shape:
            bounds = ", ".join(map(str, shape["enum"]))
        elif "items" in shape:
            item, inner = _values(shape["items"])
            kind, bounds = f"list of {item}s", f"each {inner}" if inner else ""
        if kind != "null":  # which stands for the default
            kinds.append(types.get(kind, kind))
            all_bounds.append(bounds)
    return " or ".join(dict.fromkeys(kinds)), ", ".join(filter(None, all_bounds))


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
    known = {*SECTIONS, *SECTIONS.values(), *ALGORITHMS}
    if empty := next((name for name in table if table[name] == {} and name not in known and ":" not in name), None):
        raise UserError(
            f"{path} has an empty section '{shortened(empty)}'{did_you_mean(empty, known) or '; leave it out'}"
        )
    for name, value in flat(table, dots=1):
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
    stored = config.model_dump(mode="json")
    choices = {name: stored[name] for name in CHOICES if name != "init_from"}
    if config.init_from is not None:
        choices["init_from"] = config.init_from.source
    return ConfigFile(path, choices, config.by_name(), config)


def parse_config(data: object, source: Path, writer: object = __version__) -> RunConfig:
    """Validate a configuration that a run folder or file holds, as JSON gave it and a version of esp wrote it."""
    try:
        config = validate(RunConfig, data, "config")
    except UserError as error:
        # Another version may have had another name for a setting; of one version that is damage.
        other = "" if writer == __version__ else f" (written by esp {str(writer)[:20]}, this is {__version__})"
        raise UserError(f"{source}: {error}{other}") from None
    try:
        return completed(config)
    except UserError as error:
        raise UserError(f"{source}: {error}") from None
