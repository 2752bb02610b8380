"""Play the reference policies of the documentation's tables: python tests/benchmarks/references.py [--json FILE].

They need no training: random actions, and those written by hand.
"""

import argparse
import json
from operator import methodcaller
from pathlib import Path

import torch

from esp_cli.policies.evaluation import play_batches
from esp_cli.policies.statistics import mean_and_sem
from esp_cli.training.build import ScriptedController
from esp_cli.training.config import resolve_config
from esp_envs.base import BLIND

NAVIGATION = ("random", BLIND, "nearest", "cover")
HUNT = ("random", BLIND, "chase")
CASES: dict[str, tuple[str, dict[str, object], tuple[str, ...]]] = {
    "esp, N = 3, L = 3": ("navigation", {}, NAVIGATION),
    "esp, N = 2, L = 3": ("navigation", {"num_agents": 2, "num_landmarks": 3}, NAVIGATION),
    "esp, N = 4, L = 4": ("navigation", {"num_agents": 4}, NAVIGATION),
    "esp, N = 4, L = 3": ("navigation", {"num_agents": 4, "num_landmarks": 3}, NAVIGATION),
    "esp, N = 8, L = 8": ("navigation", {"num_agents": 8}, ("random", BLIND, "nearest")),
    "esp, N = 16, L = 16": ("navigation", {"num_agents": 16}, ("random", BLIND, "nearest")),
    "esp, N = 3, L = 3, continuous": ("navigation", {"actions": "continuous"}, NAVIGATION),
    "pettingzoo, N = 3, L = 3": ("navigation", {"convention": "pettingzoo"}, NAVIGATION),
    "random prey": ("predator-prey", {}, HUNT),
    "random prey, 3 obstacles": ("predator-prey", {"num_obstacles": 3}, HUNT),
    "random prey, pettingzoo": ("predator-prey", {"convention": "pettingzoo"}, HUNT),
    "random prey, continuous": ("predator-prey", {"actions": "continuous"}, HUNT),
    "fleeing prey": ("predator-prey", {"prey": "fleeing"}, HUNT),
    "still prey": ("predator-prey", {"prey": "still"}, HUNT),
    "control prey": ("predator-prey", {"control": "prey"}, ("random", "chase")),
    "wildlife": ("wildlife", {}, ("random", "surround")),
}
"""Row of a table -> task, its settings, policies."""
EPISODES = {"cover": 10_000, "surround": 4096, "wildlife": 4096, "esp, N = 16, L = 16": 1000}
"""Of a policy or a case; else 40,000."""


def scores(case: str) -> dict[str, dict[str, float]]:
    """Return the mean return over episodes, and its standard error, of each policy of a case."""
    task, settings, names = CASES[case]
    config = resolve_config(task, "mappo", overrides={f"task.{key}": value for key, value in settings.items()})
    found = {}
    for name in names:
        act = methodcaller("random_action") if name == "random" else methodcaller("heuristic", name)
        episodes = EPISODES.get(case) or EPISODES.get(name, 40_000)
        played = play_batches(config, ScriptedController(act), "random" if name == "random" else "heuristic", episodes)
        mean, error = mean_and_sem(played.returns.flatten().tolist())
        found[name] = {"mean": round(mean, 3), "sem": round(error, 3)}
    if BLIND in found:  # where 0 is the random policy and 1 the first that is written by hand and sees
        low, high = found[names[0]]["mean"], found[names[2]]["mean"]
        found[BLIND]["normalised"] = round((found[BLIND]["mean"] - low) / (high - low), 3)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, object] = {}
    for case in CASES:
        rows[case] = scores(case)
        print(case, json.dumps(rows[case]), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
