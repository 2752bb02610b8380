"""What `esp train` was asked for: the command line first, then a file, then defaults."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer

from esp_cli import console
from esp_cli.commands.counts import parse_count, parse_seed_list, parse_seeds
from esp_cli.commands.options import Device, was_given
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from esp_cli.training.config import RunConfig
    from esp_cli.training.settings import ConfigFile

_PARAMETERS = {"algorithm": "algo"}  # names of parameters that differ from those in a file


def plan_run(
    context: typer.Context, file: Path | None, choices: dict[str, Any], settings: dict[str, object]
) -> tuple[RunConfig, Mapping[str, Tensor] | None, set[str]]:
    """Return the configuration asked for, the weights that it starts from, and chosen settings that have no effect."""
    from esp_cli.machine import resolve_device
    from esp_cli.run import plan
    from esp_cli.training.config import resolve_config
    from esp_cli.training.settings import read_config_file

    chosen = set(settings)
    told = None if file is None else read_config_file(file)
    if told is not None:
        choices, settings, chosen = _with_file(context, told, choices, settings)
    start = choices.pop("init_from")
    choices["device"] = resolve_device(choices["device"])
    asked = resolve_config(**choices, overrides=settings)
    config, weights = plan(asked, start, console.note)
    repeated = None if told is None or was_given(context, "init_from") else told.config
    if repeated and repeated.seeds == config.seeds and repeated.init_from != config.init_from:
        raise UserError(f"{start} holds other weights than the run of {file} started from; add --init-from POLICY")
    return config, weights, chosen & asked.without_effect()


def _with_file(
    context: typer.Context, file: ConfigFile, given: dict[str, Any], settings: dict[str, object]
) -> tuple[dict[str, Any], dict[str, object], set[str]]:
    from esp_cli.prior.config import SAID_BY_AUTO

    path = file.path
    named = {name for name in given if was_given(context, _PARAMETERS.get(name, name))}
    named |= {"seeds"} if was_given(context, "seed_list") else set()
    if file.config is not None:
        own = file.choices | {"network": file.config.network.name}
        asked = {name: given[name] for name in named} | {"network": settings.get("network.name", own["network"])}
        for name in ("task", "algorithm", "preset", "network"):
            if asked.get(name, own[name]) != own[name]:
                flag = _flag(name)
                raise UserError(
                    f"{path} holds every setting of a run with {flag} {own[name]}; leave {flag} out, "
                    "or name a file with only what differs"
                )
    filled = {name: _read(path, name, value) for name, value in file.choices.items() if name not in named}
    kept = file.settings
    if settings.get("prior.kind") == "auto":  # says these by itself
        kept = {name: value for name, value in kept.items() if name.removeprefix("prior.") not in SAID_BY_AUTO}
    changed = any(name.startswith("task.") and kept.get(name) != value for name, value in settings.items())
    if file.config is not None and changed:
        kept = _unmeasured(kept)
    chosen = set(settings) if file.config is not None else {*kept, *settings}
    return given | filled, kept | settings, chosen


def _unmeasured(kept: Mapping[str, object]) -> dict[str, object]:
    """Return the settings of a run without what was measured in its task, for another one."""
    from esp_cli.symmetry.admission import DISCOVERED

    left = {name: value for name, value in kept.items() if name != "prior.weights"}
    if str(left.get("prior.transforms")).startswith(DISCOVERED):
        left["prior.transforms"] = DISCOVERED.rstrip(":")
    return left


def _read(path: Path, name: str, value: Any) -> Any:
    try:
        if name == "steps" and type(value) in (int, str):
            return parse_count(value)
        if name == "seeds" and type(value) in (int, str):
            return parse_seed_list(value) if "," in str(value) else parse_seeds(value)
        if name == "seeds" and isinstance(value, list):
            return parse_seed_list(value)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    known = get_args(Device) if name == "device" else (value,)
    if not isinstance(value, str) or value not in known:
        raise UserError(f"{path} sets '{name}' to {value!r}; write it as esp train {_flag(name)} takes it")
    return value


def _flag(name: str) -> str:
    """Return the option of a choice of a file: "algorithm" -> "--algo", "init_from" -> "--init-from"."""
    return f"--{_PARAMETERS.get(name, name).replace('_', '-')}"
