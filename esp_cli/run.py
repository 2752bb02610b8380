"""Runs for other programs: train, read the metrics, evaluate, draw, and let the policy act.

from esp_cli import train

run = train("navigation", "mappo", steps=100_000, seeds=(0, 1), out="runs/cn")
print(run.metrics["eval/return_greedy"][-1], run.evaluate(64).greedy.mean)
run.render("cn.gif")
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from esp_cli.algorithms.learner import Learner
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.checking.measured import prepared
from esp_cli.defaults import EPISODES, STEPS
from esp_cli.files.formatting import Shown, attempting, file_name, format_count
from esp_cli.machine import resolve_device
from esp_cli.networks.contract import NetworkConfig
from esp_cli.policies.evaluation import FinalEvaluation
from esp_cli.policies.evaluation import evaluate as evaluate_policy
from esp_cli.policies.loaded import LoadedPolicy, register_own
from esp_cli.policies.loading import TrainedPolicy, weights_to_start
from esp_cli.training.build import build_learner
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.metrics import Metrics, read_last_row, read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_cli.training.trackers import require
from esp_cli.training.trainer import Listener, Trainer
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.registry import register

if TYPE_CHECKING:
    from esp_cli.drawing.draw import Drawing, View


class Run(Shown):
    """A run in its folder: S seeds of one task, algorithm, network and prior.

    Example:
        run = Run("runs/cn")
        print(run.evaluate(64).greedy.mean)

    Args:
        path: of the run folder.
        task: the task that the run is of, as "module:Class" or as the class, where it is not installed.
        algo: its algorithm, likewise.
        network: the settings class of its network, likewise.

    Attributes:
        path: of the run folder.
        config: that decides its numbers.

    Raises:
        UserError: here and in all methods, what a caller can correct: there is no run, it is damaged or of another
            version, it has no checkpoint yet, another process trains it, or an argument does not fit it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        task: str | type[Environment] | None = None,
        algo: str | type[Learner] | None = None,
        network: str | type[NetworkConfig] | None = None,
    ) -> None:
        register_own(task, algo, network)
        self.folder = RunFolder.open(Path(path))
        self.path = self.folder.path
        self.config: RunConfig = parse_config(self.folder.config, self.path)

    def _facts(self) -> Mapping[str, object]:
        config, row = self.config, read_last_row(self.folder.metrics_path)
        evaluated = {k: v for k, v in self.metrics._facts().items() if k.startswith("eval/return")} if row else {}
        return {
            "run": self.path,
            "what": f"{config.algorithm} on {config.task}, prior {config.prior.kind}, network {config.network.name}",
            "seeds": ", ".join(map(str, config.seeds)),
            "steps": f"{format_count(row.get('step', 0))} of {format_count(config.steps)}",
            **evaluated,
        }

    @property
    def metrics(self) -> Metrics:
        """What was logged so far: arrays [U, S] by name, one row per update and one column per seed."""
        return Metrics(read_metrics(self.folder.metrics_path), self.config.seeds)

    @property
    def policy(self) -> LoadedPolicy:
        """The newest policy of the first seed, numpy in and out; `load_policy(run.path, seed=k)` gives another's."""
        return LoadedPolicy(TrainedPolicy.read(self.path))

    @property
    def is_complete(self) -> bool:
        """Whether training reached its last step."""
        return self.folder.policy_path.is_file()

    @contextmanager
    def trainer(self, track: Sequence[str] = (), check: bool = True) -> Iterator[Trainer]:
        """Hold the folder against other processes, and yield what trains it from its newest checkpoint on.

        Args:
            track: names of trackers that get the metrics too: "tensorboard", "wandb", "mlflow".
            check: take a short look at a task that is not built in before a new run begins.
        """
        resolve_device(self.config.device)
        with self.folder.lock():
            yield Trainer(self.config, self.folder, track, check)

    def train(self, listener: Listener | None = None, track: Sequence[str] = (), check: bool = True) -> bool:
        """Train on from the newest checkpoint, bit for bit as without a break, and return whether the run is complete.

        Args:
            listener: told of progress after every update; False asks for a clean stop.
            track: as of `trainer`.
            check: as of `trainer`.
        """
        with self.trainer(track, check) as trainer:
            return (trainer.is_complete and self.is_complete) or trainer.run(listener or (lambda _: True))

    def evaluate(self, episodes: int = EPISODES, settings: Mapping[str, object] | None = None) -> FinalEvaluation:
        """Play episodes with the newest policies, and with the reference policies of the task.

        Args:
            episodes: per seed, greedy and stochastic each.
            settings: of the task, without the prefix "task.", where they differ from those of training.
        """
        return evaluate_policy(self._trained(settings), episodes)

    def render(
        self,
        out: str | os.PathLike[str],
        *,
        seed: int | None = None,
        episodes: int | None = None,
        view: View = "auto",
        size: int = 480,
        width: float | None = None,
        speed: float = 1.0,
        greedy: bool = True,
        settings: Mapping[str, object] | None = None,
    ) -> Drawing:
        """Draw episodes of one seed's policy as a film (.gif, .mp4), or a picture (.png, .pdf, .svg) of one episode.

        Args:
            out: the file.
            seed: whose policy acts; by default the first.
            episodes: of a film; by default they last about 8 s.
            view: "top" from above, "3d" in space, "auto" the latter where the task has it.
            size: of the longer side, pixels.
            width: of a picture for print, mm; letters then have 8 points.
            speed: times real time.
            greedy: whether it takes its most probable actions, or draws them.
            settings: as of `evaluate`.
        """
        from esp_cli.drawing.draw import Request, draw  # noqa: PLC0415 - training needs no plotting

        request = Request(Path(out), seed, episodes, view, size, speed, width=width, greedy=greedy)
        return draw(request, [self._trained(settings)])

    def _trained(self, settings: Mapping[str, object] | None) -> TrainedPolicy:
        return TrainedPolicy.read(self.path).transfer(settings or {})


