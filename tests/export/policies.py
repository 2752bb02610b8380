"""Policies with drawn weights, of every network and head, for the tests of what leaves the application."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import torch

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_environment, generators
from esp_cli.training.checkpoint import POLICY_FORMAT, describe_policy, save_checkpoint
from esp_cli.training.config import resolve_config
from tests.algorithms.off_policy import on_perceptron

KINDS = {
    "choice": ("navigation", "mappo", {}),
    "choice, recurrent": ("navigation", "mappo", {"network.name": "gru", "mappo.num_minibatches": 1}),
    "choice, normalised": ("navigation", "mappo", {"network.layer_norm": True, "network.activation": "relu"}),
    "vector": ("navigation", "mappo", {"task.actions": "continuous"}),
    "wheels": ("formation", "mappo", {}),
    "wheel pairs": ("formation", "qmix", {}),
    "separate wheels": ("formation", "qmix", {"network.separate_parts": True}),
    "values, recurrent": ("predator-prey", "qmix", {"network.name": "gru", "network.layer_norm": True}),
    "exploring choice, recurrent": ("navigation", "maddpg", {"network.name": "gru"}),
    "point, recurrent": ("navigation", "maddpg", {"network.name": "gru", "task.actions": "continuous"}),
    "point": ("formation", "maddpg", {}),
    "equivariant": ("navigation", "mappo", {"network.name": "equivariant"}),
    "team": ("wildlife", "mappo", {}),
    "sets": ("navigation", "mappo", {"network.name": "set", "task.num_agents": 4}),
    "sets, recurrent": (
        "navigation",
        "mappo",
        {"network.name": "set", "network.memory": True, "mappo.num_minibatches": 1},
    ),
    "sets, values, recurrent": ("predator-prey", "qmix", {"network.name": "set", "network.memory": True}),
    "sets, near": ("predator-prey", "mappo", {"network.name": "set", "network.near": 2, "network.activation": "tanh"}),
}
"""Every head, on a perceptron and on a recurrent network where they differ; every network."""
LARGE = {"team, values, equivariant": ("wildlife", "qmix", {"network.name": "empn"})}
"""Exported alike; a comparison on thousands of observations takes long."""
REFUSED = {
    "ensemble": ("navigation", "mappo", {"network.symmetrise": "c4"}),
    "set-equivariant": ("navigation", "mappo", {"network.name": "set-equivariant"}),
}
"""What no export takes."""


def drawn_policy(
    kind: str, seeds: tuple[int, ...] = (0,), hidden: tuple[int, ...] = (12, 10), near: int = 0, **of_task: object
) -> TrainedPolicy:
    """Return policies whose weights are large enough to matter: those of a new one give all actions the same chance."""
    task, algorithm, settings = (KINDS | LARGE | REFUSED)[kind]
    overrides = {
        **on_perceptron(task),
        "network.hidden": list(hidden),
        **settings,
        **({"network.near": near} if near else {}),
        **{f"task.{k}": value for k, value in of_task.items()},
    }
    config = resolve_config(task, algorithm, seeds=seeds, steps=100, overrides=overrides)
    spec = build_environment(config, 1, "shape").spec
    policy = ALGORITHMS[algorithm].build_policy(spec, config.network, generators(seeds, "shape")).eval()
    generator, size = torch.Generator().manual_seed(1), 0.1 if policy.actor.team > 1 else 0.3  # pictures sum up more
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=size)
    return TrainedPolicy(config, policy, spec, 100, Path("drawn"))


def imported(file: Path) -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(file)))


def write_policy(trained: TrainedPolicy, path: Path) -> Path:
    """Write a policy file as a run does."""
    description = describe_policy(trained.config, trained.spec, trained.step, [0.0] * len(trained.config.seeds))
    save_checkpoint(path, trained.policy.state_dict(), description, POLICY_FORMAT)
    return path
