"""Trackers: where metrics go beside `metrics.jsonl`, which has them all. A tracker that fails does not stop a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec

from esp_cli.training.trackers.sink import Guarded, Sink, TrackedRun
from esp_envs.errors import UserError
from esp_envs.installed import install, load

__all__ = ["TRACKERS", "Guarded", "Sink", "TrackedRun", "open_trackers", "require"]

TRACKERS = {
    "tensorboard": "esp_cli.training.trackers.tensorboard:TensorBoard",
    "wandb": "esp_cli.training.trackers.wandb:WeightsAndBiases",
    "mlflow": "esp_cli.training.trackers.mlflow:MlFlow",
}
"""The trackers by name: a class that takes a `TrackedRun` and is a `Sink`. Name, extra and package have one name."""


def require(names: Sequence[str]) -> None:
    """Refuse unknown trackers, and those whose package is not installed.

    Raises:
        UserError: with what to install.
    """
    for name in names:
        if name not in TRACKERS:
            raise UserError(f"there is no tracker '{name}'; the trackers are {', '.join(TRACKERS)}")
        if find_spec(name) is None:
            raise UserError(f"{name} is not installed: {install(name)}, or leave out --track {name}")


def open_trackers(names: Sequence[str], run: TrackedRun, tell: Callable[[str], None]) -> list[Guarded]:
    """Open trackers for a run; one that cannot be opened is told and left out.

    Args:
        names: of `TRACKERS`.
        run: that is tracked.
        tell: takes one sentence for the user about a tracker that fails.

    Raises:
        UserError: as of `require`.
    """
    require(names)
    return [Guarded(name, partial(_made, name, run), tell) for name in dict.fromkeys(names)]


def _made(name: str, run: TrackedRun) -> Sink:
    return load(TRACKERS[name])(run)
