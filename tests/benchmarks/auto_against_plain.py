"""Train with `--prior auto` and without a prior on random tasks, of which transitions alone tell what holds.

    python tests/benchmarks/auto_against_plain.py [--tasks 24] [--steps 20000] [--json docs/measured/auto-random.json]

The reward families come in turn, so 24 tasks have one each. A task counts as lower where the 95 % interval of auto
minus plain, over paired seeds, lies below 0. A run that was stopped goes on in the file.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from esp_cli import machine

if __name__ == "__main__":
    machine.prepare()  # as `esp` does, before torch is imported

import torch

from esp_cli.checking.measured import prepared
from esp_cli.policies.statistics import difference
from esp_cli.training.build import PolicyController, build_environment, build_learner, play
from esp_cli.training.config import resolve_config
from esp_envs.mpe.task import FORCE
from esp_envs.registry import register
from esp_envs.settings import TaskSettings
from tests.benchmarks.synthetic import Recipe, Synthetic

EPISODES = 256
"""Greedy episodes a seed at the end."""


class RandomSettings(TaskSettings):
    """Which task."""

    recipe: int = 0


class RandomTask(Synthetic):
    """The task of a recipe, with forces for actions, so that d4 can be carried; no state can be set."""

    Settings = RandomSettings

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        assert isinstance(settings, RandomSettings)
        super().__init__(replace(Recipe.drawn(settings.recipe), action=FORCE), num_envs, generators, quiet=False)

    def has(self, method: str) -> bool:
        """Return whether the task offers an optional method: no state can be set."""
        return method != "set_state" and super().has(method)


def trained(task: str, recipe: int, kind: str, steps: int, seeds: int) -> tuple[list[float], dict[str, float]]:
    """Return the mean greedy return of each seed, and the weights that were measured."""
    overrides = {"prior.kind": kind, "task.recipe": recipe, "mappo.num_envs": 64}
    config = prepared(resolve_config(task, "mappo", steps=steps, seeds=range(seeds), overrides=overrides))
    learner = build_learner(config)
    iterations = -(-steps // learner.steps_per_iteration)
    for number in range(iterations):
        learner.begin(number / iterations)
        learner.iterate(number / iterations)
    worlds = build_environment(config, EPISODES, "evaluation")
    returns = play(worlds, PolicyController(learner.policy)).returns.mean(-1).tolist()
    return [round(value, 4) for value in returns], dict(config.prior.weights)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, default=24)
    parser.add_argument("--first", type=int, default=3000, help="seed of the first random task")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    task = register(RandomTask)
    rows: list[dict[str, Any]] = json.loads(args.json.read_text())["tasks"] if args.json and args.json.exists() else []
    for recipe in range(args.first + len(rows), args.first + args.tasks):
        begun = time.process_time()
        (plain, _), (auto, weights) = (trained(task, recipe, k, args.steps, args.seeds) for k in ("none", "auto"))
        gain = difference(auto, plain, paired=True)
        row = {"recipe": recipe, "reward": Recipe.drawn(recipe).reward, "plain": plain, "auto": auto}
        rows.append(row | {"difference": gain, "weights": weights, "seconds": round(time.process_time() - begun, 1)})
        print(recipe, row["reward"], gain, sum(weight > 0 for weight in weights.values()), "weighed", flush=True)
        if args.json:
            told = json.dumps({"steps": args.steps, "seeds": args.seeds, "episodes": EPISODES})
            lines = ",\n".join(json.dumps(row, default=vars) for row in rows)
            args.json.write_text(f'{told[:-1]}, "tasks": [\n{lines}\n]}}\n')


if __name__ == "__main__":
    main()
