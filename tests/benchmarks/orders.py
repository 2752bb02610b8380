"""Networks over sets beside perceptrons, each with the prior and without it, tuned on equal steps.

    python tests/benchmarks/orders.py --out runs/orders [--agents 3 8 16=8] [--methods NAME ...] [--draws 5]
                                       [--jobs 2] [--json orders.json] [--tuned EARLIER.json]

For each number of agents every method trains the same settings, on three seeds and equal steps; the settings are
drawn once for all methods, and the first are those of the preset `fast`. The mean of the last two greedy evaluations
chooses. The chosen settings then train ten other seeds, whose final evaluation is the result. `16=8` judges 16 agents
with the settings chosen for 8; `--tuned` takes the trials that an earlier call wrote instead of training them again.
Called again with the same folder it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import fmean

import numpy as np
from rich.console import Console
from rich.table import Table

from esp_cli.run import Run
from esp_cli.training.metrics import column, read_metrics

_PERCEPTRON = "--network mlp"
_SETS = "--set mappo.critic_input=state --network"
METHODS = {
    "perceptron": f"{_PERCEPTRON} --prior none",
    "perceptron, ESP": f"{_PERCEPTRON} --prior esp --transforms d4",
    "perceptron, ESP and orders of agents": f"{_PERCEPTRON} --prior esp --transforms d4*agents",
    "sets": f"{_SETS} set --prior none",
    "sets, ESP": f"{_SETS} set --prior esp --transforms d4",
    "equivariant sets": f"{_SETS} set-equivariant --prior none",
}
SPACE: Mapping[str, tuple[object, ...]] = {
    "mappo.learning_rate": (1e-3, 2e-3, 4e-3, 8e-3),
    "mappo.entropy_coef": (0.001, 0.003, 0.01, 0.03),
    "mappo.gamma": (0.9, 0.95, 0.98, 0.99),
    "mappo.gae_lambda": (0.8, 0.9, 0.95),
    "mappo.num_epochs": (3, 5, 8),
    "mappo.num_minibatches": (2, 5, 10),
    "mappo.num_envs": (64, 128),
}
OF_PRIOR: Mapping[str, tuple[object, ...]] = {"prior.consistency_coef": (0.03, 0.1, 0.3, 1.0)}
TRIAL_SEEDS, SEEDS = "100,101,102", "0,1,2,3,4,5,6,7,8,9"
EPISODES = 64
"""Per seed, of a final evaluation."""
STEPS = {3: (60_000, 200_000), 8: (40_000, 100_000), 16: (0, 40_000)}
"""By number of agents the environment steps per seed of a trial, and of the ten seeds that judge."""


def draws(count: int) -> Iterator[dict[str, object]]:
    """Yield settings to try: those of the preset, then the same sequence for every method."""
    generator = random.Random(0)
    yield {}
    for _ in range(count - 1):
        yield {name: generator.choice(values) for name, values in (SPACE | OF_PRIOR).items()}


def words_of(method: str, agents: int, steps: int, seeds: str, chosen: Mapping[str, object]) -> list[str]:
    """Return the words behind `esp train` of a run; settings of the prior are left out where there is none."""
    idle = () if "esp" in METHODS[method] else OF_PRIOR
    settings = {f"task.num_agents={agents}", "network.compiled=true"}
    settings |= {f"{name}={value}" for name, value in chosen.items() if name not in idle}
    words = ["--task", "navigation", "--preset", "fast", *METHODS[method].split()]
    words += ["--steps", str(steps), "--seed-list", seeds]
    return [*words, *(word for setting in sorted(settings) for word in ("--set", setting))]


def trained(folder: Path, words: Sequence[str]) -> Path:
    """Train what is missing of a run in a process of its own, and return its folder."""
    if not (folder / "policy.safetensors").exists():
        words = ["--resume", str(folder)] if (folder / "config.json").exists() else [*words, "--out", str(folder)]
        command = [sys.executable, "-m", "esp_cli", "train", *words]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=os.environ | {"OMP_NUM_THREADS": "1"}
        )
        if done.returncode:
            raise RuntimeError(f"{folder}: {done.stderr or done.stdout}")
    return folder


def score(folder: Path) -> float:
    """Return the mean of the last two greedy evaluations over all seeds, -inf where one of them is not finite."""
    _, returns = column(read_metrics(folder / "metrics.jsonl"), "eval/return_greedy")
    return float(np.nan_to_num(returns[-2:], nan=-np.inf).mean())


def judged(folder: Path) -> dict[str, object]:
    """Return the final evaluation of a run by seed: greedy returns, the same normalised, and metrics; and anchors."""
    found = Run(folder).evaluate(EPISODES).model_dump(mode="json")
    greedy, anchors = found["greedy"]["per_seed"], found["anchors"]
    low, high = anchors["random"], anchors["heuristic"]
    scores = [(value - low) / (high - low) for value in greedy]
    return {"greedy": greedy, "normalised": scores, "anchors": anchors, "metrics": found["metrics_per_seed"]}


Trials = dict[tuple[str, int], list[float]]
"""Scores of the draws by method and number of agents."""


def trials_on_file(path: Path | None, count: int) -> Trials:
    """Return the trials that an earlier call wrote; refused where it drew other settings or trained other steps."""
    if path is None:
        return {}
    document = json.loads(path.read_text())
    found: Trials = {(one["method"], one["tuned at"]): one["trials"] for one in document["cells"]}
    if document["draws"] != list(draws(count)) or any(document["steps"][str(n)][0] != STEPS[n][0] for _, n in found):
        raise SystemExit(f"{path}: its trials had other settings or steps; give the same --draws.")
    return found


def cell(out: Path, method: str, agents: int, tuned_at: int, count: int, known: Trials) -> dict[str, object]:
    """Tune a method where its trials are not known, train the seeds that judge it, and return what is on record."""
    slug = method.replace(", ", "-").replace(" ", "-")
    tried = list(draws(count))
    scores = list(known.get((method, tuned_at), ()))
    for number, chosen in list(enumerate(tried))[len(scores) :]:
        folder = out / "trials" / f"{tuned_at}-{slug}-{number}"
        scores.append(score(trained(folder, words_of(method, tuned_at, STEPS[tuned_at][0], TRIAL_SEEDS, chosen))))
        print(f"{folder.name}: {scores[-1]:.1f}", flush=True)
    best = max(range(count), key=scores.__getitem__)
    words = words_of(method, agents, STEPS[agents][1], SEEDS, tried[best])
    found = judged(trained(out / "judged" / f"{agents}-{slug}", words))
    print(f"{agents} {method}: draw {best}, {fmean(found['greedy']):.1f}", flush=True)
    tuning = {"trials": scores, "draw": best, "tuned at": tuned_at}
    return {"agents": agents, "method": method, "words": words} | tuning | found


def main() -> None:
    """Tune and judge every method, print the table and write it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/orders"))
    parser.add_argument("--agents", nargs="+", default=["3", "8", "16=8"], metavar="N", help="16=8: tuned with 8")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS), metavar="METHOD")
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=2, help="trainings side by side, each with one thread")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tuned", type=Path, metavar="FILE", help="JSON of an earlier call, whose trials stand")
    args = parser.parse_args()
    known = trials_on_file(args.tuned, args.draws)
    pairs = [tuple(map(int, text.split("=") if "=" in text else (text, text))) for text in args.agents]
    with ThreadPoolExecutor(args.jobs) as pool:
        asked = [pool.submit(cell, args.out, m, n, at, args.draws, known) for n, at in pairs for m in args.methods]
        cells = [one.result() for one in asked]
    table = Table("agents", "method", "return", "normalised", "worst seed", "draw")
    for one in cells:
        scores = one["normalised"]
        numbers = (f"{fmean(one['greedy']):.1f}", f"{fmean(scores):.2f}", f"{min(scores):.2f}", str(one["draw"]))
        table.add_row(str(one["agents"]), one["method"], *numbers)
    Console(width=110).print(table)
    if args.json:
        document = {"draws": list(draws(args.draws)), "steps": STEPS, "cells": cells}
        args.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
