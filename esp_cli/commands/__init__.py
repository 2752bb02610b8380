"""The commands of `esp`, one module each: parse, make one call into the engine, print.

A command module may import typer and the console at its top; the engine and torch are imported inside the function,
so that `esp --help`, which reads every module, answers at once. Its docstring is the help text; `EPILOG` holds an
example.
"""

from __future__ import annotations

COMMANDS: dict[str, str] = {
    "demo": "esp_cli.commands.demo:demo",
    "train": "esp_cli.commands.train:train",
    "eval": "esp_cli.commands.eval:evaluate",
    "render": "esp_cli.commands.render:render",
    "ablate": "esp_cli.commands.ablate:ablate",
    "reproduce": "esp_cli.commands.reproduce:reproduce",
    "export": "esp_cli.commands.export:export",
    "policies": "esp_cli.commands.policies:policies",
    "report": "esp_cli.commands.report:report",
    "compare-homomorphic": "esp_cli.commands.compare_homomorphic:compare_homomorphic",
    "tune": "esp_cli.commands.tune:tune",
    "check": "esp_cli.commands.check:check",
    "discover": "esp_cli.commands.discover:discover",
    "mirror": "esp_cli.commands.mirror:mirror",
    "tasks": "esp_cli.commands.tasks:tasks",
    "settings": "esp_cli.commands.settings:settings",
}
"""Command name -> "module:function", in the order in which `esp --help` lists them."""
