"""Measure what foreign environments cost behind the adapters.

PettingZoo: mpe2's simple_spread_v3, 32 copies, in this process and in worker processes. VMAS: a scenario's own steps/s,
and the task's, with 512 worlds. Rounds alternate, and each ratio is the median over rounds.

    python tests/benchmarks/adapter_speed.py
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "environments")]

import torch

from esp_envs import Environment, make, register
from tests.own_tasks import save_page_files

COPIES, WORLDS = 32, 512
SCENARIOS = ("Navigation", "Transport", "Balance", "Dispersion")


def rate(play: Callable[[], None], steps: int, worlds: int) -> float:
    """Return environment steps per second of one round."""
    begun = time.perf_counter()
    for _ in range(steps):
        play()
    return steps * worlds / (time.perf_counter() - begun)


def rates(plays: dict[str, Callable[[], None]], steps: int, worlds: int, rounds: int) -> dict[str, list[float]]:
    """Return each rate by round; rounds alternate, so that all meet the same machine."""
    found: dict[str, list[float]] = {name: [] for name in plays}
    for name in [name for _ in range(rounds) for name in plays]:
        found[name].append(rate(plays[name], steps, worlds))
    return found


def ratio(over: list[float], under: list[float]) -> float:
    """Return the median over rounds of one rate over the other."""
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def stepping(env: Environment) -> Callable[[], None]:
    env.reset()

    def play() -> None:
        env.step(env.random_action())

    play()
    return play


def copies(rounds: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        save_page_files(Path(folder))
        name = register("spread:Spread")
        counts = (0, 2) if len(os.sched_getaffinity(0)) < 4 else (0, 2, 4)
        plays = {f"{n} workers": stepping(make(name, COPIES, [0], {"workers": n})) for n in counts}
        found = rates(plays, 100, COPIES, rounds)
        for what, own in found.items():
            gain = ratio(own, found["0 workers"])
            print(f"simple_spread_v3, {COPIES} copies, {what}: {statistics.median(own):7.0f} steps/s, x {gain:.2f}")
        os.chdir(ROOT)


def scenarios(rounds: int) -> None:
    import vmas

    for name in SCENARIOS:
        task = make(register(f"esp_envs.adapters.vmas_scenarios:{name}"), WORLDS, [0])
        theirs = vmas.make_env(task.scenario, WORLDS, seed=0, **task.arguments())
        theirs.reset()
        count = 0

        def alone(theirs: object = theirs, horizon: int = task.spec.horizon) -> None:
            nonlocal count
            force = torch.rand(WORLDS, theirs.n_agents, 2) * 2 - 1
            done = theirs.step(list(force.unbind(1)))[2]
            count += 1
            if count % horizon == 0:
                theirs.reset()
            else:
                for world in done.nonzero().flatten().tolist():
                    theirs.reset_at(world)

        found = rates({"alone": alone, "task": stepping(task)}, 100, WORLDS, rounds)
        plain, ours = (statistics.median(own) for own in found.values())
        overhead = ratio(found["alone"], found["task"]) - 1
        print(f"vmas {name}, {WORLDS} worlds: {plain:7.0f} alone, {ours:7.0f} as a task, {overhead:+.0%}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=11)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    copies(asked.rounds)
    scenarios(asked.rounds)
