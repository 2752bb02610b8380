"""What `esp train` was asked for: the command line first, then a file, then defaults."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import typer

from esp_cli.commands.counts import parse_count, parse_seed_list, parse_seeds
from esp_cli.commands.options import Device, was_given

_PARAMETERS = {"algorithm": "algo"}
"""Names of parameters that differ from those in a file."""


def with_file(
    context: typer.Context, path: Path, given: dict[str, Any], settings: dict[str, object]
) -> tuple[dict[str, Any], dict[str, object], set[str]]:
    """Let a file fill in what the command line leaves open.

    Args:
        context: of the command, which knows what was given.
        path: of the file.
        given: choices by their name in a file, defaults included.
        settings: of the command line.

    Returns:
        The choices, the settings, and the names of settings that somebody chose: not those of a whole configuration.

    Raises:
        ValueError: the file cannot be read, or does not go with what was given.
    """
    from esp_cli.deploy.bundled import open_policy
    from esp_cli.prior.config import SAID_BY_AUTO
    from esp_cli.training.config_file import read_config_file

    file = read_config_file(path)
    said = {name for name in given if was_given(context, _PARAMETERS.get(name, name))}
    said |= {"seeds"} if was_given(context, "seed_list") else set()
    if file.is_complete:
        for name in ("task", "algorithm", "preset"):
            if name in said and given[name] != file.choices[name]:
                flag = f"--{_PARAMETERS.get(name, name)}"
                raise ValueError(
                    f"{path} holds every setting of a run with {flag} {file.choices[name]}; leave {flag} out, "
                    "or name a file with only what differs"
                )
    filled = {name: _read(path, name, value) for name, value in file.choices.items() if name not in said}
    if file.is_complete and (source := filled.get("init_from")) is not None:
        try:
            open_policy(Path(source))
        except ValueError:
            raise ValueError(
                f"the run of {path} started from the policy {source}, which cannot be read here; add --init-from POLICY"
            ) from None
    kept = file.settings
    if settings.get("prior.kind") == "auto":  # says these by itself
        kept = {name: value for name, value in kept.items() if name.removeprefix("prior.") not in SAID_BY_AUTO}
    chosen = set(settings) if file.is_complete else {*kept, *settings}
    return given | filled, kept | settings, chosen


def _read(path: Path, name: str, value: Any) -> Any:
    """Return a choice of a file in the form that its option has."""
    try:
        if name == "steps" and type(value) in (int, str):
            return parse_count(value)
        if name == "seeds" and type(value) in (int, str):
            return parse_seeds(value)
        if name == "seeds" and isinstance(value, list):
            return parse_seed_list(value)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    known = get_args(Device) if name == "device" else (value,)
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{path} sets '{name}' to {value!r}; write it as esp train --{name} takes it")
    return value
