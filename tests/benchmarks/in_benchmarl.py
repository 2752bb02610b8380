"""BenchMARL's MAPPO on a VMAS scenario, with the prior and without, under BenchMARL's own settings.

python tests/benchmarks/in_benchmarl.py navigation --frames 60000 --seeds 0 1 2 --out runs/benchmarl

Writes one JSON file, and goes on from it when started again: mean returns of training episodes by frames and seconds
of training, for each seed and learner. Prints their means over seeds.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

warnings.simplefilter("ignore")

from benchmarl.algorithms import MappoConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from esp_cli import Continuous, Field, Kind, Layout, Symmetry, layout
from esp_cli.loop.benchmarl import SymmetryCallback


@dataclass(frozen=True)
class Scenario:
    """One VMAS scenario of BenchMARL: what an agent sees, and how many agents there are."""

    task: VmasTask
    num_agents: int
    seen: Layout


OWN = (Field("position", Kind.VECTOR), Field("velocity", Kind.VECTOR))
PIECE = (Field("offset", Kind.VECTOR), Field("eaten", Kind.SCALAR))
SCENARIOS = {
    "navigation": Scenario(
        VmasTask.NAVIGATION, 3, layout(*OWN, Field("from goal", Kind.VECTOR), Field("lidar", Kind.RING, rays=12))
    ),
    "dispersion": Scenario(VmasTask.DISPERSION, 4, layout(*OWN, Field("food", Kind.RECORD, 4, parts=PIECE))),
}
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
Row = tuple[int, float, float]


class Record(Callback):
    """Keeps the mean return of training episodes and the seconds of training after every collection."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[Row] = []
        self.trained_s, self.since = 0.0, 0.0

    def on_batch_collected(self, batch: Any) -> None:
        ended = batch["next", "done"].squeeze(-1)
        returns = batch["next", "agents", "episode_reward"][ended].mean().item()
        self.rows.append((self.experiment.total_frames, returns, self.trained_s))
        self.since = time.perf_counter()

    def on_train_end(self, training_td: Any, group: str) -> None:
        self.trained_s += time.perf_counter() - self.since


def run(scenario: Scenario, seed: int, frames: int, callbacks: list[Callback], folder: Path) -> list[Row]:
    """Train once and return (frames, mean return of training episodes, seconds of training) rows."""
    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    config.max_n_frames, config.save_folder = frames, str(folder)
    record = Record()
    task, algorithm = scenario.task.get_from_yaml(), MappoConfig.get_from_yaml()
    model, critic = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
    Experiment(task, algorithm, model, seed, config, critic, [record, *callbacks]).run()
    return record.rows


def main() -> None:
    """Run both learners for each seed, write what came out, and print the means over seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenario", choices=SCENARIOS)
    parser.add_argument("--frames", type=int, default=60_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--coefficient", type=float, default=0.1)
    parser.add_argument("--out", type=Path, default=Path("runs/benchmarl"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    given.out.mkdir(parents=True, exist_ok=True)
    file, scenario = given.out / f"{given.scenario}.json", SCENARIOS[given.scenario]
    results: dict[str, dict[str, list[Row]]] = (
        json.loads(file.read_text()) if file.exists() else {"plain": {}, "esp": {}}
    )
    for seed in given.seeds:
        for name, by_seed in results.items():
            if str(seed) in by_seed:
                continue
            symmetry = Symmetry(
                observation=scenario.seen, action=FORCE, group="d4", num_agents=scenario.num_agents, seed=seed
            )
            callbacks = [SymmetryCallback(symmetry, given.coefficient)] if name == "esp" else []
            by_seed[str(seed)] = run(scenario, seed, given.frames, callbacks, given.out)
            file.write_text(json.dumps(results))
    print(f"{'frames':>8} {'plain':>16} {'esp':>16}   mean and standard error over {len(given.seeds)} seeds")
    curves = {name: np.array([by_seed[str(seed)] for seed in given.seeds]) for name, by_seed in results.items()}
    for row, frames in enumerate(curves["plain"][0, :, 0]):
        ends = [curve[:, row, 1] for curve in curves.values()]
        cells = [f"{end.mean():8.3f} +- {end.std(ddof=1) / len(end) ** 0.5:.3f}" for end in ends]
        print(f"{frames:8.0f} " + " ".join(f"{cell:>16}" for cell in cells))


if __name__ == "__main__":
    main()
