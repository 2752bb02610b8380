"""Weights & Biases in the run folder's `wandb/`: offline, unless the environment variable WANDB_MODE says otherwise."""

from __future__ import annotations

import os
import secrets
from typing import Any

import wandb

from esp_cli.files.opening import own_folder
from esp_cli.files.writing import replace_file
from esp_cli.training.trackers.sink import Row, TrackedRun, scalars

_PLACES = ("CACHE", "CONFIG", "DATA", "ARTIFACT")


class WeightsAndBiases:
    """Logs one run; `wandb sync RUN/wandb/offline-run-*` uploads it. A resumed run goes on under the same id."""

    def __init__(self, run: TrackedRun) -> None:
        self._seeds = run.seeds
        folder = run.folder.absolute()
        places = {f"WANDB_{place}_DIR": str(own_folder(folder / "wandb") / place.lower()) for place in _PLACES}
        self._set = [name for name in places if name not in os.environ]  # until the run closes: the next has its own
        os.environ.update({name: places[name] for name in self._set})
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        mode: Any = os.environ.get("WANDB_MODE", "offline")
        quiet = wandb.Settings(
            console="off",
            silent=True,
            disable_git=True,
            disable_code=True,
            disable_job_creation=True,
            x_disable_stats=True,
            x_disable_meta=True,
        )
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "esp"),
                name=folder.name,
                id=_run_id(run),
                resume="allow",
                dir=str(folder),
                mode=mode,
                config=dict(run.config),
                settings=quiet,
            )
        except BaseException:
            self._forget_places()
            raise
        # not wandb's own step, which may not go back as that of a resumed run does
        self._run.define_metric("*", step_metric="step")

    def write(self, step: int, values: Row) -> None:
        """Log the means under their names, and each seed's number under seed-k/NAME."""
        named = {
            name if seed is None else f"seed-{seed}/{name}": value for name, seed, value in scalars(values, self._seeds)
        }
        self._run.log({"step": step, **named})

    def close(self) -> None:
        """Finish the run."""
        try:
            self._run.finish()
        finally:
            self._forget_places()

    def _forget_places(self) -> None:
        for name in self._set:
            os.environ.pop(name, None)


def _run_id(run: TrackedRun) -> str:
    """Return the id that the run folder records, made anew where it records none."""
    file = run.folder / "wandb" / "run-id"
    if not file.is_file():
        file.parent.mkdir(exist_ok=True)
        replace_file(file, secrets.token_hex(4).encode())
    return file.read_text(encoding="utf-8").strip()
