"""ESP: symmetry priors for multi-agent reinforcement learning."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from esp_envs.installed import FURTHER

if TYPE_CHECKING:
    from esp_cli.bodies import Body
    from esp_cli.checking import Transitions
    from esp_cli.defaults import __version__
    from esp_cli.loop.symmetry import Symmetry
    from esp_cli.policies.loaded import LoadedPolicy, load_policy
    from esp_cli.run import Run, train
    from esp_cli.training.metrics import Metrics
    from esp_cli.training.trainer import Progress
    from esp_envs.spec import Continuous, Discrete, Field, Items, Kind, Layout, discrete_moves, layout

__all__ = [
    "Body",
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
]
__all__ += ["Symmetry", "Transitions", "__version__", "discrete_moves", "layout", "load_policy", "train"]
_HOMES = dict.fromkeys(__all__, "esp_envs.spec") | {
    "Body": "esp_cli.bodies",
    "LoadedPolicy": "esp_cli.policies.loaded",
    "Metrics": "esp_cli.training.metrics",
    "Progress": "esp_cli.training.trainer",
    "Run": "esp_cli.run",
    "Symmetry": "esp_cli.loop.symmetry",
    "Transitions": "esp_cli.checking",
    "__version__": "esp_cli.defaults",
    "load_policy": "esp_cli.policies.loaded",
    "train": "esp_cli.run",
}
__dir__ = __all__.copy
_ROBOTS = ("Ant", "HalfCheetah", "Walker2d", "Humanoid", "Swimmer", "Ant4x2", "HalfCheetah2x3")
FURTHER["esp.tasks"] = {name.lower(): f"esp_cli.bodies.gymnasium:{name}" for name in _ROBOTS}
FURTHER["esp.tasks"]["quadruped"] = "esp_cli.bodies.walking:Quadruped"


def __getattr__(name: str) -> Any:
    """Import what other programs use when they ask for it: torch takes a second, `esp --help` a sixth of one."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
