"""Trackers: where metrics go beside `metrics.jsonl`, which has them all. A tracker that fails does not stop a run."""

from __future__ import annotations

import contextlib
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from esp_cli.files.documents import flat
from esp_cli.files.opening import own_folder
from esp_cli.files.writing import replace_file
from esp_envs.errors import UserError
from esp_envs.installed import install

Row = Mapping[str, Any]  # metrics by name: a number, None, or a list with one of them per seed


@dataclass(frozen=True)
class TrackedRun:
    """What a tracker knows of a run."""

    folder: Path  # a tracker writes below it and nowhere else
    seeds: tuple[int, ...]  # in the order of the metrics
    config: Mapping[str, Any]  # resolved
    first_step: int = 0  # rows after it are written again by a resumed run


class TensorBoard:
    """Event files in `tensorboard/`: the mean over seeds, and a sub-folder `seed-k` for each seed's curve over it."""

    def __init__(self, run: TrackedRun) -> None:
        if threading.excepthook is threading.__excepthook__:
            threading.excepthook = _print_other_threads
        self._run = run
        self._boards: dict[int | None, Any] = {}  # SummaryWriter has no types
        self._board(None)

    def write(self, step: int, values: Row) -> None:
        for name, seed, value in scalars(values, self._run.seeds):
            self._board(seed).add_scalar(name, value, step)

    def close(self) -> None:
        for board in self._boards.values():
            board.close()

    def _board(self, seed: int | None) -> Any:
        if seed not in self._boards:
            from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - only where it is asked for

            folder = own_folder(self._run.folder / "tensorboard")
            place = folder if seed is None else own_folder(folder / f"seed-{seed}")
            # what a resumed run writes again is hidden, also where it begins anew without a checkpoint
            purge = self._run.first_step + 1 if self._run.first_step else 0
            self._boards[seed] = SummaryWriter(str(place), purge_step=purge, flush_secs=10)
        return self._boards[seed]


def _print_other_threads(failed: threading.ExceptHookArgs) -> None:
    """Print what a thread raised, unless it is one of tensorboard, whose writer raises the same to `Guarded`."""
    if not type(failed.thread).__module__.startswith("tensorboard."):
        threading.__excepthook__(failed)


class WeightsAndBiases:
    """Weights & Biases in `wandb/`: offline, unless the environment variable WANDB_MODE says otherwise."""

    def __init__(self, run: TrackedRun) -> None:
        import wandb  # noqa: PLC0415 - only where it is asked for

        self._seeds = run.seeds
        folder = run.folder.absolute()
        store = own_folder(folder / "wandb")
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        mode: Any = os.environ.get("WANDB_MODE", "offline")
        off = ("disable_git", "disable_code", "disable_job_creation", "x_disable_stats", "x_disable_meta")
        with contextlib.ExitStack() as places:  # until the run closes: the next has its own
            for place in ("CACHE", "CONFIG", "DATA", "ARTIFACT"):
                if (name := f"WANDB_{place}_DIR") not in os.environ:
                    os.environ[name] = str(store / place.lower())
                    places.callback(os.environ.pop, name, None)
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "esp"),
                name=folder.name,
                id=recorded(store / "run-id", lambda: secrets.token_hex(4)),
                resume="allow",
                dir=str(folder),
                mode=mode,
                config=dict(run.config),
                settings=wandb.Settings(console="off", silent=True, **dict.fromkeys(off, True)),
            )
            self._places = places.pop_all()
        # not wandb's own step, which may not go back as that of a resumed run does
        self._run.define_metric("*", step_metric="step")

    def write(self, step: int, values: Row) -> None:
        self._run.log({"step": step, **named(values, self._seeds)})

    def close(self) -> None:
        with self._places:
            self._run.finish()


