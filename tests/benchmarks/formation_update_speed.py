"""Measure where the time of MAPPO-ESP on formation change goes: physics, the rest of the task, acting, learning.

python tests/benchmarks/formation_update_speed.py [--threads 2] [--updates 6]
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from typing import Any

from esp_cli import machine

machine.prepare()  # as `esp` does, before torch is imported

import torch
from rich.console import Console
from rich.table import Table

from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config


def timed(spent: Counter[str], owner: Any, method: str, label: str) -> None:
    """Add the seconds of every call of `owner.method` to `spent[label]`."""
    function = getattr(owner, method)

    def call(*args: Any, **named: Any) -> Any:
        begin = time.perf_counter()
        result = function(*args, **named)
        spent[label] += time.perf_counter() - begin
        return result

    setattr(owner, method, call)


def main() -> None:
    """Parse the command line, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--updates", type=int, default=6)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    learner: Any = build_learner(resolve_config("formation", "mappo"))
    spent: Counter[str] = Counter()
    timed(spent, learner.collector, "collect", "rollout")
    timed(spent, learner.collector.env, "step", "task")
    timed(spent, learner.collector.env.physics, "advance", "physics")
    learner.iterate(0.0)
    spent.clear()
    begin = time.perf_counter()
    for _ in range(args.updates):
        learner.iterate(0.0)
    total = time.perf_counter() - begin
    shares = {
        "physics": spent["physics"],
        "the rest of the task": spent["task"] - spent["physics"],
        "acting": spent["rollout"] - spent["task"],
        "learning": total - spent["rollout"],
    }
    rate = args.updates * learner.steps_per_iteration / total
    table = Table("part", "share", title=f"MAPPO-ESP on formation, one seed: {rate:,.0f} env steps/s")
    for part, seconds in shares.items():
        table.add_row(part, f"{seconds / total:.0%}")
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