def plan(
    config: RunConfig, init_from: str | os.PathLike[str] | None, note: Callable[[str], object] = lambda _: None
) -> tuple[RunConfig, Mapping[str, Tensor] | None]:
    """Return the configuration of a new run with what has to be measured, and its first weights, as `train` says."""
    config = prepared(config)
    learner = build_learner(config)
    if init_from is None:
        return config, None
    initial, weights = weights_to_start(init_from, learner, note)
    return config.model_copy(update={"init_from": initial}), weights


def begin(config: RunConfig, weights: Mapping[str, Tensor] | None, out: str | os.PathLike[str] | None) -> Run:
    """Make the folder of a new run, by default a new one in runs/."""
    names = file_name(config.task), file_name(config.algorithm), config.prior.kind, time.strftime("%Y%m%d-%H%M%S")
    first = Path("runs") / "-".join(names)
    numbered = (first.with_name(f"{first.name}-{k}") for k in itertools.count(2))
    path = next(filter(_is_made, itertools.chain([first], numbered))) if out is None else Path(out)
    return Run(RunFolder.create(path, config.model_dump(mode="json"), initial=weights).path)


def _is_made(path: Path) -> bool:
    """Make a folder, unless there is one, of whatever program."""
    with attempting("make the run folder", path):
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            return False
    return True


def train(
    task: str | type[Environment] = "navigation",
    algo: str | type[Learner] = "mappo",
    *,
    steps: int = STEPS,
    seeds: Sequence[int] = (0,),
    preset: str = "default",
    settings: Mapping[str, object] | None = None,
    device: str = "cpu",
    out: str | os.PathLike[str] | None = None,
    init_from: str | os.PathLike[str] | None = None,
    listener: Listener | None = None,
    track: Sequence[str] = (),
    check: bool = True,
) -> Run:
    """Train S seeds at once, as `esp train` does, and return the run.

    Args:
        task: name of a task, "module:Class", or the class of one.
        algo: "mappo", "maddpg" or "qmix", "module:Class", or the class of one.
        steps: environment steps per seed.
        seeds: the run's seeds.
        preset: "default", "fast" or "paper".
        settings: dotted names to values, as `--set` takes them: {"prior.kind": "none", "task.num_agents": 4}.
        device: "cpu", "cuda", or "auto" for the latter where there is one.
        out: the run folder; by default a new one in runs/.
        init_from: start from this policy (a run folder, a policy file or a bundled policy) where the shapes fit.
        listener: told of progress after every update; where it returns False the run stops, and `Run.train` goes on.
        track: names of trackers that get the metrics too: "tensorboard", "wandb", "mlflow".
        check: take a short look, of 2 s, at a task that is not built in; a note tells what it found.

    Raises:
        UserError: an unknown name, a value out of range, choices that do not go together, or a folder that is taken.
    """
    if settings is not None and not (isinstance(settings, Mapping) and all(isinstance(s, str) for s in settings)):
        raise UserError(f'settings are {settings!r}; give values by dotted name, as {{"task.num_agents": 4}}')
    named = (settings or {}).get("network.name")
    register_own(None, None, named if isinstance(named, str) else None)
    name, algorithm = register(task), ALGORITHMS.register(algo)
    if isinstance(seeds, Integral):
        raise UserError(f"seeds are the numbers of the seeds, not how many; write seeds=range({seeds})")
    numbers = tuple(seeds) if isinstance(seeds, Iterable) else (seeds,)
    if not all(isinstance(seed, Integral) for seed in numbers):
        raise UserError(f"seeds are whole numbers, not {seeds!r}; write for example seeds=range(10) or seeds=(3, 7)")
    if not isinstance(steps, Integral):
        raise UserError(f"steps are a whole number, not {steps!r}; write for example steps=100_000")
    asked = resolve_config(name, algorithm, preset, index(steps), numbers, resolve_device(device), settings)
    notes: list[str] = []
    config, weights = plan(asked, init_from, notes.append)
    require(track)
    run = begin(config, weights, out)
    with run.trainer(track, check) as trainer:
        trainer.notes[:0] = notes
        trainer.run(listener or (lambda _: True))
    return run
