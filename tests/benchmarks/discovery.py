"""Measure what `esp discover` finds: the group of each task, and how well transitions alone tell elements apart.

    python tests/benchmarks/discovery.py [--only navigation] [--logs]

The tasks declare nothing here. Without --logs states are set where a task can be; with it, transitions of the random
policy are all there is, and the last line is the AUC of symmetric against broken elements by their gap.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

from esp_cli import machine

if __name__ == "__main__":
    machine.prepare()  # as `esp` does, before torch is imported

import torch

from esp_cli.checking import collect
from esp_cli.checking.discovery import discover_in_task
from esp_cli.checking.regression import check_by_regression
from esp_cli.symmetry import parse_elements
from esp_envs import Environment, make

Settings = Mapping[str, object]
FORCES: Settings = {"actions": "continuous"}
DRONES: Settings = {"width": 5, "height": 5, "horizon": 30}
CASES: Sequence[tuple[str, Settings, str]] = (
    ("navigation", {}, "d4*agents*landmarks-3"),
    ("navigation", FORCES, "o2*agents*landmarks-3"),
    ("navigation", {"wind": 0.3}, "flip-x*agents*landmarks-3"),
    ("navigation", {"mud": 0.5}, "flip-x*agents*landmarks-3"),
    ("navigation", {"gust_mean": 1.0, "gust_std": 1.0}, "flip-diagonal*agents*landmarks-3"),
    ("navigation", {"action_turn_rad": 0.5}, "c4*agents*landmarks-3"),
    ("navigation", {"action_turn_rad": 0.5, **FORCES}, "so2*agents*landmarks-3"),
    ("navigation", {"reward_offset": 0.3}, "flip-x*agents*landmarks-3"),
    ("navigation", {"weak_agent": 0.5}, "d4*landmarks-3 and agents-0-2-1"),
    ("navigation", {"wind": 0.3, "gust_mean": 1.0, "weak_agent": 0.5, "num_agents": 2, "num_landmarks": 1}, "c1"),
    ("predator-prey", {}, "d4*agents*obstacles-2"),
    ("predator-prey", {"wind": 0.3}, "flip-x*agents*obstacles-2"),
    ("predator-prey", {"action_turn_rad": 0.5}, "c4*agents*obstacles-2"),
    ("wildlife", DRONES, "d4*agents"),
    ("wildlife", {"wind": 0.8, **DRONES}, "flip-x*agents"),
)
"""Task, settings, and what is there."""
EPISODES, WORLDS = 1024, 256


def found(task: str, settings: Settings, logs: bool) -> str:
    """Return the group that is found in a task whose declaration is taken away."""

    def worlds(num_envs: int, seeds: Sequence[int]) -> Environment:
        env = make(task, num_envs, seeds, settings)
        env.spec = replace(env.spec, symmetry="c1", nearly="")
        return env

    return discover_in_task(worlds, logs_alone=logs).group


def auc(cases: Sequence[tuple[str, Settings, str]]) -> tuple[float, int, int]:
    """Return the share of pairs of a broken and a symmetric element in which the broken one has the larger gap."""
    held, broken = list[float](), list[float]()
    for task, settings, group in cases:
        plane = group.split("*")[0].split(" ")[0]
        env = make(task, WORLDS, [0], settings)
        largest = {"o2": "d4", "so2": "c4", "c1": ""}.get(plane, plane)
        true = {element.name for element in parse_elements(largest, 1)} if largest else set[str]()
        for verdict in check_by_regression(env.spec, collect(env, EPISODES), parse_elements("d4", 1)):
            gap = max(field.gap for field in verdict.fields if field.outcome != "not covered")
            (held if verdict.element in true else broken).append(gap)
    ahead = torch.tensor(broken).unsqueeze(1) > torch.tensor(held)
    return float(ahead.float().mean()), len(held), len(broken)


def main() -> None:
    """Print a line for each case, then the AUC."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help="this task alone")
    parser.add_argument("--logs", action="store_true", help="from transitions alone")
    args = parser.parse_args()
    cases = [case for case in CASES if args.only in (None, case[0])]
    if args.logs:
        share, held, broken = auc(cases)
        print(f"AUC {share:.3f} of {broken} broken against {held} symmetric elements", flush=True)
    for task, settings, group in cases:
        begun = time.monotonic()
        answer = found(task, settings, args.logs)
        said = "" if answer == group else f"  (there is {group})"
        print(f"{task} {dict(settings)}: {answer}{said}, {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
