"""`esp eval`: judge a trained policy beside the random and the heuristic policy."""

from __future__ import annotations

from typing import Any

from esp_cli import console
from esp_cli.commands.options import (
    BoxAlgoOption,
    BoxPriorOption,
    EpisodesOption,
    JsonOption,
    PhysicsOption,
    PolicyArgument,
    TaskSetOption,
    parse_task_settings,
)

EPILOG = """Examples:\n
    esp eval navigation --algo mappo --prior none\n
    esp eval runs/cn-mappo\n
    esp eval runs/cn-mappo --episodes 320 --json result.json\n
    esp eval runs/fc-mappo --physics mujoco-3d --set task.sensor_noise_m=0.005"""


def evaluate(
    policy: PolicyArgument,
    episodes: EpisodesOption = 320,
    physics: PhysicsOption = None,
    settings: TaskSetOption = None,
    algo: BoxAlgoOption = None,
    prior: BoxPriorOption = None,
    json: JsonOption = None,
) -> None:
    """Play episodes greedily and stochastically; print mean, s.e.m., 95 % interval, anchors and task metrics.

    A policy may be judged under other settings of its task than it was trained under: another physics, more noise.
    """
    from esp_cli.deploy.box import open_policy
    from esp_cli.evaluation.final import judge
    from esp_cli.training.loading import transfer

    trained = transfer(open_policy(policy, algo, prior), parse_task_settings(settings or [], physics))
    for text in trained.notes:
        console.note(text)
    result = judge(trained, episodes)
    if json != "-":
        _print(result)
    if json is not None:
        console.write_json(json, result)


def _print(result: dict[str, Any]) -> None:
    rows = []
    for mode in ("greedy", "stochastic"):
        verdict = result[mode]
        interval = console.format_interval(verdict["ci95"]) if verdict["ci95"] else "-"
        rows.append((mode, console.format_mean(verdict["mean"], verdict["sem"]), interval))
    labels = {"random": "random", "heuristic": f"heuristic {result['heuristics'][0]}"}
    names = {name: labels.get(name, f"heuristic {name}") for name in result["anchors"]}
    rows += [(names[name], f"{value:.2f}", "-") for name, value in result["anchors"].items()]
    title = (
        f"{result['task']} version {result['task_version']} after {console.format_count(result['step'])} steps, "
        f"{len(result['seeds'])} seed(s) x {result['episodes']} episodes"
    )
    caption = f"convention {result['convention']}; mean ± s.e.m. and 95 % bootstrap interval over seeds"
    console.table(("policy", "episode return>", "95 % interval>"), rows, title=title, caption=caption)
    metrics = [
        (metric, f"{value:.4f}", *(f"{result['anchor_metrics'][name][metric]:.4f}" for name in names))
        for metric, value in result["metrics"].items()
    ]
    console.table(("metric", "greedy policy>", *(f"{label}>" for label in names.values())), metrics)
