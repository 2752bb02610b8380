"""The collect-learn-evaluate loop: resumable bit for bit, stoppable at any moment, printing nothing."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError
from torch import Tensor

from esp_cli.algorithms.normalisation import with_variances
from esp_cli.training.build import (
    PolicyController,
    build_environment,
    build_learner,
    first_look,
    generators,
    play,
    stream_seeds,
)
from esp_cli.training.checkpoint import describe_policy, read_initial
from esp_cli.training.config import RunConfig
from esp_cli.training.metrics import RETURN, MetricsWriter, column, read_metrics, truncate_metrics
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.trackers import TrackedRun, open_trackers, require
from esp_envs.errors import UserError
from esp_envs.promises import equal


def checkpoint_seconds() -> float:
    """Return what ESP_CHECKPOINT_SECONDS says, or its default; raises a UserError where it is no number of seconds."""
    text = os.environ.get("ESP_CHECKPOINT_SECONDS", "30")
    if not re.fullmatch(r"\d{1,9}(\.\d{0,9})?", text):
        raise UserError(f"ESP_CHECKPOINT_SECONDS is '{text}'; set it to a number of seconds, such as 30")
    return float(text)


CHECKPOINT_SECONDS = checkpoint_seconds()  # between checkpoints, which are what a kill can lose
CHECKPOINT_SPACING = 20  # the next one waits at least so many times as long as the last one took


class Standing(BaseModel):
    """Where a run stands, as its checkpoint says; steps are per seed."""

    step: int = Field(ge=0)
    iteration: int = Field(ge=0)
    elapsed_s: float = Field(ge=0, allow_inf_nan=False)
    stopped_seeds: dict[int, int]
    task_version: int


@dataclass(frozen=True)
class Progress:
    """The news for a listener after every iteration.

    Attributes:
        step: environment steps per seed so far.
        total: environment steps per seed of the whole run.
        metrics: the newest row, each value one number per seed.
        notes: sentences for the user (a seed stopped, a checkpoint was damaged).
    """

    step: int
    total: int
    metrics: Mapping[str, list[float | None]]
    notes: tuple[str, ...] = ()


Listener = Callable[[Progress], bool | None]  # told of progress; returns False to ask for a clean stop after it


class Trainer:
    """One run: S seeds of one configuration, in a folder that the caller locked; a checkpoint there is continued."""

    def __init__(self, config: RunConfig, folder: RunFolder, track: Sequence[str] = (), check: bool = True) -> None:
        self.config, self.folder, self.track = config, folder, tuple(track)
        require(self.track)
        self.learner = build_learner(config)
        self.iteration = 0
        self.stopped_seeds: dict[int, int] = {}
        self.elapsed_s = 0.0
        self.notes: list[str] = []
        self._restore(check)
        self._good = self._snapshot()
        self.evaluation_worlds = build_environment(config, config.evaluation.episodes, "evaluation")

    @property
    def step(self) -> int:
        return self.iteration * self.learner.steps_per_iteration

    @property
    def total_iterations(self) -> int:
        return -(-self.config.steps // self.learner.steps_per_iteration)

    @property
    def is_complete(self) -> bool:
        return self.iteration >= self.total_iterations

    @property
    def all_stopped(self) -> bool:
        """Whether no seed has finite numbers any more."""
        return len(self.stopped_seeds) == len(self.config.seeds)

    def final_returns(self) -> dict[str, NDArray[np.float64]]:
        """Return the last evaluation of the run: greedy and stochastic, one return per seed (NaN where it stopped)."""
        rows = read_metrics(self.folder.metrics_path)
        return {mode: column(rows, f"eval/return_{mode}")[1][-1] for mode in ("greedy", "stochastic")}

    def run(self, listener: Listener) -> bool:
        """Train to the end or until the listener asks to stop; return whether the run is complete."""
        self._refuse_if_all_stopped()
        started, due = time.monotonic() - self.elapsed_s, time.monotonic() + CHECKPOINT_SECONDS
        tracked = TrackedRun(self.folder.path, self.config.seeds, self.folder.config, self.step)
        sinks = open_trackers(self.track, tracked, self.notes.append)
        with MetricsWriter(self.folder.metrics_path, sinks) as writer:
            if self.iteration == 0 and not self._record(writer, self._evaluate(), listener):
                return False
            if self.is_complete and not any(RETURN in row for row in read_metrics(self.folder.metrics_path)):
                self._record(writer, self._evaluate(), listener)  # they are lost
            while not self.is_complete:
                tick = time.monotonic()
                row = self._iterate()
                row["time/elapsed_s"] = self.elapsed_s = time.monotonic() - started
                going = self._record(writer, row, listener)
                if self.is_complete or not going or self.all_stopped or tick > due:
                    cost = self._checkpoint()
                    due = time.monotonic() + max(CHECKPOINT_SECONDS, CHECKPOINT_SPACING * cost)
                self._refuse_if_all_stopped()
                if not going and not self.is_complete:
                    return False
            # before the trackers are closed: what another program does there must not keep a run from its policy
            returns = self.final_returns()["greedy"].tolist()
            meta = describe_policy(self.config, self.learner.spec, self.step, returns)
            self.folder.write_policy(self.learner.policy.state_dict(), meta)
        return True

    def _refuse_if_all_stopped(self) -> None:
        if self.all_stopped:
            raise UserError(
                "every seed stopped on a number that is not finite; ask 'esp check task' whether the task has one, "
                "or try a smaller learning rate"
            )

    def _iterate(self) -> dict[str, Any]:
        begun = time.monotonic()
        before = self.step // self.config.evaluation.every_steps
        progress = self.iteration / self.total_iterations
        self.learner.begin(progress)
        result = self.learner.iterate(progress)
        self.iteration += 1
        row: dict[str, Any] = {name: value.cpu() for name, value in result.metrics.items()}
        self._stop_broken_seeds(result.finite)
        steps = self.learner.steps_per_iteration * len(self.config.seeds)
        row["time/steps_per_second"] = steps / (time.monotonic() - begun)  # of learning alone
        if self.step // self.config.evaluation.every_steps > before or self.is_complete or self.all_stopped:
            row |= self._evaluate()
        return row

    def _evaluate(self) -> dict[str, Tensor]:
        """Play greedy and stochastic episodes; every seed's worlds depend on its seed, the step and the mode."""
        env, row = self.evaluation_worlds, {}
        for mode in ("greedy", "stochastic"):
            stream = ("evaluation", mode, self.step)
            for generator, seed in zip(env.generators, stream_seeds(self.config.seeds, *stream), strict=True):
                generator.manual_seed(seed)
            noise = generators(self.config.seeds, *stream, "noise") if mode == "stochastic" else None
            episodes = play(env, PolicyController(self.learner.policy, noise))
            row[f"eval/return_{mode}"] = episodes.returns.mean(1).cpu()
            if mode == "greedy":
                row |= {f"eval/{name}": value.mean(1).cpu() for name, value in episodes.metrics.items()}
        return row

    def _stop_broken_seeds(self, finite: Tensor) -> None:
        """Reset a seed whose numbers are not `finite` [S] to its last good state, for the rest of the run."""
        for index in (~finite).nonzero().flatten().tolist():
            if index not in self.stopped_seeds:
                self.stopped_seeds[index] = self.step
                seed = self.config.seeds[index]
                self.notes.append(
                    f"seed {seed} stopped at step {self.step}: a loss is not finite; its last good policy is kept"
                )
        if self.stopped_seeds:
            # weights, statistics and moments: the optimiser has these from the start, so there are always as many
            for tensor, good in zip(self.learner.seed_tensors(), self._good, strict=True):
                for index in self.stopped_seeds:
                    tensor[index] = good[index]
        self._good = self._snapshot()

    @torch.no_grad()
    def _snapshot(self) -> list[Tensor]:
        return [tensor.clone() for tensor in self.learner.seed_tensors()]

    def _record(self, writer: MetricsWriter, row: dict[str, Any], listener: Listener) -> bool:
        values, notes = writer.write(self.step, row, self.stopped_seeds), tuple(self.notes)
        self.notes.clear()
        return listener(Progress(self.step, self.config.steps, values, notes)) is not False

    def _checkpoint(self) -> float:
        begun = time.monotonic()
        meta = {
            "iteration": self.iteration,
            "elapsed_s": self.elapsed_s,
            "stopped_seeds": {str(index): step for index, step in self.stopped_seeds.items()},
            "task_version": self.learner.spec.version,
        }
        self.folder.write_checkpoint(self.step, self.learner.state_dict(self.is_complete), meta, self.is_complete)
        return time.monotonic() - begun

    def _restore(self, check: bool) -> None:
        found = self.folder.latest_checkpoint(self.notes.append)
        if found is not None:
            self._load(found[0])
            self._stand(found[1])
        elif self.folder.policy_path.is_file():
            raise UserError(
                f"{self.folder.path} is trained and has no checkpoint to go on from; train anew under another --out"
            )
        elif self.config.init_from is not None:
            self.learner.start_from(read_initial(self.folder.initial_path, self.config.init_from))
        if found is None and check:
            self.notes += first_look(self.config)
        if found and not self.folder.metrics_path.exists():
            self.notes.append(f"{self.folder.metrics_path} is gone; curves of this run begin at step {self.step}")
        truncate_metrics(self.folder.metrics_path, self.step if found else -1)

    def _stand(self, meta: Mapping[str, Any]) -> None:
        try:
            stands = Standing.model_validate(meta)
        except ValidationError:
            raise UserError(f"the checkpoint in {self.folder.path} does not say where its run stands") from None
        self.iteration, self.elapsed_s = stands.iteration, stands.elapsed_s
        self.stopped_seeds = stands.stopped_seeds
        if self.step != stands.step or not set(self.stopped_seeds) <= set(range(len(self.config.seeds))):
            raise UserError(f"the checkpoint in {self.folder.path} is of another run; train anew")
        if stands.task_version != (version := self.learner.spec.version):
            raise UserError(
                f"{self.folder.path} was trained on {self.config.task} version {stands.task_version}, but this is "
                f"version {version}; use the esp that it was begun with, or train anew"
            )

    def _load(self, tensors: dict[str, Tensor]) -> None:
        before, tensors = self.learner.state_dict(), with_variances(tensors)
        self.learner.load_state_dict(tensors)
        now, needed = self.learner.state_dict(), self.learner.state_dict(complete=True)
        names = {*tensors, *needed}
        if not self.learner.collector.env.has("state_dict"):  # worlds that begin anew, whatever was saved of them
            names = {name for name in names if not name.startswith("collector.")}
        for name in sorted(names):
            a, b, stored = before.get(name), now.get(name), tensors.get(name)
            fits = b is not None and stored is not None and b.dtype == stored.dtype and equal(b.cpu(), stored)
            if fits and a is not None and b is not None:  # a replay has grown, and checks its shapes itself
                fits = a.dtype == b.dtype and (a.shape == b.shape or name.startswith("replay."))
            if not fits:
                raise UserError(f"the checkpoint in {self.folder.path} does not fit this configuration ({name})")
