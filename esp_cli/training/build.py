"""What a run consists of, built from its configuration alone: its worlds and its learner, if the memory holds them."""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from esp_cli.algorithms.learner import Learner, LearnerConfig
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.algorithms.roles import RolesLearner
from esp_cli.networks.policy import Policy
from esp_cli.prior.config import PriorConfig
from esp_cli.training.config import RunConfig
from esp_envs.base import Environment, Observation
from esp_envs.conformance import QUICK, Subject, check
from esp_envs.errors import UserError
from esp_envs.registry import TASKS, make
from esp_envs.spec import TaskSpec
from esp_envs.views import Compass


def stream_seeds(seeds: Sequence[int], *names: object) -> list[int]:
    """Return for each run seed one of 63 bits that depends on it and on the stream's names alone."""
    digests = (hashlib.sha256("/".join(map(str, (seed, *names))).encode()).digest() for seed in seeds)
    return [int.from_bytes(digest[:8], "little") >> 1 for digest in digests]


def generators(seeds: Sequence[int], *names: object) -> list[torch.Generator]:
    """Return one CPU generator per run seed for the named stream."""
    return [torch.Generator().manual_seed(seed) for seed in stream_seeds(seeds, *names)]


_LOOK_SECONDS = 2.0  # at a task of others before it is trained on
_FLOAT_BYTES = 4
_COPIES_OF_WEIGHTS = 4  # weights, gradients, and the two moments of Adam
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
"""Where Linux says what the processes of a container may take, in its second and first version of control groups."""
_PROCESS_BYTES = 500 * 2**20  # of a process with torch and its libraries, before it trains


def build_environment(config: RunConfig, num_envs: int, *stream: object, measures: bool = True) -> Environment:
    """Make `num_envs` worlds per seed whose draws come from the named random stream, with the prior's compass."""
    env = make(config.task, num_envs, stream_seeds(config.seeds, *stream), config.task_settings, config.device)
    env.measures = measures
    return with_compass(env, config.prior)


def with_compass(env: Environment, prior: PriorConfig) -> Environment:
    """Return worlds as the policies of a prior see them."""
    prior = prior.effective()
    if env.spec.roles and prior.compass:
        raise UserError(f"{env.spec.name} has roles, which no compass is made for; leave prior.compass out")
    return Compass(env, prior.compass, labels="agents" in prior.transforms) if prior.compass else env


def first_look(config: RunConfig) -> list[str]:
    """Return a sentence on what a short look at a task that is not built in finds; `esp check task` looks longer."""
    if TASKS.ships(config.task):
        return []

    def make_worlds(num_envs: int, seeds: Sequence[int]) -> Environment:
        return make(config.task, min(num_envs, 2), seeds, config.task_settings)

    findings = list(check(Subject(make_worlds, deadline=time.monotonic() + _LOOK_SECONDS), QUICK))
    if broken := [finding.broken for finding in findings if finding.broken]:
        return [f"{config.task} breaks a promise: {'; '.join(broken)}; see 'esp check task {config.task}'"]
    late = [finding.promise for finding in findings if finding.not_covered]
    kept = [finding.promise for finding in findings if not (finding.not_asked or finding.not_covered)]
    told = ", ".join(kept or ["nothing to its end"]) + (f"; there was no time for: {', '.join(late)}" if late else "")
    return [f"looked at {config.task}: {told}; 'esp check task {config.task}' looks longer"]


def spec_of(config: RunConfig) -> TaskSpec:
    """Return the contract of a run's task as its policy meets it; needs no GPU."""
    return build_environment(config.model_copy(update={"device": "cpu"}), 1, "shape").spec


def build_learner(config: RunConfig) -> Learner:
    """Build the learner of a run, with its worlds."""
    cls = ALGORITHMS[config.algorithm]
    settings = cls.config_class(**config.algorithm_settings)
    refuse_what_does_not_fit(config, settings, spec_of(config))
    env = build_environment(config, settings.num_envs, "training worlds", measures=False)
    streams = ("learner", "prior")
    if not env.spec.roles:
        return cls(env, settings, config.network, config.prior, *(generators(config.seeds, name) for name in streams))
    of_roles = [{role.name: generators(config.seeds, name, role.name) for role in env.spec.roles} for name in streams]
    return RolesLearner(cls, env, settings, config.network, config.prior, *of_roles)


def refuse_what_does_not_fit(config: RunConfig, settings: LearnerConfig, spec: TaskSpec) -> None:
    """Refuse a run that needs more memory than the machine has; the error names the setting that needs most of it."""
    needed = least_bytes(config, settings, spec)
    available = machine_bytes(config.device)
    if sum(needed.values()) > available:
        name = max(needed, key=lambda key: needed[key])
        raise UserError(
            f"this run needs at least {_gigabytes(sum(needed.values()))} of memory, {_gigabytes(needed[name])} of it "
            f"for '{name}' with {len(config.seeds)} seeds, but {config.device} has {_gigabytes(available)}; choose a "
            f"smaller {name}, or fewer seeds"
        )


