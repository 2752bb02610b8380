"""One policy with other numbers of agents than it was trained with, and how fast many of them act and step.

python tests/benchmarks/many_agents.py runs/three --json docs/measured/many-agents.json
"""

import argparse
import json
import time
from operator import methodcaller
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from esp_cli.policies.evaluation import evaluate
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import PolicyController, ScriptedController, build_environment

CROWDED = [{"num_agents": n} for n in (3, 8, 16, 32)]
SPREAD = [{"num_agents": n, "sees": 8, "density": 8.0} for n in (8, 100, 1000)]
AGENTS = 16_000
"""Agents in all worlds together whose speed is measured."""


def played(trained: TrainedPolicy, settings: dict[str, object]) -> dict[str, Any]:
    episodes = max(2, 128 // int(settings["num_agents"]))
    found = evaluate(trained.transfer(settings), episodes).model_dump(mode="json")
    return {"settings": settings, **{key: found[key] for key in ("episodes", "anchors", "anchor_metrics")}} | {
        "greedy": found["greedy"]["per_seed"],
        "metrics": found["metrics_per_seed"],
    }


@torch.no_grad()
def covered_at_the_end(trained: TrainedPolicy, settings: dict[str, object]) -> dict[str, list[float]]:
    """Return the share of landmarks that is covered in the last step, by seed, of the policy and of `nearest`."""
    moved, found = trained.transfer(settings), {}
    scripted = ScriptedController(methodcaller("heuristic"))
    for name, controller in {"greedy": PolicyController(moved.policy), "nearest": scripted}.items():
        env = build_environment(moved.config, max(2, 128 // int(settings["num_agents"])), "end")
        observation = env.reset()
        controller.begin(env, observation)
        for _ in range(env.spec.horizon):
            step = env.step(controller.act(env, observation))
            observation = step.next
        found[name] = step.metrics["coverage"].mean(-1).tolist()
    return found


@torch.no_grad()
def seconds_a_step(trained: TrainedPolicy, settings: dict[str, object]) -> float:
    """Return the least processor time of ten steps of one seed's policy and worlds, in microseconds per agent."""
    one = trained.transfer(settings).single_seed()
    env = build_environment(one.config, AGENTS // int(settings["num_agents"]), "speed")
    obs, times = env.reset().obs, []
    memory = one.policy.initial_memory(env.num_envs, obs)
    for _ in range(10):
        begun = time.process_time()
        action, memory = one.policy.act(obs, memory)
        obs = env.step(action).next.obs
        times.append(time.process_time() - begun)
    return min(times) / AGENTS * 1e6


def main() -> None:
    """Print one line for each number of agents and write all of it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    trained, rows = TrainedPolicy.read(options.run), []
    for settings in (*CROWDED, *SPREAD):
        row = played(trained, settings) | {"covered at the end": covered_at_the_end(trained, settings)}
        rows.append(row)
        random, heuristic = row["anchors"]["random"], row["anchors"]["heuristic"]
        scores = [(value - random) / (heuristic - random) for value in row["greedy"]]
        means = {name: fmean(values) for name, values in row["metrics"].items()}
        means |= {f"covered at the end, {name}": fmean(values) for name, values in row["covered at the end"].items()}
        print(settings, "normalised", *(f"{score:.2f}" for score in scores), means, flush=True)
    speed = {n: seconds_a_step(trained, {"num_agents": n, "sees": 8, "density": 8.0}) for n in (16, 100, 1000)}
    print("microseconds an agent-step", {n: round(value, 1) for n, value in speed.items()})
    if options.json:
        options.json.write_text(json.dumps({"rows": rows, "microseconds": speed}, indent=1) + "\n")


if __name__ == "__main__":
    main()
