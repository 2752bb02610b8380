"""`esp eval`: play episodes with a trained policy, and with the random and the heuristic policies."""

from __future__ import annotations

from typing import TYPE_CHECKING

from esp_cli import console
from esp_cli.commands.options import (
    BundledAlgoOption,
    BundledPriorOption,
    EpisodesOption,
    JsonOption,
    OwnNetworkOption,
    OwnTaskOption,
    PhysicsOption,
    PolicyArgument,
    TaskSetOption,
    parse_task_settings,
    register_learners,
    register_tasks,
)

if TYPE_CHECKING:
    from esp_cli.evaluation.final import FinalEvaluation

EPILOG = """Examples:\n
    esp eval navigation --algo mappo --prior none\n
    esp eval runs/cn-mappo\n
    esp eval runs/cn-mappo --episodes 320 --json result.json\n
    esp eval runs/fc-mappo --physics mujoco-3d --set task.sensor_noise_m=0.005"""


def evaluate(
    policy: PolicyArgument,
    task: OwnTaskOption = None,
    episodes: EpisodesOption = 320,
    physics: PhysicsOption = None,
    settings: TaskSetOption = None,
    algo: BundledAlgoOption = None,
    network: OwnNetworkOption = None,
    prior: BundledPriorOption = None,
    json: JsonOption = None,
) -> None:
    """Play episodes greedily and stochastically; print mean, s.e.m., 95 % interval, reference policies and metrics.

    The task may have other settings than in training: another physics, more noise.
    """
    from esp_cli.deploy.bundled import open_policy
    from esp_cli.evaluation.final import evaluate as evaluate_policy
    from esp_cli.training.loading import transfer

    register_tasks(task)
    register_learners([algo], network or [])
    trained = transfer(open_policy(policy, algo, prior), parse_task_settings(settings or [], physics))
    for text in trained.notes:
        console.note(text)
    result = evaluate_policy(trained, episodes)
    if json != "-":
        _print(result)
    if json is not None:
        console.write_json(json, result)


def _print(result: FinalEvaluation) -> None:
    rows = []
    for mode, returns in (("greedy", result.greedy), ("stochastic", result.stochastic)):
        rows.append((mode, console.format_mean(returns.mean, returns.sem), console.format_interval(returns.ci95)))
    first = "".join(result.heuristics[:1])
    names = {"random": "random", "heuristic": f"heuristic {first}"}
    names = {key: names.get(key, f"heuristic {key}") for key in result.anchors}
    rows += [(names[key], f"{value:.2f}", "-") for key, value in result.anchors.items()]
    title = (
        f"{result.task} version {result.task_version} after {console.format_count(result.step)} steps, "
        f"{len(result.seeds)} seed(s) x {result.episodes} episodes"
    )
    caption = f"convention {result.convention}; mean ± s.e.m. and 95 % bootstrap interval over seeds"
    console.table(("policy", "episode return>", "95 % interval>"), rows, title=title, caption=caption)
    metrics = [
        (metric, f"{value:.4f}", *(f"{result.anchor_metrics[key][metric]:.4f}" for key in names))
        for metric, value in result.metrics.items()
    ]
    console.table(("metric", "greedy policy>", *(f"{label}>" for label in names.values())), metrics)
