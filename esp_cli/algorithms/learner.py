"""What every learner is to the training loop: iterate, save, load, and stop a seed that broke."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.algorithms.rollout import Collector
from esp_cli.networks.policy import Policy
from esp_envs.base import generator_states, restore_generators


class Learner(ABC):
    """S seeds of one algorithm.

    A subclass sets the attributes below in its constructor and implements `iterate`.

    Attributes:
        policy: what acts, and what evaluation, rendering and export take.
        modules: every network and statistic with a seed axis, by name.
        optimisers: by name.
        collector: where the training worlds stand.
        generators: random generators by name, one per seed each.
    """

    policy: Policy
    modules: dict[str, nn.Module]
    optimisers: dict[str, torch.optim.Optimizer]
    collector: Collector
    generators: dict[str, list[torch.Generator]]

    @property
    @abstractmethod
    def steps_per_iteration(self) -> int:
        """Environment steps per seed of one iteration."""

    @abstractmethod
    def iterate(self, progress: float) -> dict[str, Tensor]:
        """Collect, learn, and return metrics, each [S].

        Args:
            progress: share of the run that is done, 0 to 1, for schedules.
        """

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything that a resumed run needs to go on bit for bit, as flat tensors."""
        out: dict[str, Tensor] = {}
        for name, module in self.modules.items():
            out |= {f"{name}.{key}": value for key, value in module.state_dict().items()}
        for name, optimiser in self.optimisers.items():
            for index, entry in optimiser.state_dict()["state"].items():
                out |= {f"optimiser.{name}.{index}.{key}": value for key, value in entry.items()}
        for name, generators in self.generators.items():
            out[f"generators.{name}"] = generator_states(generators)
        return out | {f"collector.{key}": value for key, value in self.collector.state_dict().items()}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            ValueError: tensors of another shape or name, so of another configuration.
        """
        try:
            for name, module in self.modules.items():
                module.load_state_dict(_below(tensors, name))
            for name, optimiser in self.optimisers.items():
                _load_optimiser(optimiser, _below(tensors, f"optimiser.{name}"))
            for name, generators in self.generators.items():
                restore_generators(generators, tensors[f"generators.{name}"])
            self.collector.load_state_dict(_below(tensors, "collector"))
        except (KeyError, RuntimeError, IndexError, TypeError) as error:
            reason = str(error).split("\n")[0]
            raise ValueError(f"the checkpoint does not fit this configuration ({reason})") from None

    def seed_tensors(self) -> list[Tensor]:
        """Return every tensor with a leading seed axis that learning changes: weights, statistics, moments."""
        out = [tensor for module in self.modules.values() for tensor in module.state_dict().values()]
        for optimiser in self.optimisers.values():
            for entry in optimiser.state.values():
                out += [value for key, value in entry.items() if key != "step"]
        return out


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the entries under `prefix.`, without it."""
    return {k[len(prefix) + 1 :]: v for k, v in tensors.items() if k.startswith(prefix + ".")}


def _load_optimiser(optimiser: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Load flat entries "index.name" into an optimiser over the same parameters."""
    state: dict[int, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        index, key = name.split(".")
        state.setdefault(int(index), {})[key] = tensor
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
