"""The final evaluation of a trained policy: greedy and stochastic returns, beside reference policies of the task."""

from __future__ import annotations

from collections.abc import Sequence
from operator import methodcaller
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from esp_cli.defaults import EPISODES, __version__
from esp_cli.networks.policy import Policy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.policies.statistics import EpisodeSpread, SeedSummary, spread_over_episodes, summarise
from esp_cli.training.build import (
    Controller,
    Episodes,
    PolicyController,
    ScriptedController,
    build_environment,
    generators,
    play,
)
from esp_cli.training.config import RunConfig, is_same
from esp_envs.base import BLIND
from esp_envs.errors import UserError
from esp_envs.registry import TASKS

_ROUGH_AGENT_STEPS, _ROUGH_ERROR = 5000, 0.1
"""Of each reference policy where a second has to do, and the largest standard error, as a share of their scale."""
_BLIND_EPISODES = 500
_STREAM = "judgement"  # names the worlds; the word decides the numbers of every final evaluation, so it stays
Metrics = dict[str, float | None]


class FinalEvaluation(BaseModel):
    """What a trained policy reaches on episodes of their own; files of older versions have fewer fields."""

    model_config = ConfigDict(frozen=True)

    esp_version: str | None = None  # of the program that played
    task: str
    task_version: int
    convention: str  # of its returns
    task_settings: dict[str, Any] = {}  # under which it was played
    source: str = ""  # where the policy was found
    step: int  # environment steps per seed behind the policy
    seeds: tuple[int, ...]
    episodes: int  # per seed, of each policy
    greedy: SeedSummary  # returns of the policy
    stochastic: SeedSummary  # returns of the policy with drawn actions
    anchors: dict[str, float]  # mean returns of reference policies: "random", "heuristic", other heuristics by name
    heuristics: tuple[str, ...] = ()  # of the task; the first is the one called "heuristic"
    roles: tuple[str, ...] = ()  # of the agents, where they have some
    metrics: Metrics  # the task's measures of the greedy policy
    metrics_per_seed: dict[str, tuple[float | None, ...]] = {}
    anchor_metrics: dict[str, Metrics] = {}  # of each reference policy
    parameters: dict[str, int] = {}  # weights of one seed's networks by name, which is "policy"
    flops_per_action: float | None = None  # of the matrix products behind one agent's action
    over_episodes: dict[str, EpisodeSpread] = {}  # of each reference policy, and of one seed's greedy and stochastic

    @property
    def scale(self) -> dict[str, float]:
        """The anchors by which returns are normalised; none where a return is a mean over unlike roles."""
        return {} if self.roles else self.anchors

    def is_of(self, config: RunConfig, episodes: int) -> bool:
        """Return whether this is what a run of a configuration came to, on so many episodes per seed."""
        numbers = [len(returns.per_seed) for returns in (self.greedy, self.stochastic)]
        told = (self.task, self.seeds, self.episodes, numbers)
        if told != (config.task, config.seeds, episodes, [len(config.seeds)] * 2) or self.step < config.steps:
            return False
        played = {"task_settings": self.task_settings} if self.task_settings else {}  # older versions did not tell them
        return is_same(config, config.model_dump(mode="json") | played)


