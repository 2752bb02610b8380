"""`esp eval`: play episodes with a trained policy, and with the random and the heuristic policies."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from typer import Option

from esp_cli import console
from esp_cli.commands import options
from esp_cli.defaults import EPISODES

if TYPE_CHECKING:
    from esp_cli.policies.evaluation import FinalEvaluation
    from esp_cli.policies.statistics import EpisodeSpread, SeedSummary

_AGENT_STEPS = 100_000  # of each policy, beyond which fewer episodes are played: a bundled policy of robots takes 20 s
EPILOG = """Examples:\n
    esp eval navigation --algo mappo --prior none\n
    esp eval runs/cn-mappo\n
    esp eval runs/cn-mappo --episodes 320 --json result.json\n
    esp eval runs/fc-mappo --physics mujoco-3d --set task.sensor_noise_m=0.005"""


def evaluate(
    policy: options.PolicyArgument,
    task: options.OwnTaskOption = None,
    episodes: Annotated[
        int | None,
        Option(
            "--episodes",
            "-e",
            min=1,
            max=1_000_000,
            help="Episodes per seed and policy; by default fewer if they are long or have many agents.",
            show_default=str(EPISODES),
        ),
    ] = None,
    physics: options.PhysicsOption = None,
    settings: options.TaskSetOption = None,
    algo: options.BundledAlgoOption = None,
    network: options.OwnNetworkOption = None,
    prior: options.BundledPriorOption = None,
    json: options.JsonOption = None,
) -> None:
    """Play episodes greedily and stochastically; print mean, s.e.m., 95 % interval, reference policies and metrics.

    The task may have other settings than in training: another physics, more noise.
    """
    from esp_cli.policies.evaluation import evaluate as evaluate_policy
    from esp_cli.policies.loading import open_policy

    options.register_named(task, [algo], network)
    changed = options.parse_task_settings(settings or [], physics)
    trained = open_policy(policy, algo, prior).transfer(changed)
    options.note_idle_settings(trained.config.task, changed, trained.config.task_settings)
    options.refuse_unused([trained.config], task, [algo], network)
    for text in trained.notes:
        console.note(text)
    usual = max(1, min(EPISODES, _AGENT_STEPS // (trained.spec.horizon * trained.spec.num_agents)))
    result = evaluate_policy(trained, episodes or usual)
    if not episodes and result.episodes < EPISODES:
        console.note(f"episodes are long: {result.episodes} each, not {EPISODES}; --episodes {EPISODES} for less error")
    source = trained.source
    console.result(json, result, lambda: _print(result, source.stem if source.is_file() else str(source)))


def _print(result: FinalEvaluation, policy: str) -> None:
    from esp_cli.policies.statistics import normalised

    has_scale = normalised(0.0, result.scale) is not None

    def row(label: str, mean: float | None, error: SeedSummary | EpisodeSpread) -> tuple[str, ...]:
        scaled = None if mean is None else normalised(mean, result.scale)
        score = "-" if scaled is None else f"{scaled:.2f}"
        return label, console.format_mean(mean, error.sem), console.format_interval(error.ci95), *[score] * has_scale

    names = {"random": "random", "heuristic": f"heuristic {''.join(result.heuristics[:1])}"}
    names = {key: names.get(key, f"heuristic {key}") for key in result.anchors}
    policies = {"greedy": result.greedy, "stochastic": result.stochastic}
    # of one seed the error is over episodes; of one that stopped there is neither
    rows = [row(mode, own.mean, result.over_episodes.get(mode, own)) for mode, own in policies.items()]
    rows += [row(names[key], value, result.over_episodes[key]) for key, value in result.anchors.items()]
    stopped = result.greedy.per_seed.count(None)
    title = (
        f"{policy} on {result.task} version {result.task_version} after {console.format_count(result.step)} steps, "
        f"{len(result.seeds)} seed(s){f' ({stopped} stopped)' if stopped else ''} x {result.episodes} episodes"
    )
    over = (
        f"over {result.episodes} episodes of one seed"
        if len(result.seeds) == 1
        else "over seeds, of reference policies over episodes"
    )
    caption = f"convention {result.convention}; mean ± s.e.m. and 95 % interval {over}"
    if 1 < len(result.seeds) < 5:
        caption += "; so few seeds make it too narrow"
    if has_scale:
        caption += "; normalised: 0 random, 1 the best heuristic"
    headings = ("policy", "episode return>", "95 % interval>", *["normalised>"] * has_scale)
    console.table(headings, rows, title=title, caption=caption)
    metrics = [
        (metric, f"{value:.4f}", *(f"{result.anchor_metrics[key].get(metric, math.nan):.4f}" for key in names))
        for metric, value in result.metrics.items()
    ]
    if metrics:  # of seeds that all stopped there are none
        console.table(("metric", "greedy policy>", *(f"{label}>" for label in names.values())), metrics)
