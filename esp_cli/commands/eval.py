"""`esp eval`: judge a trained policy beside the random and the heuristic policy."""

from __future__ import annotations

from typing import Any

from esp_cli import console
from esp_cli.commands.options import EpisodesOption, JsonOption, PolicyArgument

EPILOG = """Examples:\n
    esp eval runs/cn-mappo\n
    esp eval runs/cn-mappo --episodes 320 --json result.json"""


def evaluate(policy: PolicyArgument, episodes: EpisodesOption = 320, json: JsonOption = None) -> None:
    """Play episodes greedily and stochastically; print mean, s.e.m., 95 % interval, anchors and task metrics."""
    from esp_cli.experiments.judgement import judge
    from esp_cli.training.loading import load_policy

    trained = load_policy(policy)
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
    rows += [(f"anchor: {name}", f"{value:.2f}", "-") for name, value in result["anchors"].items()]
    title = (
        f"{result['task']} version {result['task_version']} after {console.format_count(result['step'])} steps, "
        f"{len(result['seeds'])} seed(s) x {result['episodes']} episodes"
    )
    caption = f"convention {result['convention']}; mean ± s.e.m. and 95 % bootstrap interval over seeds"
    console.table(("policy", "episode return>", "95 % interval>"), rows, title=title, caption=caption)
    metrics = [(name, f"{value:.4f}") for name, value in result["metrics"].items()]
    console.table(("metric (greedy, mean over steps)", "value>"), metrics)
