"""BenchMARL's MAPPO on VMAS navigation, with the prior and without, under BenchMARL's own settings.

python tests/benchmarks/benchmarl_navigation.py --frames 300000 --seeds 0 1 2 --out runs/benchmarl

Writes one JSON file: mean returns of training episodes by frames and seconds of training, for each seed and learner.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

import torch

warnings.simplefilter("ignore")

from benchmarl.algorithms import MappoConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from esp_cli import Continuous, Field, Kind, Symmetry, layout
from esp_cli.loop.benchmarl import SymmetryCallback

SEEN = layout(
    Field("position", Kind.VECTOR),
    Field("velocity", Kind.VECTOR),
    Field("from goal", Kind.VECTOR),
    Field("lidar", Kind.RING, rays=12),
)
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))


class Record(Callback):
    """Keeps the mean return of training episodes and the seconds of training after every collection."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, float]] = []
        self.trained_s, self.since = 0.0, 0.0

    def on_batch_collected(self, batch: Any) -> None:
        """Read the returns of the episodes that ended."""
        ended = batch["next", "done"].squeeze(-1)
        returns = batch["next", "agents", "episode_reward"][ended].mean().item()
        self.rows.append((self.experiment.total_frames, returns, self.trained_s))
        self.since = time.perf_counter()

    def on_train_end(self, training_td: Any, group: str) -> None:
        """Add the time of the update."""
        self.trained_s += time.perf_counter() - self.since


def run(seed: int, frames: int, callbacks: list[Callback], folder: Path) -> list[tuple[int, float, float]]:
    """Train once and return (frames, mean return of training episodes, seconds of training) rows."""
    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    config.max_n_frames, config.save_folder = frames, str(folder)
    record = Record()
    task, algorithm = VmasTask.NAVIGATION.get_from_yaml(), MappoConfig.get_from_yaml()
    model, critic = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
    Experiment(task, algorithm, model, seed, config, critic, [record, *callbacks]).run()
    return record.rows


def main() -> None:
    """Run both learners for each seed and write what came out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=300_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--coefficient", type=float, default=0.1)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarl"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, dict[int, list[tuple[int, float, float]]]] = {"plain": {}, "esp": {}}
    for seed in given.seeds:
        for name, by_seed in results.items():
            symmetry = Symmetry(observation=SEEN, action=FORCE, group="d4", num_agents=3, seed=seed)
            callbacks = [SymmetryCallback(symmetry, given.coefficient)] if name == "esp" else []
            by_seed[seed] = run(seed, given.frames, callbacks, given.out)
            (given.out / "results.json").write_text(json.dumps(results))


if __name__ == "__main__":
    main()
