"""Measure what checks of symmetry find: in tasks made at random from transitions alone, and in the built-in tasks.

    python tests/benchmarks/discovery.py --random 200 --json docs/measured/discovery-random.json
    python tests/benchmarks/discovery.py [--only navigation] [--logs]

With --random it counts broken elements that are said to hold, and symmetric ones that are not; what is off by less than
the tolerance counts as neither. The built-in tasks declare nothing here. Without --logs states are set where a task can
be; with it, transitions of the random policy are all there is.
"""

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli import machine

if __name__ == "__main__":
    machine.prepare()  # as `esp` does, before torch is imported

from esp_cli.checking import candidates, check_symmetry, check_transitions, collect
from esp_cli.checking.transitions import TOLERATED
from esp_cli.checking.verdicts import LEVEL
from esp_envs import Environment, make
from tests.benchmarks.synthetic import Recipe, broken_by

Settings = Mapping[str, object]
FORCES: Settings = {"actions": "continuous"}
DRONES: Settings = {"width": 5, "height": 5, "horizon": 30}
CASES: Sequence[tuple[str, Settings, str]] = (
    ("navigation", {}, "d4*agents*landmarks-3"),
    ("navigation", FORCES, "o2*agents*landmarks-3"),
    ("navigation", {"wind": 0.3}, "flip-x*agents*landmarks-3"),
    ("navigation", {"mud": 0.5}, "flip-x*agents*landmarks-3"),
    ("navigation", {"action_turn_rad": 0.5}, "c4*agents*landmarks-3"),
    ("navigation", {"action_turn_rad": 0.5, **FORCES}, "so2*agents*landmarks-3"),
    ("navigation", {"reward_offset": 0.3}, "flip-x*agents*landmarks-3"),
    ("navigation", {"wind": 0.3, "action_turn_rad": 0.5, "num_agents": 1, "num_landmarks": 1}, "c1"),
    ("predator-prey", {}, "d4*agents*obstacles-2"),
    ("predator-prey", {"wind": 0.3}, "flip-x*agents*obstacles-2"),
    ("predator-prey", {"action_turn_rad": 0.5}, "c4*agents*obstacles-2"),
    ("wildlife", DRONES, "d4*agents"),
    ("wildlife", {"wind": 0.8, **DRONES}, "flip-x*agents"),
)
"""Task, settings, and what is there."""
EPISODES = 2048
MOST = 5
"""Turns and mirrors of a random task that are looked at, drawn from its seed, beside an exchange of each kind."""
SYMMETRIC = 1e-3
"""Gap below which an element is symmetric: what rounding leaves."""


def found(task: str, settings: Settings, logs: bool) -> str:
    """Return the group that is found in a task whose declaration is taken away."""

    def worlds(num_envs: int, seeds: Sequence[int]) -> Environment:
        env = make(task, num_envs, seeds, settings)
        env.spec = replace(env.spec, symmetry="c1", nearly="")
        return env

    return check_symmetry(worlds, from_transitions=logs).found


def of_random_task(seed: int) -> dict[str, Any]:
    """Return what is said of each element of a random task, beside by how much it is off."""
    recipe, begun = Recipe.drawn(seed), time.process_time()
    env = recipe.make(EPISODES, [0])
    elements = candidates(env.spec)
    planar = [element for element in elements if not element.orders]
    drawn = np.random.default_rng(seed).permutation(len(planar))[:MOST]
    exchanges = {element.orders[0][0]: element for element in reversed(elements) if element.orders}
    elements = [*(planar[k] for k in sorted(drawn)), *exchanges.values()]
    verdicts = check_transitions(env.spec, collect(env, EPISODES), elements)
    seconds = time.process_time() - begun
    families = {name: getattr(recipe, name) for name in ("reward", "force", "noise", "tails", "start", "listed")}
    found = {
        verdict.element: {
            "off": gap if gap < math.inf else "never seen",
            "outcome": verdict.outcome,
            "p": float(f"{verdict.p_value:.2g}"),
            "field": verdict.worst.field if verdict.worst else verdict.reason,
        }
        for verdict, gap in zip(verdicts, broken_by(recipe, elements), strict=True)
        if not math.isnan(gap)
    }
    sizes = {"seed": seed, "agents": recipe.agents, "marks": recipe.marks}
    return sizes | families | {"seconds": round(seconds, 1), "elements": found}


def counted(tasks: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Count what was said falsely of random tasks."""
    broken, symmetric = list[tuple[int, str, str]](), list[tuple[int, str, str]]()
    for task in tasks:
        for name, found in task["elements"].items():
            entry = (task["seed"], name, found["outcome"])
            if found["off"] == "never seen":
                continue  # its images lie where no transition does, so that nothing could say that it holds
            if found["off"] >= TOLERATED:
                broken.append(entry)
            elif found["off"] < SYMMETRIC:
                symmetric.append(entry)
    false = [entry[:2] for entry in broken if entry[2] == "holds"]
    missed = [entry[:2] for entry in symmetric if entry[2] != "holds"]
    accused = [entry[:2] for entry in symmetric if entry[2] == "broken"]
    rewards = {task["seed"]: task["reward"] for task in tasks}
    accepted = len(false) + len(symmetric) - len(missed)
    return {
        "tasks": len(tasks),
        "families": {name: len({task[name] for task in tasks}) for name in ("reward", "force", "noise")},
        "episodes": EPISODES,
        "tolerance": TOLERATED,
        "level": LEVEL,
        "broken": len(broken),
        "false acceptances": len(false),
        "share of broken ones that are accepted": len(false) / max(1, len(broken)),
        "share of accepted ones that are broken": len(false) / max(1, accepted),
        "tasks with a false acceptance": len({seed for seed, _ in false}),
        "symmetric": len(symmetric),
        "misses": len(missed),
        "share of symmetric ones that are missed": len(missed) / max(1, len(symmetric)),
        "falsely accepted": false,
        "called broken though symmetric": accused,
        "misses by reward": dict(Counter(rewards[seed] for seed, _ in missed).most_common()),
        "seconds": sum(task["seconds"] for task in tasks),
    }


def main() -> None:
    """Print a line for each case, or of random tasks what was counted."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="this task alone")
    parser.add_argument("--logs", action="store_true", help="from transitions alone")
    parser.add_argument("--random", type=int, help="so many random tasks instead, from transitions alone")
    parser.add_argument("--first", type=int, default=0, help="seed of the first random task")
    parser.add_argument("--json", help="file for the random tasks; a run that was stopped goes on there")
    args = parser.parse_args()
    if args.random:
        known = Path(args.json) if args.json else None
        tasks: list[dict[str, Any]] = json.loads(known.read_text())["tasks"] if known and known.exists() else []
        done = {task["seed"] for task in tasks}
        for seed in sorted(set(range(args.first, args.first + args.random)) - done):
            tasks.append(of_random_task(seed))
            told = counted(tasks)
            print(*(f"{name}: {told[name]};" for name in ("tasks", "falsely accepted", "misses by reward")), flush=True)
            if known:
                known.write_text(json.dumps({"counted": told, "tasks": tasks}, indent=1) + "\n")
        print(json.dumps(counted(tasks), indent=2))
        return
    cases = [case for case in CASES if args.only in (None, case[0])]
    for task, settings, group in cases:
        begun = time.monotonic()
        answer = found(task, settings, args.logs)
        said = "" if answer == group else f"  (there is {group})"
        print(f"{task} {dict(settings)}: {answer}{said}, {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
