"""What `esp train` was asked for: the command line first, then a file, then defaults."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import typer

from esp_cli.commands.counts import parse_count, parse_seed_list, parse_seeds
from esp_cli.commands.options import Device, was_given
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from torch import Tensor

    from esp_cli.policies.loading import Start
    from esp_cli.training.config import RunConfig

_PARAMETERS = {"algorithm": "algo"}  # names of parameters that differ from those in a file


def plan_run(
    context: typer.Context, file: Path | None, choices: dict[str, Any], settings: dict[str, object]
) -> tuple[RunConfig, Mapping[str, Tensor] | None, set[str]]:
    """Return the configuration asked for, the weights that it starts from, and chosen settings that have no effect."""
    from esp_cli.machine import resolve_device
    from esp_cli.run import plan
    from esp_cli.training.config import resolve_config

    chosen = set(settings)
    if file is not None:
        choices, settings, chosen = _with_file(context, file, choices, settings)
    start = choices.pop("init_from")
    choices["device"] = resolve_device(choices["device"])
    idle = chosen & resolve_config(**choices, overrides=settings).without_effect()
    config, weights = plan(algo=choices.pop("algorithm"), settings=settings, init_from=start, **choices)
    return config, weights, idle


def _with_file(
    context: typer.Context, path: Path, given: dict[str, Any], settings: dict[str, object]
) -> tuple[dict[str, Any], dict[str, object], set[str]]:
    from esp_cli.prior.config import SAID_BY_AUTO
    from esp_cli.training.settings import read_config_file

    file = read_config_file(path)
    named = {name for name in given if was_given(context, _PARAMETERS.get(name, name))}
    named |= {"seeds"} if was_given(context, "seed_list") else set()
    if file.config is not None:
        for name in ("task", "algorithm", "preset"):
            if name in named and given[name] != file.choices[name]:
                flag = _flag(name)
                raise UserError(
                    f"{path} holds every setting of a run with {flag} {file.choices[name]}; leave {flag} out, "
                    "or name a file with only what differs"
                )
    filled = {name: _read(path, name, value) for name, value in file.choices.items() if name not in named}
    if file.config is not None and "init_from" in filled:
        filled["init_from"] = _start_of(path, file.config, filled["init_from"])
    kept = file.settings
    if settings.get("prior.kind") == "auto":  # says these by itself
        kept = {name: value for name, value in kept.items() if name.removeprefix("prior.") not in SAID_BY_AUTO}
    if file.config is not None:
        kept = _fitting(kept, settings)
    chosen = set(settings) if file.config is not None else {*kept, *settings}
    return given | filled, kept | settings, chosen


def _fitting(kept: Mapping[str, object], settings: Mapping[str, object]) -> dict[str, object]:
    """Return the settings of a whole run without those that the user's other network or task makes void."""
    left = dict(kept)
    if "network.name" in settings:
        from esp_cli.networks.build import network_class

        known = {f"network.{name}" for name in network_class(settings["network.name"]).model_fields}
        left = {name: value for name, value in left.items() if not name.startswith("network.") or name in known}
    if any(name.startswith("task.") and kept.get(name) != value for name, value in settings.items()):
        from esp_cli.symmetry.admission import DISCOVERED

        left.pop("prior.weights", None)
        if str(left.get("prior.transforms")).startswith(DISCOVERED):
            left["prior.transforms"] = DISCOVERED.rstrip(":")
    return left


def _start_of(path: Path, config: RunConfig, source: str) -> Start:
    """Return the weights that a run started from: the copy in its folder, or the policy if that is still the same."""
    from esp_cli.policies.loading import Start

    if path.is_dir() and (own := Start.find_copy(path, config)) is not None:
        return own
    started = f"the run of {path} started from the policy {source}"
    try:
        start = Start.open(source)
    except UserError:
        raise UserError(f"{started}, which cannot be read here; add --init-from POLICY") from None
    if not start.matches(config):
        folder = "" if path.is_dir() else ", or name the folder of the run, which holds a copy"
        raise UserError(f"{started}, which holds other weights now; add --init-from POLICY{folder}")
    return start


def _read(path: Path, name: str, value: Any) -> Any:
    try:
        if name == "steps" and type(value) in (int, str):
            return parse_count(value)
        if name == "seeds" and type(value) in (int, str):
            return parse_seeds(value)
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
