"""How the help of a command is arranged (groups of options, short words for values)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args, get_origin

from esp_cli.files.formatting import format_count

_TRAINED, _SEARCHED, _PRIOR, _SETTINGS = "What is trained", "What is searched", "Symmetry prior", "Settings"
_RUN, _OUTPUT, _POLICY, _PICTURE = "How it runs", "Output", "What is evaluated", "Picture"
_GROUPS: dict[str, tuple[str, ...]] = {
    _TRAINED: ("tasks", "algos", "preset", "steps", "seeds", "seed_list", "drones", "grid", "methods", "group"),
    _SEARCHED: ("budget", "space", "trial_seeds"),
    _PRIOR: ("transforms",),
    _SETTINGS: ("settings", "config", "print_config", "init_from"),
    _RUN: ("resume", "device", "jobs", "dry_run", "seconds", "reuse", "engine", "address", "gpu_share", "no_check"),
    _POLICY: (
        "task",
        "algo",
        "network",
        "prior",
        "episodes",
        "seed",
        "stochastic",
        "physics",
        "policy",
        "at",
        "mode",
        "threshold",
    ),
    _PICTURE: ("view", "size", "width", "speed", "fps", "style", "plot", "films"),
    _OUTPUT: ("out", "force", "json", "results", "full", "track", "watch", "formats"),
}
_MOVED: dict[str, dict[str, str]] = {  # options that belong elsewhere in a command than in the others
    "train": {"task": _TRAINED, "algo": _TRAINED, "network": _TRAINED, "physics": _TRAINED, "prior": _PRIOR},
    "check": {"transforms": "Options", **dict.fromkeys(("order", "rows", "root"), "Robots")},
    "discover": {"task": _SEARCHED, "transforms": _SEARCHED, "logs": _SEARCHED},
    "tune": {"prior": _PRIOR},
    "mirror": {"root": _SEARCHED, "emit": _OUTPUT, "order": _OUTPUT},
}
_WORDS = {int: "COUNT", float: "NUMBER", Path: "PATH"}


def arrange(command: Any) -> Any:
    """Put the options of a command into groups, and say what each takes in a word that leaves room for its meaning."""
    groups = {name: group for group, names in _GROUPS.items() for name in names} | _MOVED.get(command.name, {})
    for parameter in command.params:
        kind = parameter.type_descriptor.annotation
        if not parameter.opts[0].startswith("-"):
            parameter.display_type_rich = lambda **_: ""  # the metavar and the help say it
            continue
        parameter.rich_help_panel = groups.get(parameter.name, "Options")
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
        elif parameter.metavar is None:
            inner = get_args(kind)[0] if get_origin(kind) in (list, tuple) else kind
            parameter.metavar = _WORDS.get(inner, "NAME")
        if parameter.name == "steps" and isinstance(parameter.default, int):
            parameter.show_default = format_count(parameter.default)
    return command
