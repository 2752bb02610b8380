"""Learners of a task with roles: an ordinary learner for each role, all in the same worlds."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.algorithms.learner import Iteration, Learner
from esp_cli.networks.contract import Generators, NetworkConfig
from esp_cli.networks.policy import Policy
from esp_cli.networks.roles import RolesPolicy
from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import Group
from esp_cli.symmetry.admission import admitted_elements, unrestricted
from esp_envs.base import Environment
from esp_envs.roles import without_agents
from esp_envs.spec import TaskSpec
from esp_envs.views import Lockstep, RoleView


def new_policy(cls: type[Learner], spec: TaskSpec, network: NetworkConfig, generators: Generators) -> Policy:
    """Return new policies of the kind that an algorithm trains, one per generator, for each role if there are some."""
    if not spec.roles:
        return cls.build_policy(spec, network, generators)
    return RolesPolicy(spec, {role.name: cls.build_policy(role, network, generators) for role in spec.roles})


class RolesLearner(Learner):
    """An ordinary learner for each role, which acts in that role's view of the worlds; see `Lockstep`.

    A tensor is named "critic.ROLE.weight", a metric "train/ROLE/entropy". A role of one agent has no orders of agents.
    """

    def __init__(
        self,
        cls: type[Learner],
        env: Environment,
        config: Any,
        network: NetworkConfig,
        prior: PriorConfig,
        generators: Mapping[str, Generators],
        prior_generators: Mapping[str, Generators],
    ) -> None:
        self.config, self.spec, self.device = config, env.spec, env.device
        self._cls, self._prior, self._own, self._of_prior = cls, prior, generators, prior_generators
        self.build(env, network)

    def build(self, env: Environment, network: NetworkConfig) -> None:
        """Make the learners, which may begin episodes as they do so."""
        env.reset()  # processes of its own begin before there are threads
        self._lockstep = Lockstep(env)
        jobs = [partial(self._learner, role, network) for role in env.spec.roles]
        self.each = dict(zip((role.name for role in env.spec.roles), self._lockstep.run(jobs), strict=True))
        learners = self.each.items()
        self.policy = RolesPolicy(env.spec, {name: learner.policy for name, learner in learners})
        self.modules, self.optimisers, self.generators = {"policy": self.policy}, {}, {}
        if all("target_policy" in learner.modules for _, learner in learners):
            self.modules["target_policy"] = nn.ModuleDict({n: one.modules["target_policy"] for n, one in learners})
        for name, learner in learners:
            own = {key: module for key, module in learner.modules.items() if key not in self.modules}
            self.modules |= {f"{key}.{name}": module for key, module in own.items()}
        self.collector = next(iter(self.each.values())).collector

    def _learner(self, role: TaskSpec, network: NetworkConfig) -> Learner:
        view, name, prior, config = RoleView(self._lockstep, role.name), role.name, self._prior, self.config
        if role.num_agents == 1:
            rest = without_agents(prior.transforms)
            prior = prior.model_copy(update={"transforms": rest} if rest else {"kind": "none"})
        if prior.weights and prior.kind != "none":
            elements = admitted_elements(prior.transforms, unrestricted(role))
            names = {elements.name} if isinstance(elements, Group) else {element.name for element in elements}
            prior = prior.model_copy(update={"weights": {n: w for n, w in prior.weights.items() if n in names}})
        reads_all = getattr(config, "critic_input", None) == "observations" and role.joint_fields is not None
        if reads_all and not network.free_of_counts:  # a network over sets takes rows of the role's own agents alone
            config = config.model_copy(update={"critic_input": "state"})  # which is the observations of all roles
        return self._cls(view, config, network, prior, self._own[name], self._of_prior[name])

    @classmethod
    def build_policy(cls, spec: TaskSpec, network: NetworkConfig, generators: Generators) -> Policy:
        raise NotImplementedError("the algorithm of each role makes its policy; see new_policy")

    @property
    def steps_per_iteration(self) -> int:
        return next(iter(self.each.values())).steps_per_iteration

    def begin(self, progress: float) -> None:
        for learner in self.each.values():
            learner.begin(progress)

    def iterate(self, progress: float) -> Iteration:
        """Let all roles collect and learn; "train/return" is the mean over all agents."""
        results = self._lockstep.run([partial(learner.iterate, progress) for learner in self.each.values()])
        metrics: dict[str, Tensor] = {}
        for name, result in zip(self.each, results, strict=True):
            metrics |= {key.replace("/", f"/{name}/", 1): value for key, value in result.metrics.items()}
        returns = [result.metrics.get("train/return") for result in results]
        known = [x * role.num_agents for x, role in zip(returns, self.spec.roles, strict=True) if x is not None]
        if len(known) == len(returns):
            metrics["train/return"] = torch.stack(known).sum(0) / self.spec.num_agents
        return Iteration(metrics, torch.stack([result.finite for result in results]).all(0))

    def state_dict(self, complete: bool = False) -> dict[str, Tensor]:
        out: dict[str, Tensor] = {}
        for role, learner in self.each.items():
            parts = ((key.partition("."), value) for key, value in learner.state_dict(complete).items())
            out |= {f"{first}.{role}{dot}{rest}": value for (first, dot, rest), value in parts}
        return out

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        for role, learner in self.each.items():
            parts = ((key.split(".", 2), value) for key, value in tensors.items())
            own = {".".join([words[0], *words[2:]]): value for words, value in parts if words[1:2] == [role]}
            learner.load_state_dict(own)

    @property
    def has_learned(self) -> bool:
        return all(learner.has_learned for learner in self.each.values())

    def seed_tensors(self) -> list[Tensor]:
        return [tensor for learner in self.each.values() for tensor in learner.seed_tensors()]