class MlFlow:
    """MLflow in `mlruns/`, a file store, unless MLFLOW_TRACKING_URI says otherwise; one run of the experiment "esp"."""

    def __init__(self, run: TrackedRun) -> None:
        # read when mlflow is imported or a store is opened; what the user has set stays
        quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_ALLOW_FILE_STORE": "true"}
        # a server that does not answer ends the tracking within seconds, not minutes
        brief = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}
        for name, value in (quiet | brief).items():
            os.environ.setdefault(name, value)
        from mlflow.entities import Metric, Param  # noqa: PLC0415 - reads the environment
        from mlflow.tracking import MlflowClient  # noqa: PLC0415

        folder = run.folder.absolute()
        store = own_folder(folder / "mlruns")
        self._seeds, self._metric = run.seeds, Metric
        self._client = MlflowClient(os.environ.get("MLFLOW_TRACKING_URI") or store.as_uri())
        found = self._client.get_experiment_by_name("esp")
        experiment = found.experiment_id if found is not None else self._client.create_experiment("esp")

        def begin() -> str:
            run_id = self._client.create_run(experiment, run_name=folder.name).info.run_id
            params = [Param(name, str(value)[:500]) for name, value in flat(run.config)]
            for first in range(0, len(params), 100):  # as many as one request takes
                self._client.log_batch(run_id, params=params[first : first + 100])
            return str(run_id)

        self._run_id = recorded(store / "run-id", begin)
        self._client.update_run(self._run_id, status="RUNNING")

    def write(self, step: int, values: Row) -> None:
        now_ms = int(time.time() * 1000)
        metrics = [self._metric(name, value, now_ms, step) for name, value in named(values, self._seeds).items()]
        for first in range(0, len(metrics), 1000):
            self._client.log_batch(self._run_id, metrics=metrics[first : first + 1000])

    def close(self) -> None:
        self._client.set_terminated(self._run_id)


class Tracker(Protocol):
    """What gets the rows of a run."""

    def write(self, step: int, values: Row) -> None: ...

    def close(self) -> None: ...


TRACKERS: dict[str, Callable[[TrackedRun], Tracker]] = {
    "tensorboard": TensorBoard,
    "wandb": WeightsAndBiases,
    "mlflow": MlFlow,
}
"""The trackers by name, which is that of their package and of the extra that installs it."""


class Guarded:
    """Hands rows to a tracker until the tracker fails; the failure becomes one sentence for the user."""

    def __init__(self, name: str, make: Callable[[], Tracker], tell: Callable[[str], None]) -> None:
        self._name, self._tell = name, tell
        self._tracker: Tracker | None = None
        self._tracker = self._attempt("open", make)

    def write(self, step: int, values: Row) -> None:
        """Hand over one row at a step (environment steps per seed), unless the tracker has failed before."""
        if (tracker := self._tracker) is not None:
            self._attempt("write", lambda: tracker.write(step, values))

    def close(self) -> None:
        if (tracker := self._tracker) is not None:
            self._attempt("close", tracker.close)

    def _attempt(self, verb: str, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except Exception as error:  # a tracker is foreign code: whatever it raises, the run goes on
            failed, self._tracker = self._tracker, None
            if failed is not None and verb == "write":
                with contextlib.suppress(Exception):
                    failed.close()
            reason = next(iter(str(error).splitlines()), "") or type(error).__name__
            self._tell(f"tracking with {self._name} ended: it cannot {verb} ({reason[:200]}); the run goes on")
            return None


def require(names: Sequence[str]) -> None:
    """Refuse unknown trackers, and those whose package is not installed, saying what to install."""
    for name in names:
        if name not in TRACKERS:
            raise UserError(f"there is no tracker '{name}'; the trackers are {', '.join(TRACKERS)}")
        if find_spec(name) is None:
            raise UserError(f"{name} is not installed: {install(name)}, or leave out --track {name}")


def open_trackers(names: Sequence[str], run: TrackedRun, tell: Callable[[str], None]) -> list[Guarded]:
    """Open trackers for a run; one that cannot be opened is told and left out."""
    return [Guarded(name, partial(TRACKERS[name], run), tell) for name in dict.fromkeys(names)]


def scalars(values: Row, seeds: tuple[int, ...]) -> Iterator[tuple[str, int | None, float]]:
    """Yield name, seed and number of a row's metrics: the mean over seeds, where the seed is None, then each seed's.

    The mean is left out where any seed has no number, as it would be of other seeds than before.
    """
    for name, value in values.items():
        numbers = value if isinstance(value, list) else [value]
        known = [number for number in numbers if number is not None]
        if numbers and len(known) == len(numbers):
            yield name, None, sum(known) / len(known)
        if len(numbers) == len(seeds) > 1:
            yield from ((name, seed, x) for seed, x in zip(seeds, numbers, strict=True) if x is not None)


def named(values: Row, seeds: tuple[int, ...]) -> dict[str, float]:
    """Return the means of a row under their names, and each seed's number under seed-k/NAME."""
    return {n if seed is None else f"seed-{seed}/{n}": value for n, seed, value in scalars(values, seeds)}


def recorded(file: Path, make: Callable[[], str]) -> str:
    """Return the id of a tracked run that a run folder records; made and recorded where it has none."""
    if not file.is_file():
        known = make()
        file.parent.mkdir(exist_ok=True)
        replace_file(file, known.encode())
    return file.read_text(encoding="utf-8").strip()
