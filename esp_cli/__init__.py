"""ESP: symmetry priors for multi-agent reinforcement learning."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from esp_cli.checking import Transitions
    from esp_cli.defaults import __version__
    from esp_cli.loop.symmetry import Symmetry
    from esp_cli.policies.loaded import LoadedPolicy, load_policy
    from esp_cli.run import Run, train
    from esp_cli.training.metrics_table import Metrics
    from esp_cli.training.trainer import Progress
    from esp_envs.moves import discrete_moves
    from esp_envs.spec import Continuous, Discrete, Field, Items, Kind, Layout, layout

__all__ = [
    "Continuous",
    "Discrete",
    "Field",
    "Items",
    "Kind",
    "Layout",
    "LoadedPolicy",
    "Metrics",
    "Progress",
    "Run",
    "Symmetry",
    "Transitions",
    "__version__",
    "discrete_moves",
    "layout",
    "load_policy",
    "train",
]

_HOMES = {
    "LoadedPolicy": "esp_cli.policies.loaded",
    "Metrics": "esp_cli.training.metrics_table",
    "Progress": "esp_cli.training.trainer",
    "Run": "esp_cli.run",
    "Symmetry": "esp_cli.loop.symmetry",
    "Transitions": "esp_cli.checking",
    "__version__": "esp_cli.defaults",
    "discrete_moves": "esp_envs.moves",
    "load_policy": "esp_cli.policies.loaded",
    "train": "esp_cli.run",
}
"""Where a public name is defined; the others describe spaces."""


def __getattr__(name: str) -> Any:
    """Import what other programs use when they ask for it: torch takes a second, `esp --help` a sixth of one."""
    if name in __all__:
        return getattr(import_module(_HOMES.get(name, "esp_envs.spec")), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
