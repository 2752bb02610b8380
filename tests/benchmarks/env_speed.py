"""Measure how fast the environments run alone, with random actions and resets.

    python tests/benchmarks/env_speed.py [--task navigation] [--worlds 1024] [--seconds 1.0] [--json speed.json]

Drawing the random actions, resets, observations, states, rewards and metrics all count. A step of one world is one env
step, whatever the number of agents. Each figure is the median of several runs on `--threads` threads. Where other
programs use the machine too, the rate per second of processor time says more than the rate per second on the clock.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from esp_envs import Environment, make, task_class

DEFAULT_TASKS = ("navigation", "predator-prey", "wildlife")
DEFAULT_WORLDS = (1024, 4096)


def figures(play: Callable[[], object], steps: int, seconds: float, runs: int) -> dict[str, float]:
    """Return median, least and most env steps per second, and the median rate per second of this process's time.

    Each run goes on where the last one stopped, until `seconds` have gone by; `play` takes so many env steps.
    """

    def rates(seconds: float) -> tuple[float, float]:
        count, begin, worked = 0, time.perf_counter(), time.process_time()
        while (elapsed := time.perf_counter() - begin) < seconds:
            play()
            count += steps
        return count / elapsed, count / (time.process_time() - worked)

    rates(min(seconds, 0.3))
    on_clock, of_processor = zip(*(rates(seconds) for _ in range(runs)), strict=True)
    found = {"steps_per_second": statistics.median(on_clock), "least": min(on_clock), "most": max(on_clock)}
    return found | {"steps_per_cpu_second": statistics.median(of_processor)}


def play_episode(env: Environment) -> None:
    for _ in range(env.spec.horizon):
        env.step(env.random_action())
    if env.device.type == "cuda":
        torch.cuda.synchronize()


def measure(
    tasks: list[str], worlds: list[int], settings: dict[str, object], device: str, seconds: float, runs: int
) -> list[dict[str, object]]:
    records: list[dict[str, object]] = []
    for task in tasks:
        for count in worlds:
            known = task_class(task).Settings.model_fields
            own = {name: value for name, value in settings.items() if name in known}
            env = make(task, count, [0], own, device)
            env.reset()
            found = figures(partial(play_episode, env), env.spec.horizon * count, seconds, runs)
            records.append({"task": task, "worlds": count, **found, "runs": runs})
    return records


def show(records: list[dict[str, object]], title: str, names: Sequence[str], unit: str) -> None:
    """Print the records as a table: what was measured by its names, rates in units of "k" or "M"."""
    table = Table(*names, "env steps/s (median)", "range", "per CPU second", title=title)
    for record in records:
        rates = (record[name] for name in ("steps_per_second", "least", "most", "steps_per_cpu_second"))
        shown = (float(str(rate)) / 1e3 if unit == "k" else float(str(rate)) / 1e6 for rate in rates)
        median, low, high, processor = (f"{rate:.{1 if unit == 'k' else 2}f}" for rate in shown)
        what = (str(record[name]) for name in names)
        table.add_row(*what, f"{median} {unit}", f"{low} to {high} {unit}", f"{processor} {unit}")
    Console().print(table)


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", action="append", help="task to measure; may be given several times")
    parser.add_argument("--worlds", action="append", type=int, help="number of worlds; may be given several times")
    parser.add_argument("--actions", choices=("discrete", "continuous"), default="discrete")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=1.0, help="length of one run")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json", type=Path, help="also write the records to this file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    settings: dict[str, object] = {"actions": args.actions}
    tasks, worlds = args.task or list(DEFAULT_TASKS), args.worlds or list(DEFAULT_WORLDS)
    records = measure(tasks, worlds, settings, args.device, args.seconds, args.runs)
    where = f"{args.device}, {args.threads} thread{'s' if args.threads > 1 else ''}, {args.actions} actions"
    show(records, f"environments alone ({where})", ("task", "worlds"), "M")
    if args.json:
        args.json.write_text(json.dumps({"device": args.device, "threads": args.threads, "records": records}, indent=2))


if __name__ == "__main__":
    main()
