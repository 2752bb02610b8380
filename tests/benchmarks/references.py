"""Play the reference policies of the documentation's tables: python tests/benchmarks/references.py [--json FILE].

They need no training: random actions, and those written by hand. One more looks at no landmark of navigation with eight
agents: the agents share out the eight outer places of a 3 x 3 grid, by least distance, and fly there.
"""

import argparse
import json
from operator import methodcaller
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from esp_cli.policies.evaluation import play_batches
from esp_cli.policies.statistics import mean_and_sem
from esp_cli.training.build import ScriptedController
from esp_cli.training.config import resolve_config
from esp_envs import make

NAVIGATION = ("random", "nearest", "cover")
CASES: dict[str, tuple[str, dict[str, object], tuple[str, ...]]] = {
    "esp, N = 3, L = 3": ("navigation", {}, NAVIGATION),
    "esp, N = 2, L = 3": ("navigation", {"num_agents": 2, "num_landmarks": 3}, NAVIGATION),
    "esp, N = 4, L = 4": ("navigation", {"num_agents": 4}, NAVIGATION),
    "esp, N = 4, L = 3": ("navigation", {"num_agents": 4, "num_landmarks": 3}, NAVIGATION),
    "esp, N = 3, L = 3, continuous": ("navigation", {"actions": "continuous"}, NAVIGATION),
    "pettingzoo, N = 3, L = 3": ("navigation", {"convention": "pettingzoo"}, NAVIGATION),
    "random prey": ("predator-prey", {}, ("random", "chase")),
    "random prey, 3 obstacles": ("predator-prey", {"num_obstacles": 3}, ("random", "chase")),
    "random prey, pettingzoo": ("predator-prey", {"convention": "pettingzoo"}, ("random", "chase")),
    "random prey, continuous": ("predator-prey", {"actions": "continuous"}, ("random", "chase")),
    "fleeing prey": ("predator-prey", {"prey": "fleeing"}, ("random", "chase")),
    "still prey": ("predator-prey", {"prey": "still"}, ("random", "chase")),
    "control prey": ("predator-prey", {"control": "prey"}, ("random", "chase")),
    "wildlife": ("wildlife", {}, ("random", "surround")),
}
"""Row of a table -> task, its settings, policies."""
EPISODES = {"cover": 10_000, "surround": 4096, "wildlife": 4096}
"""Of a policy or a case; else 40,000."""
BLIND_EPISODES = 400
SPACING = 0.5  # of the grid, lengths


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
    return found


def blind_returns() -> list[float]:
    """Return the return of each episode of the policy that looks at no landmark, as the mean over agents."""
    env = make("navigation", num_envs=BLIND_EPISODES, seeds=[0], settings={"num_agents": 8})
    obs = env.reset().obs
    grid = torch.tensor([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]) * SPACING
    places = torch.stack(
        [
            grid[linear_sum_assignment(np.linalg.norm(world[:, None] - grid.numpy(), axis=-1))[1]]
            for world in obs[0, ..., 2:4].numpy()
        ]
    )[None]
    total = torch.zeros(BLIND_EPISODES)
    for _ in range(env.spec.horizon):
        velocity, position = obs[..., 0:2], obs[..., 2:4]
        x, y = (places - position - 0.3 * velocity).unbind(-1)
        near_enough = torch.full_like(x, 0.05)
        step = env.step(torch.stack([near_enough, -x, x, -y, y], -1).argmax(-1))
        total += step.reward.mean(-1)[0]
        obs = step.next.obs
    return total.tolist()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, object] = {}
    for case in CASES:
        rows[case] = scores(case)
        print(case, json.dumps(rows[case]), flush=True)
    mean, error = mean_and_sem(blind_returns())
    rows["esp, N = 8, a grid"] = {"grid": {"mean": mean, "sem": error}}
    print(rows["esp, N = 8, a grid"])
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
