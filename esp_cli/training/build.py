"""Building what a run consists of from its configuration alone: its worlds and its learner."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from esp_cli.algorithms.learner import Learner
from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.prior.config import PriorConfig
from esp_cli.prior.gate import fit_gate
from esp_cli.training.config import RunConfig
from esp_cli.training.memory import refuse_what_does_not_fit
from esp_cli.training.streams import generators, stream_seeds
from esp_envs.base import Environment
from esp_envs.compass import Compass
from esp_envs.conformance import QUICK, Subject, check
from esp_envs.errors import UserError
from esp_envs.registry import TASKS, make
from esp_envs.spec import TaskSpec

_LOOK_SECONDS = 2.0  # at a task of others before it is trained on
_GATE_WORLDS = 256  # for the episodes that a gate's predictors are fitted to


def build_environment(config: RunConfig, num_envs: int, *stream: object) -> Environment:
    """Make `num_envs` worlds per seed whose draws come from the named random stream, with the prior's compass."""
    env = make(config.task, num_envs, stream_seeds(config.seeds, *stream), config.task_settings, config.device)
    return with_compass(env, config.prior)


def with_compass(env: Environment, prior: PriorConfig) -> Environment:
    """Return worlds as the policies of a prior see them."""
    prior = prior.effective()
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
    kept = ", ".join(finding.promise for finding in findings if not finding.not_asked)
    return [f"looked at {config.task}: {kept}; 'esp check task {config.task}' looks longer"]


def spec_of(config: RunConfig) -> TaskSpec:
    """Return the contract of a run's task as its policy meets it; needs no GPU."""
    return build_environment(config.model_copy(update={"device": "cpu"}), 1, "shape").spec


def build_learner(config: RunConfig) -> Learner:
    """Build the learner of a run, with its worlds, from the configuration alone.

    Raises:
        UserError: parts of the configuration do not go together, or it needs more memory than the machine has.
    """
    cls = ALGORITHMS[config.algorithm]
    settings = cls.config_class(**config.algorithm_settings)
    refuse_what_does_not_fit(config, settings, spec_of(config))
    env = build_environment(config, settings.num_envs, "training worlds")
    learner = cls(
        env,
        settings,
        config.network,
        config.prior,
        generators(config.seeds, "learner"),
        generators(config.seeds, "prior"),
    )
    _set_gate(learner, config)
    return learner


def _set_gate(learner: Learner, config: RunConfig) -> None:
    """Give a learner the gate that its prior asks for, which is the same whatever seeds there are."""
    prior = config.prior.effective()
    if prior.trust != "gate" or learner.prior.transforms is None:
        return
    if config.network.recurrent:
        raise UserError("prior.trust=gate copies single steps, which a recurrent network cannot take; use mlp")
    if learner.replays and prior.replay == "stored":
        raise UserError("prior.trust=gate copies single steps, and a replay stores episodes; use prior.replay=sampled")
    certain = {name for name, weight in prior.weights.items() if weight == 1}
    if certain != set(prior.weights):
        worlds = make(config.task, _GATE_WORLDS, stream_seeds((0,), "gate"), config.task_settings, config.device)
        exchanged = any("agents" in name for name in prior.weights)
        gate = fit_gate(worlds, prior.doubt, certain, alike=not exchanged)
        learner.prior.gate = replace(gate, to_environment=learner.policy.head.to_environment)
