"""BenchMARL's MAPPO on PettingZoo's simple_spread, with BenchMARL's own settings and 25 steps an episode.

The packages need an environment of their own:

    python3 -m venv peers && peers/bin/pip install torch==2.13.0
    peers/bin/pip install --no-deps benchmarl==1.5.2
    peers/bin/pip install torch==2.13.0 torchrl==0.11.1 tensordict==0.11.0 "pettingzoo[mpe]==1.24.3" gymnasium==1.2.0 \
        hydra-core tqdm pyyaml
    peers/bin/python tests/benchmarks/peers/benchmarl_spread.py --frames 300000 --seeds 0 --json spread.json

The same task and the same convention here, and what the file holds: spread.py. Goes on where it was when started again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import torch
from spread import Row, add_missing, summarise

warnings.simplefilter("ignore")

from benchmarl.algorithms import MappoConfig
from benchmarl.environments import PettingZooTask
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig


class Record(Callback):
    """Keeps frames, seconds and the mean return of the training episodes after every collection."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.rows = time.perf_counter(), list[Row]()

    def on_batch_collected(self, batch: Any) -> None:
        """Read the returns of the episodes that ended."""
        ended = batch["next", "done"].squeeze(-1)
        returns = batch["next", "agent", "episode_reward"][ended].mean().item()
        self.rows.append((self.experiment.total_frames, time.perf_counter() - self.begun, returns))


def run(seed: int, frames: int) -> list[Row]:
    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    config.prefer_continuous_actions, config.max_n_frames = False, frames
    task = PettingZooTask.SIMPLE_SPREAD.get_from_yaml()
    task.config["max_cycles"] = 25
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        record = Record()
        model, critic = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
        Experiment(task, MappoConfig.get_from_yaml(), model, seed, config, critic, [record]).run()
    return record.rows


def main() -> None:
    """Run the seeds that are missing in the file, and print how each run ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--json", type=Path, default=Path("spread.json"))
    given = parser.parse_args()
    add_missing(given.json, {f"BenchMARL, seed {seed}": partial(run, seed, given.frames) for seed in given.seeds})
    summarise(given.json)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
