"""Small off-policy learners, and a task whose episodes end by themselves."""

import torch

from esp_cli.algorithms.replay import EpisodeBatch
from esp_cli.symmetry import transform_set
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config

SMALL = {"num_envs": 2, "rounds": 2, "batch_episodes": 3, "replay_episodes": 7, "warmup_episodes": 2}


def on_perceptron(task):
    """Settings that replace the network over sets, the default of navigation."""
    return {"network.name": "mlp"} if task == "navigation" else {}


def learner(algorithm, task="navigation", seeds=(0, 1), **overrides):
    settings = {f"{algorithm}.{name}": value for name, value in SMALL.items()} | {"network.hidden": [16, 16]}
    settings |= on_perceptron(task)
    settings |= {name.replace("__", ".").replace("algo.", f"{algorithm}."): value for name, value in overrides.items()}
    return build_learner(resolve_config(task, algorithm, steps=10_000, seeds=seeds, overrides=settings))


def small_learner(task, algorithm, hidden=(8, 8), **overrides):
    """A learner of a task of a few steps; settings as "network__name", or as they are written."""
    small = {"num_envs": 4, "num_steps": 6} if algorithm == "mappo" else SMALL
    settings = {f"{algorithm}.{name}": value for name, value in small.items()} | {"network.hidden": list(hidden)}
    settings |= on_perceptron(task)
    settings |= {name.replace("__", "."): value for name, value in overrides.items()}
    return build_learner(resolve_config(task, algorithm, steps=1000, seeds=(0, 1), overrides=settings))


def networks(trained):
    return {
        name: tensor.clone()
        for name, tensor in trained.state_dict().items()
        if name.startswith(("policy", "critic", "mixer", "target"))
    }


def after(algorithm, iterations=2, **choice):
    trained = learner(algorithm, **choice)
    metrics = [trained.iterate(0.0).metrics for _ in range(iterations)]
    return networks(trained), metrics


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def numbered_batch(spec, num_seeds, count, first=0):
    """Episodes whose every number says where it belongs: seed * 1000 + episode (+ first)."""
    mark = (torch.arange(num_seeds).view(-1, 1) * 1000 + first + torch.arange(count)).float()
    steps, agents = spec.horizon, spec.num_agents

    def marked(*shape):
        return mark.view(num_seeds, count, *[1] * len(shape)).expand(num_seeds, count, *shape).clone()

    ones = torch.ones(num_seeds, count, steps, dtype=torch.bool)
    obs, state = marked(steps + 1, agents, spec.observation.width), marked(steps + 1, spec.state.width)
    action = torch.zeros(num_seeds, count, steps, agents, dtype=torch.int64)
    return EpisodeBatch(obs, state, action, marked(steps, 1), ~ones, ones)


def turn(spec, text="rot90"):
    return transform_set(text, spec).each()[0]
