"""How the help of a command is arranged: groups of options, short words for what they take, defaults as written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args, get_origin

from esp_cli.commands.completion import offers
from esp_cli.files.formatting import format_count

_TRAINED, _SEARCHED, _PRIOR, _SETTINGS = "What is trained", "What is searched", "Symmetry prior", "Settings"
_RUN, _OUTPUT, _POLICY, _PICTURE = "How it runs", "Output", "What is evaluated", "Picture"
_GROUPS: dict[str, tuple[str, ...]] = {
    _TRAINED: ("tasks", "algos", "preset", "steps", "seeds", "seed_list", "drones", "grid", "methods", "group"),
    _SEARCHED: ("budget", "space", "goal", "reach", "trial_seeds"),
    _PRIOR: ("transforms", "consistency_coef"),
    _SETTINGS: ("settings", "config", "print_config", "init_from"),
    _RUN: ("resume", "device", "jobs", "dry_run", "reuse", "engine", "address", "gpu_share", "no_check"),
    _POLICY: ("episodes", "seed", "stochastic", "physics", "policy", "at", "mode", "threshold"),
    _PICTURE: ("view", "size", "speed", "fps", "y_limits", "reference", "plot", "films"),
    _OUTPUT: ("out", "force", "json", "csv", "results", "fill", "track", "formats", "name"),
}
_MOVED: dict[str, dict[str, str]] = {
    "train": {"task": _TRAINED, "algo": _TRAINED, "network": _TRAINED, "physics": _TRAINED, "prior": _PRIOR},
    "check": {"transforms": "Options"},
    "discover": {"task": _SEARCHED, "transforms": _SEARCHED, "logs": _SEARCHED},
    "tune": {"prior": _PRIOR},
}
"""Options that belong elsewhere in a command than in the others."""
_WORDS = {int: "COUNT", float: "NUMBER", Path: "PATH"}


def arrange(command: Any) -> Any:
    """Put the options of a command into groups, and say what each takes in a word that leaves room for its meaning."""
    groups = {name: group for group, names in _GROUPS.items() for name in names}
    shared = {"task": _POLICY, "algo": _POLICY, "network": _POLICY, "prior": _POLICY}
    groups = {**shared, **groups, **_MOVED.get(command.name, {})}
    for parameter in command.params:
        if completer := offers(parameter.name):
            parameter._custom_shell_complete = completer
        kind = parameter.type_descriptor.annotation
        if not parameter.opts[0].startswith("-"):
            parameter.display_type_rich = _nothing  # the metavar and the help say it
            continue
        parameter.rich_help_panel = groups.get(parameter.name, "Options")
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
        elif parameter.metavar is None:
            inner = get_args(kind)[0] if get_origin(kind) in (list, tuple) else kind
            parameter.metavar = _WORDS.get(inner, "NAME")
        if parameter.name == "seeds" and isinstance(parameter.default, tuple):
            parameter.show_default = str(len(parameter.default))
        elif parameter.name == "steps" and isinstance(parameter.default, int):
            parameter.show_default = format_count(parameter.default)
    return command


def _nothing(**_: object) -> str:
    return ""