def evaluate(trained: TrainedPolicy, episodes: int) -> FinalEvaluation:
    """Play `episodes` episodes per seed with the greedy and the stochastic policy, and with each reference policy.

    A seed that stopped in training has an early policy. Its numbers are NaN, as in the metrics of its run.
    """
    if episodes < 1:
        raise UserError(f"episodes is {episodes}; play at least one")
    seeds = trained.config.seeds
    greedy = play_batches(trained.config, PolicyController(trained.policy), "greedy", episodes)
    drawn = PolicyController(trained.policy, generators(seeds, _STREAM, "noise"))
    stochastic = play_batches(trained.config, drawn, "stochastic", episodes)
    for played in (greedy, stochastic):
        for numbers in (played.returns, *played.metrics.values()):
            numbers[list(trained.stopped)] = float("nan")
    one_world = build_environment(trained.config, 1, _STREAM, "shape")
    names, anchors = one_world.heuristics, play_references(trained.config, one_world.heuristics, episodes)
    spread = dict(anchors)
    if len(seeds) == 1 and not trained.stopped:
        spread |= {"greedy": greedy, "stochastic": stochastic}
    return FinalEvaluation(
        esp_version=__version__,
        task=trained.config.task,
        task_version=trained.spec.version,
        convention=trained.spec.convention,
        task_settings=trained.config.task_settings,
        source=str(trained.source),
        step=trained.step,
        seeds=seeds,
        episodes=episodes,
        greedy=summarise_returns(greedy.returns),
        stochastic=summarise_returns(stochastic.returns),
        anchors={name: float(played.returns.mean()) for name, played in anchors.items()},
        heuristics=names,
        roles=tuple(role.name for role in trained.spec.roles),
        metrics=_means(greedy),
        metrics_per_seed={name: summarise_returns(value).per_seed for name, value in greedy.metrics.items()},
        anchor_metrics={name: _means(played) for name, played in anchors.items()},
        parameters={"policy": sum(p.numel() for p in trained.policy.parameters()) // len(seeds)},
        flops_per_action=flops_per_action(trained.policy, one_world.reset().obs),
        over_episodes={name: spread_over_episodes(played.returns.flatten().cpu()) for name, played in spread.items()},
    )


def best_seed(trained: TrainedPolicy, episodes: int) -> int:
    """Return the seed with the largest mean greedy return over episodes that no evaluation uses."""
    if len(trained.config.seeds) == 1:
        return trained.config.seeds[0]
    returns = play_batches(trained.config, PolicyController(trained.policy), "selection", episodes).returns.mean(1)
    if len(trained.stopped) < len(returns):
        returns[list(trained.stopped)] = -torch.inf
    return trained.config.seeds[int(returns.argmax())]


def play_references(config: RunConfig, names: Sequence[str], episodes: int) -> dict[str, Episodes]:
    """Play the random policy and the task's heuristics: "random", "heuristic" for the first, others by name."""
    anchors = {"random": play_batches(config, ScriptedController(methodcaller("random_action")), "random", episodes)}
    for key, name in zip(("heuristic", *names[1:]), names, strict=False):
        anchors[key] = _play_heuristic(config, name, episodes)
    return anchors


def blind_anchor(config: RunConfig, version: int) -> dict[str, float]:
    """Return the mean return of a task's policy that sees nothing, by its name; none where this version has none."""
    config = config.model_copy(update={"seeds": config.seeds[:1], "device": "cpu"})
    world = build_environment(config, 1, _STREAM, "shape")
    if BLIND not in world.heuristics or world.spec.version != version:
        return {}
    return {BLIND: float(_play_heuristic(config, BLIND, _BLIND_EPISODES).returns.mean())}


def _play_heuristic(config: RunConfig, name: str, episodes: int) -> Episodes:
    return play_batches(config, ScriptedController(methodcaller("heuristic", name)), "heuristic", episodes)


def rough_anchors(config: RunConfig, episodes: int) -> dict[str, float]:
    """Return mean returns of a built-in task's reference policies, in about a second; none where that is too rough."""
    if not TASKS.ships(config.task):
        return {}
    config = config.model_copy(update={"seeds": config.seeds[:1], "device": "cpu"})
    world = build_environment(config, 1, _STREAM, "shape")
    episodes = min(episodes, _ROUGH_AGENT_STEPS // (world.spec.horizon * world.spec.num_agents))
    if world.spec.roles or not world.heuristics or episodes < 2:
        return {}
    names = [name for name in world.heuristics if name != BLIND]  # which is not the best, and no end of the scale
    played = {name: one.returns[0] for name, one in play_references(config, names, episodes).items()}
    anchors = {name: float(returns.mean()) for name, returns in played.items()}
    error = max(float(returns.std()) for returns in played.values()) / episodes**0.5
    return anchors if error < _ROUGH_ERROR * (max(anchors.values()) - anchors["random"]) else {}


@torch.no_grad()
def flops_per_action(policy: Policy, obs: Tensor) -> float:
    """Count the floating-point operations of matrix products by which a policy chooses one agent's action.

    What is done once for any number of observations, such as putting constrained weights together, does not count; nor
    does it count that equal pictures need to be encoded only once. `obs` is of one world [S, 1, N, D].
    """
    worlds, counts = 16, []  # many pictures, so that no odd number is rounded up
    for number in (worlds, 2 * worlds):
        noise = 1e-3 * torch.rand(len(obs), number, *obs.shape[2:], generator=torch.Generator().manual_seed(0))
        shown = obs + noise.to(obs)  # unlike pictures, and entries that are whole numbers stay above them
        with FlopCounterMode(display=False) as counter:
            policy.act(shown, policy.initial_memory(number, shown))
        counts.append(counter.get_total_flops())
    return (counts[1] - counts[0]) / (worlds * policy.num_agents * len(obs))


def summarise_returns(returns: Tensor) -> SeedSummary:
    """Summarise returns [S, episodes] by the mean of each seed."""
    return summarise(returns.mean(1).double().cpu().numpy())


def _means(episodes: Episodes) -> Metrics:
    known = {name: value[value.isfinite()] for name, value in episodes.metrics.items()}
    return {name: float(value.mean()) for name, value in known.items() if value.numel()}


def play_batches(config: RunConfig, controller: Controller, stream: str, episodes: int) -> Episodes:
    """Play episodes (so many per seed) in batches of worlds: a seed has the same ones beside any number of others."""
    parts = []
    for begin in range(0, episodes, EPISODES):
        env = build_environment(config, min(EPISODES, episodes - begin), _STREAM, stream, begin)
        parts.append(play(env, controller))
    return Episodes(
        torch.cat([p.returns for p in parts], 1),
        torch.cat([p.lengths for p in parts], 1),
        {name: torch.cat([p.metrics[name] for p in parts], 1) for name in parts[0].metrics},
    )
