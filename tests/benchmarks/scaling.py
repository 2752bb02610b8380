"""Measure how the speed of training grows with seeds, agents, worlds and processes, and draw one figure of each.

    python tests/benchmarks/scaling.py [--json docs/measured/scaling.json] [--figure docs/measured/scaling.png]

MAPPO on navigation. Seeds: the default, with the prior. Agents: a network over sets, which sees the nearest eight of
each kind from 16 agents on, about 1,000 agents in all worlds together. Worlds: the layout of `make bench`, plain.
Processes: of ten seeds each, side by side, of one thread or two. Each figure is the median of several iterations.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.train_speed import PEER_LAYOUT, PLAIN, SET, timed  # isort: skip - prepares the machine

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

SEEDS = (1, 3, 10, 30, 100, 300)
AGENTS = (3, 8, 16, 30, 100, 300, 1000)
WORLDS = (8, 32, 128, 512, 2048)
WORKERS = tuple((processes, threads) for threads in (1, 2) for processes in (1, 2, 4))
ITERATIONS = 5
BESIDE = Path(__file__).with_name("train_speed.py")


def rate(overrides: dict[str, object], seeds: int = 1) -> float:
    """Return the median of a learner's seed-steps a second."""
    return statistics.median(timed("mappo", overrides, seeds, ITERATIONS, "cpu")[1])


def crowd(agents: int) -> dict[str, object]:
    near = {"task.sees": 8, "task.density": 8, "mappo.critic_input": "own"} if agents > 8 else {}
    return SET | near | {"task.num_agents": agents, "mappo.num_envs": max(1, 1000 // agents)}


def side_by_side(processes: int, threads: int) -> float:
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / str(k) for k in range(processes)]
        command = [sys.executable, str(BESIDE), "--cases", "mappo default, esp", "--seeds", "10", "--iterations", "25"]
        command += ["--threads", str(threads), "--json"]
        environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
        quiet = subprocess.DEVNULL
        running = [subprocess.Popen([*command, str(file)], env=environment, stdout=quiet) for file in files]
        failed = [process.wait() for process in running]
        if any(failed):
            raise RuntimeError(f"train_speed.py ends with {failed}")
        return sum(json.loads(file.read_text())["records"][0]["seed_steps_per_second"] for file in files)


def drawn(found: dict[str, dict[str, float]]) -> Figure:
    figure = Figure(figsize=(13, 3), layout="constrained")
    for axes, (title, rates) in zip(figure.subplots(1, 4), found.items(), strict=True):
        counts = all(name.isdecimal() for name in rates)
        places = [float(name) for name in rates] if counts else list(range(len(rates)))
        if counts:
            axes.plot(places, list(rates.values()), marker="o", color="#0072B2")
            axes.set_xscale("log")
        else:
            axes.bar(places, list(rates.values()), color="#0072B2")
        axes.set_xticks(places, list(rates), rotation=0 if counts else 30)
        axes.minorticks_off()
        axes.set(title=title, ylabel="agent-steps/s" if title == "agents" else "seed-steps/s", ylim=(0, None))
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(color="#E5E5E5")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def main() -> None:
    """Measure, print, and write what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    found = {
        "seeds": {str(n): rate({}, n) for n in SEEDS},
        "agents": {str(n): n * rate(crowd(n)) for n in AGENTS},
        "worlds": {str(n): rate(PEER_LAYOUT | PLAIN | {"mappo.num_envs": n}) for n in WORLDS},
        "processes x threads": {f"{p} x {t}": side_by_side(p, t) for p, t in WORKERS},
    }
    for title, rates in found.items():
        print(title, {name: round(value) for name, value in rates.items()})
    if options.json:
        options.json.write_text(json.dumps({"threads": torch.get_num_threads(), "rates": found}, indent=1) + "\n")
    if options.figure:
        drawn(found).savefig(options.figure, dpi=110)


if __name__ == "__main__":
    main()
