"""Train on rewards a + b r and on r: what an offset a and a scale b change, as greedy return in the task's own units.

    python tests/benchmarks/reward_units.py [--steps 40000] [--seeds 4] [--cases PATTERN ...] [--jobs 2]
                                            [--json docs/measured/reward-units.json]

The rewards of the training worlds alone are changed, and evaluations see the task's own. A cell is told apart from
r where a two-sided Welch test of its seeds against those of r gives p < 0.05 / cells of its row (Bonferroni).
"""

import argparse
import json
import statistics
from concurrent.futures import ProcessPoolExecutor, as_completed
from fnmatch import fnmatch
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from types import MethodType
from typing import Any

from esp_cli import machine

machine.prepare()  # as `esp` does, before torch is imported

import torch
from rich.console import Console
from rich.table import Table
from scipy.stats import ttest_ind

from esp_cli.training.build import PolicyController, build_environment, build_learner, play
from esp_cli.training.config import resolve_config

ALGORITHMS = ("mappo", "maddpg", "qmix")
TASKS: dict[str, dict[str, object]] = {
    "navigation": {},
    "predator-prey": {},
    "formation": {"task.num_agents": 3, "task.horizon": 100},
}
UNITS = {"r": (0.0, 1.0), "r + 10": (10.0, 1.0), "r + 1000": (1e3, 1.0), "0.001 r": (0.0, 1e-3), "1e6 r": (0.0, 1e6)}
EPISODES = 256
"""Greedy episodes a seed at the end."""
THREADS = 1


def train(cell: tuple[str, str, str], steps: int, seeds: int) -> list[float]:
    """Train a cell (algorithm, task, unit), and return each seed's mean greedy return on the task's own rewards."""
    algorithm, task, unit = cell
    torch.set_num_threads(THREADS)
    offset, scale = UNITS[unit]
    overrides = {"prior.kind": "none"} | TASKS[task]
    config = resolve_config(task, algorithm, steps=steps, seeds=range(seeds), overrides=overrides)
    learner = build_learner(config)
    collector: Any = learner.collector
    collect = collector.collect

    def changed(_: object, *sizes: int) -> object:
        collected = collect(*sizes)
        (collected[0] if isinstance(collected, tuple) else collected).reward.mul_(scale).add_(offset)
        return collected

    collector.collect = MethodType(changed, collector)
    iterations = -(-steps // learner.steps_per_iteration)
    for number in range(iterations):
        learner.iterate(number / iterations)
    worlds = build_environment(config, EPISODES, "evaluation")
    return play(worlds, PolicyController(learner.policy)).returns.mean(-1).tolist()


def main() -> None:
    """Parse the command line, train, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--cases", nargs="+", default=["*"], metavar="PATTERN", help="as 'mappo navigation' or 'qmix*'")
    parser.add_argument("--jobs", type=int, default=1, help="trainings side by side, each with one thread")
    parser.add_argument("--json", type=Path, help="write every seed's return to this file, and go on from it")
    args = parser.parse_args()
    names = [f"{algorithm} {task}" for algorithm, task in product(ALGORITHMS, TASKS)]
    names = [name for name in names if any(fnmatch(name, pattern) for pattern in args.cases)]
    cells = [(algorithm, task, unit) for (algorithm, task), unit in product(map(str.split, names), UNITS)]
    size = {"steps": args.steps, "seeds": args.seeds, "episodes": EPISODES}
    document = json.loads(args.json.read_text()) if args.json and args.json.exists() else size | {"returns": {}}
    if {name: document[name] for name in size} != size:
        parser.error(f"{args.json} is of other steps or seeds")
    returns: dict[str, list[float]] = document["returns"]
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool:
        missing = {" ".join(cell): cell for cell in cells if " ".join(cell) not in returns}
        runs = {pool.submit(train, cell, args.steps, args.seeds): name for name, cell in missing.items()}
        for run in as_completed(runs):
            returns[runs[run]] = run.result()
            if args.json:
                args.json.write_text(json.dumps(document, indent=2, sort_keys=True) + "\n")
    table = Table("learner and task", *UNITS)
    for name in names:
        own, row = returns[f"{name} r"], []
        for unit in UNITS:
            found = returns[f"{name} {unit}"]
            apart = unit != "r" and ttest_ind(found, own, equal_var=False).pvalue < 0.05 / (len(UNITS) - 1)
            row.append(f"{statistics.fmean(found):.2f}{' !' if apart else ''}")
        table.add_row(name, *row)
    Console(width=110).print(table, "! told apart from r")


if __name__ == "__main__":
    main()
