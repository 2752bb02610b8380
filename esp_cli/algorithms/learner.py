"""What every learner is to the training loop: iterate, save, load, and stop a seed that broke."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from esp_cli.algorithms.adam import SeedAdam
from esp_cli.files.documents import Strict
from esp_cli.networks.contract import Generators, NetworkConfig
from esp_cli.networks.policy import Policy
from esp_cli.prior import SymmetryPrior
from esp_cli.prior.config import PriorConfig
from esp_envs.base import Environment, generator_states, restore_generators
from esp_envs.errors import UserError
from esp_envs.spec import TaskSpec


@dataclass(frozen=True)
class Iteration:
    """What one iteration of collecting and learning returns."""

    metrics: dict[str, Tensor]  # what is logged, by name, [S] each
    # [S] bool, whether each seed's losses and gradients are finite numbers; one that is not stops the seed
    finite: Tensor


class LearnerConfig(Strict):
    """What the hyperparameters of every algorithm have in common."""

    num_envs: int

    def without_effect(self, network: NetworkConfig, spec: Callable[[], TaskSpec]) -> frozenset[str]:
        """Return the names of settings that change nothing beside the others; `spec` makes the task's contract."""
        return frozenset()


class Worlds:
    """Acts in the training worlds and remembers where each stands."""

    def __init__(self, env: Environment, policy: Any, generators: Generators) -> None:
        self.env, self.policy, self.generators = env, policy, generators

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a resumed run needs to go on bit for bit: between episodes that is the worlds' own state."""
        return under("env", self.env.state_dict())

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        self.env.load_state_dict(below(tensors, "env"))


class Learner(ABC):
    """S seeds of one algorithm.

    A subclass makes policy, modules, optimisers and collector in `build` and implements `iterate`; the constructor sets
    the other attributes below.

    Args:
        env: the training worlds.
        config: hyperparameters, of the subclass's `config_class`.
        network: shape of the networks.
        prior: the symmetry prior's settings; kind "none" gives the plain algorithm bit for bit.
        generators: one CPU generator per seed for initial weights, action noise and minibatches.
        prior_generators: one CPU generator per seed for the prior alone, so that it disturbs no other draw.

    Attributes:
        config_class: model of its hyperparameters.
        task_settings: what it asks of a task that has such settings, where a user says nothing else.
        replays: whether it has a replay, in which the prior may store copies.
        config: hyperparameters.
        spec: of the task.
        device: where everything is.
        prior: the symmetry prior.
        policy: what acts, and what evaluation, rendering and export take.
        modules: every network and statistic with a seed axis, by name.
        optimisers: by name.
        collector: where the training worlds stand.
        generators: random generators by name, one per seed each.
    """

    config_class: ClassVar[type[LearnerConfig]] = LearnerConfig
    task_settings: ClassVar[Mapping[str, object]] = MappingProxyType({})
    replays: ClassVar[bool] = False
    config: LearnerConfig
    policy: Policy
    modules: dict[str, nn.Module]
    optimisers: dict[str, SeedAdam]
    collector: Worlds

    def __init__(
        self,
        env: Environment,
        config: Any,
        network: NetworkConfig,
        prior: PriorConfig,
        generators: Generators,
        prior_generators: Generators,
    ) -> None:
        self.config, self.spec, self.device = config, env.spec, env.device
        self.prior = SymmetryPrior(prior, env.spec, env.device, self.replays)
        self.generators = {"learner": list(generators), "prior": list(prior_generators)}
        self.build(env, network)

    @abstractmethod
    def build(self, env: Environment, network: NetworkConfig) -> None:
        """Make networks, statistics, optimisers and collector; initial weights are drawn from the generators "learner".

        Raises:
            UserError: settings, network and task do not go together.
        """

    @classmethod
    @abstractmethod
    def build_policy(cls, spec: TaskSpec, network: NetworkConfig, generators: Generators) -> Policy:
        """Return new policies of the kind that this algorithm trains, one per generator."""

    @property
    @abstractmethod
    def steps_per_iteration(self) -> int:
        """Environment steps per seed of one iteration."""

    def begin(self, progress: float) -> None:
        """Set how strong the prior is in the next iteration."""
        self.prior.begin(progress)

    @abstractmethod
    def iterate(self, progress: float) -> Iteration:
        """Collect, learn, and return what came out; `progress` is the share of the run that is done, 0 to 1."""

    def iteration(self, metrics: dict[str, Tensor], *watched: Tensor) -> Iteration:
        """Return metrics with the flags that say in which seeds all the watched numbers, [S] each, are finite.

        The prior learns of "train/return", if it is there.
        """
        if (returns := metrics.get("train/return")) is not None:
            self.prior.learned(returns)
        seeds = torch.ones(len(self.generators["learner"]), device=self.device)
        return Iteration(metrics, torch.stack([seeds, *watched]).isfinite().all(0))

    def anneal(self, remaining: float) -> None:
        """Set the learning rate of every optimiser to this share of what it was made with."""
        for optimiser in self.optimisers.values():
            optimiser.anneal(remaining)

    def state_dict(self, complete: bool = False) -> dict[str, Tensor]:
        """Return flat tensors that a resumed run needs; once `complete`, less what only further learning needs."""
        out = {f"generators.{name}": generator_states(generators) for name, generators in self.generators.items()}
        for name, part in self._parts().items():
            out |= under(name, part.state_dict())
        return out

    def _parts(self) -> dict[str, Any]:
        """Return all that has tensors of its own, by the name before theirs."""
        optimisers = {f"optimiser.{name}": optimiser for name, optimiser in self.optimisers.items()}
        return {**self.modules, **optimisers, "prior": self.prior, "collector": self.collector}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            UserError: tensors of another shape or name, so of another configuration.
        """
        try:
            for name, part in self._parts().items():
                part.load_state_dict(below(tensors, name))
            for name, generators in self.generators.items():
                restore_generators(generators, tensors[f"generators.{name}"])
        except (KeyError, RuntimeError, IndexError, TypeError, ValueError) as error:
            reason = str(error).split("\n")[0]
            raise UserError(f"the checkpoint does not fit this configuration ({reason})") from None

    def further_weights(self) -> dict[str, dict[str, Tensor]]:
        """Return the tensors of every module beside the policy, as `state_dict` names them, by the module's name."""
        others = self.modules.keys() - {"policy", "target_policy"}
        return {name: under(name, module.state_dict()) for name, module in self.modules.items() if name in others}

    def start_from(self, weights: Mapping[str, Tensor]) -> None:
        """Give these weights to the policy and its target, and to the modules whose names they bear."""
        policy = dict(weights)
        for name in self.further_weights():
            own = below({key: policy.pop(key) for key in [*policy] if key.startswith(f"{name}.")}, name)
            if own:
                self.modules[name].load_state_dict(own)
        for name in ("policy", "target_policy"):
            if name in self.modules:
                self.modules[name].load_state_dict(policy)

    @property
    def has_learned(self) -> bool:
        """Whether it took any gradient step; one that first fills a replay may not have."""
        return True

    def seed_tensors(self) -> list[Tensor]:
        """Return every tensor with a leading seed axis that learning changes: weights, statistics, moments."""
        out = [tensor for module in self.modules.values() for tensor in module.state_dict().values()]
        return out + [moment for adam in self.optimisers.values() for moment in (adam.mean, adam.square)]


def under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors as entries under `prefix.`."""
    return {f"{prefix}.{name}": tensor for name, tensor in tensors.items()}


def below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the entries under `prefix.`, without it."""
    return {k[len(prefix) + 1 :]: v for k, v in tensors.items() if k.startswith(prefix + ".")}
