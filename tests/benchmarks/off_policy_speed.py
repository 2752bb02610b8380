"""Measure how fast MADDPG and QMIX train at one gradient step on 32 episodes per collected episode.

    python tests/benchmarks/off_policy_speed.py [--seeds 10] [--threads 1] [--device cuda] [--json speed.json]

A seed-step is one environment step of one seed. Each figure is the median of several iterations (eight episodes and
eight gradient steps) after a warm-up, by the clock; beside it stands the most per second of processor time, which other
programs on the machine disturb less.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

from esp_cli import machine

machine.prepare()  # as `esp` does, before torch is imported

import torch
from rich.console import Console
from rich.table import Table

from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config

CASES: dict[str, tuple[str, dict[str, object]]] = {
    "maddpg, plain": ("maddpg", {"prior.kind": "none"}),
    "maddpg, esp": ("maddpg", {}),
    "qmix, plain": ("qmix", {"prior.kind": "none"}),
    "qmix, esp": ("qmix", {}),
    "qmix gru, plain": ("qmix", {"prior.kind": "none", "network.name": "gru"}),
    "qmix gru, esp": ("qmix", {"network.name": "gru"}),
}


def measure(name: str, seeds: int, iterations: int, device: str) -> dict[str, object]:
    """Time `iterations` iterations of one case."""
    algorithm, overrides = CASES[name]
    config = resolve_config("navigation", algorithm, seeds=range(seeds), overrides=overrides, device=device)
    learner = build_learner(config)
    for _ in range(2):
        learner.iterate(0.0).finite.tolist()
    clock, processor = [], []
    for _ in range(iterations):
        begin, spent = time.perf_counter(), time.process_time()
        learner.iterate(0.0).finite.tolist()  # until a GPU has computed it
        clock.append(time.perf_counter() - begin)
        processor.append(time.process_time() - spent)
    steps = seeds * learner.steps_per_iteration
    return {
        "case": name,
        "seeds": seeds,
        "seed_steps_per_second": steps / statistics.median(clock),
        "most_per_processor_second": steps / min(processor),
    }


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", choices=list(CASES), help="what to measure; by default all")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--iterations", type=int, default=5)
    parser.add_argument("--json", type=Path, help="also write the records to this file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    where = f"{args.threads} thread(s)" if args.device == "cpu" else args.device
    table = Table(title=f"Off-policy learners on navigation, {args.seeds} seed(s), {where}")
    for heading in ("case", "seed-steps/s (median)", "most per processor second"):
        table.add_column(heading, justify="left" if heading == "case" else "right")
    records = [measure(name, args.seeds, args.iterations, args.device) for name in args.case or CASES]
    for record in records:
        numbers = (record["seed_steps_per_second"], record["most_per_processor_second"])
        table.add_row(str(record["case"]), *(f"{float(str(number)):,.0f}" for number in numbers))
    Console(width=100).print(table)
    if args.json:
        content = {"device": args.device, "threads": args.threads, "records": records}
        args.json.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
