"""Evaluate a policy that looks at no landmark on navigation with eight agents: python tests/benchmarks/blind_eight.py.

The agents share out the eight outer places of a 3 x 3 grid, by least distance, and fly there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from esp_cli.policies.statistics import mean_and_sem
from esp_envs import make

EPISODES = 400
SPACING = 0.5  # of the grid, lengths


def returns() -> list[float]:
    """Return the return of each episode, as the mean over agents."""
    env = make("navigation", num_envs=EPISODES, seeds=[0], settings={"num_agents": 8})
    obs = env.reset().obs
    grid = torch.tensor([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if (x, y) != (0, 0)]) * SPACING
    places = torch.stack(
        [
            grid[linear_sum_assignment(np.linalg.norm(world[:, None] - grid.numpy(), axis=-1))[1]]
            for world in obs[0, ..., 2:4].numpy()
        ]
    )[None]
    total = torch.zeros(EPISODES)
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
    mean, error = mean_and_sem(returns())
    found = {"episodes": EPISODES, "spacing": SPACING, "return": {"mean": mean, "sem": error}}
    print(json.dumps(found))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