def least_bytes(config: RunConfig, settings: LearnerConfig, spec: TaskSpec) -> dict[str, int]:
    """Return, by setting, bytes that a run needs at least: what every seed, world and step has to hold."""
    algorithm, plain = config.algorithm, settings.model_dump()
    steps = int(plain.get("num_steps", spec.horizon))
    rows = {
        f"{algorithm}.num_envs": settings.num_envs * steps,
        f"{algorithm}.replay_episodes": int(plain.get("replay_episodes", 0)) * spec.horizon,
        f"{algorithm}.batch_episodes": int(plain.get("batch_episodes", 0)) * spec.horizon,
        "evaluation.episodes": config.evaluation.episodes,
    }
    row_bytes = _FLOAT_BYTES * (spec.num_agents * spec.observation.width + spec.state.width)
    weights = config.network.least_parameters(spec.observation.width) * _FLOAT_BYTES * _COPIES_OF_WEIGHTS
    sizes = {name: count * row_bytes for name, count in rows.items()} | {"network.hidden": weights}
    return {name: size * len(config.seeds) for name, size in sizes.items()}


def process_bytes(config: RunConfig, spec: TaskSpec) -> int:
    """Return the memory for a process that trains a run on a cluster: twice what it has to hold, and torch."""
    settings = ALGORITHMS[config.algorithm].config_class(**config.algorithm_settings)
    return _PROCESS_BYTES + 2 * sum(least_bytes(config, settings, spec).values())


def machine_bytes(device: str) -> int:
    """Return the memory of the device that trains; in a container what the container may take."""
    if device == "cuda":
        return torch.cuda.get_device_properties(0).total_memory
    installed = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for file in _LIMITS:
        with contextlib.suppress(OSError, ValueError):  # there is no such file, or it says "max"
            installed = min(installed, int(file.read_text()))
    return installed


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:,.1f} GB"


class PolicyController:
    """S trained policies, which draw their actions with a generator per seed, or without any act greedily."""

    def __init__(self, policy: Policy, generators: Sequence[torch.Generator] | None = None) -> None:
        self.policy, self.generators = policy, generators

    def begin(self, env: Environment, observation: Observation) -> None:
        self.memory = self.policy.initial_memory(env.num_envs, observation.obs)

    def act(self, env: Environment, observation: Observation) -> Tensor:
        """Return the greedy or a drawn action, as `Environment.step` takes it."""
        noise = None
        if self.generators is not None:
            noise = self.policy.noise(env.num_envs, env.spec.num_agents, self.generators, env.device)
        action, self.memory = self.policy.act(observation.obs, self.memory, noise, observation.action_mask)
        return action


class ScriptedController:
    """A policy of the task itself, random or a heuristic, as a function of its worlds: methodcaller("heuristic")."""

    def __init__(self, choose: Callable[[Environment], Tensor]) -> None:
        self._choose = choose

    def begin(self, env: Environment, observation: Observation) -> None:
        """Prepare nothing."""

    def act(self, env: Environment, observation: Observation) -> Tensor:
        return self._choose(env)


Controller = PolicyController | ScriptedController  # chooses joint actions


@dataclass(frozen=True)
class Episodes:
    """What one episode in every world brought."""

    returns: Tensor  # [S, E] mean over agents of the sum of rewards over time
    lengths: Tensor  # [S, E] steps
    # task measures, each [S, E]: means over the episode's steps or sums, as the spec says; and the return of each role
    # as return_ROLE, where there are roles
    metrics: dict[str, Tensor]


@torch.no_grad()
def play(env: Environment, controller: Controller) -> Episodes:
    """Play one episode in every world and add up what it brings; later episodes of a world do not count."""
    observation = env.reset()
    controller.begin(env, observation)
    shape = (env.num_seeds, env.num_envs)
    running = torch.ones(shape, dtype=torch.bool, device=env.device)
    returns, lengths = torch.zeros(shape, device=env.device), torch.zeros(shape, device=env.device)
    sums: dict[str, Tensor] = {}
    by_role = {f"return_{role.name}": where for role, where in env.spec.parts} if env.spec.roles else {}
    for _ in range(env.spec.horizon):
        step = env.step(controller.act(env, observation))
        returns += torch.where(running, step.reward.mean(-1), 0.0)
        lengths += running
        of_roles = {name: step.reward[..., where].mean(-1) for name, where in by_role.items()}
        for name, value in (step.metrics | of_roles).items():
            sums[name] = sums.get(name, 0.0) + torch.where(running, value, 0.0)
        running &= ~step.ended
        observation = step.next
        if env.spec.terminates and not running.any():
            break
    means = {name: value if name in {*env.spec.totals, *by_role} else value / lengths for name, value in sums.items()}
    return Episodes(returns, lengths, means)
