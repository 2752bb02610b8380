"""Measure how fast the e-pucks are simulated: each physics engine alone, and the task formation with each.

    python tests/benchmarks/epuck_speed.py [--engine pymunk] [--worlds 320] [--threads 2] [--json speed.json]

A step of one world is one env step: 0.1 s of eight robots and two pillars. Alone, an engine gets random wheel speeds
that were drawn before, and every 300 steps all robots go back to their posts. Formation is played with random actions,
which count, as do resets, observations, states, rewards and metrics. Each figure is the median of several runs. Where
other programs use the machine too, the rate per second of processor time says more than the rate per second on the
clock, of one thread at least: threads that wait for work may use the processor too.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from env_speed import figures, show

from esp_envs import make
from esp_envs.epuck.engines import ENGINES, make_physics
from esp_envs.epuck.robot import MAX_WHEEL_SPEED, Arena

ARENA = Arena(side_m=2.0, num_robots=8, num_pillars=2, pillar_radius_m=0.1)
PERIOD_S = 0.1
EPISODE = 300


def of_physics(engine: str, worlds: int, threads: int) -> Callable[[], object]:
    """Return what takes one step of all worlds of an engine."""
    torch.set_num_threads(threads)
    rng = np.random.default_rng(0)
    robots = (worlds, ARENA.num_robots)
    wheels = MAX_WHEEL_SPEED * rng.uniform(-1, 1, (EPISODE, *robots, 2))
    heading = rng.uniform(-np.pi, np.pi, (*robots, 1))
    start = {
        "pose": np.concatenate([np.tile(ARENA.posts(), (worlds, 1, 1)), heading], -1),
        "velocity": np.zeros((*robots, 3)),
        "pillars": np.tile(ARENA.pillars(), (worlds, 1, 1)),
        "mass": np.ones(robots),
        "friction": np.ones(robots),
    }
    physics = make_physics(engine, ARENA, worlds, PERIOD_S)
    steps = itertools.cycle(range(EPISODE))

    def step() -> None:
        index = next(steps)
        if index == 0:
            physics.place(**start)
        physics.advance(wheels[index])

    return step


def of_formation(engine: str, worlds: int, threads: int) -> Callable[[], object]:
    torch.set_num_threads(threads)
    env = make("formation", worlds, [0], {"physics": engine})
    env.reset()
    return lambda: env.step(env.random_action())


SUBJECTS = {"physics": of_physics, "formation": of_formation}


def measure(
    engines: list[str], subjects: list[str], worlds: int, threads: list[int], seconds: float, runs: int
) -> list[dict[str, object]]:
    records: list[dict[str, object]] = []
    for subject, engine, count in itertools.product(subjects, engines, threads):
        found = figures(SUBJECTS[subject](engine, worlds, count), worlds, seconds, runs)
        records.append({"subject": subject, "engine": engine, "threads": count, **found})
    return records


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", action="append", choices=ENGINES, help="may be given several times")
    parser.add_argument("--subject", action="append", choices=tuple(SUBJECTS), help="may be given several times")
    parser.add_argument("--worlds", type=int, default=320)
    parser.add_argument("--threads", action="append", type=int, help="may be given several times; default: 1 and all")
    parser.add_argument("--seconds", type=float, default=2.0, help="length of one run")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--json", type=Path, help="also write the records to this file")
    args = parser.parse_args()
    threads = args.threads or sorted({1, os.cpu_count() or 1})
    engines, subjects = args.engine or list(ENGINES), args.subject or list(SUBJECTS)
    records = measure(engines, subjects, args.worlds, threads, args.seconds, args.runs)
    title = f"e-pucks, {args.worlds} worlds of {ARENA.num_robots} robots and {ARENA.num_pillars} pillars"
    show(records, title, ("subject", "engine", "threads"), "k")
    if args.json:
        args.json.write_text(json.dumps({"worlds": args.worlds, "runs": args.runs, "records": records}, indent=2))


if __name__ == "__main__":
    main()
