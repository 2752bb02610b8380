"""MADDPG and QMIX from the command line: trained, resumed, judged, drawn and compared like MAPPO."""

import json
from pathlib import Path

import pytest

from esp_cli.training.checkpoint import load_checkpoint
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from tests.cli.running import esp, refused


def options(algorithm: str) -> list[str]:
    """Settings of a run of 50 steps an iteration that takes milliseconds."""
    settings = {
        f"{algorithm}.num_envs": 2,
        f"{algorithm}.batch_episodes": 2,
        f"{algorithm}.replay_episodes": 20,
        f"{algorithm}.warmup_episodes": 1,
        "network.hidden": [8],
        "evaluation.episodes": 2,
        "evaluation.every_steps": 100,
    }
    given = [part for name, value in settings.items() for part in ("--set", f"{name}={json.dumps(value)}")]
    return ["--algo", algorithm, *given, "--seed-list", "3,7", "--steps", "200"]


@pytest.mark.parametrize(
    ("algorithm", "more"),
    [
        ("maddpg", []),
        ("maddpg", ["--network", "gru", "--set", "task.actions=continuous", "--transforms", "o2"]),
        ("maddpg", ["--task", "predator-prey", "--set", "prior.replay=stored"]),
        ("qmix", []),
        ("qmix", ["--network", "gru", "--task", "predator-prey"]),
        ("qmix", ["--task", "formation", "--set", "task.horizon=5"]),
        ("qmix", ["--preset", "paper"]),
    ],
)
def test_train_eval_render_and_report(tmp_path: Path, algorithm: str, more: list[str]) -> None:
    run, film, result = tmp_path / "run", tmp_path / "out.gif", tmp_path / "result.json"
    esp("train", *options(algorithm), *more, "--out", run)
    esp("eval", run, "--episodes", 3, "--json", result)
    verdict = json.loads(result.read_text())
    assert len(verdict["greedy"]["per_seed"]) == 2
    assert verdict["greedy"]["per_seed"] != verdict["stochastic"]["per_seed"]
    esp("render", run, "-o", film, "--episodes", 1, "--seed", 7)
    assert film.stat().st_size > 1000
    esp("report", run, "--json", tmp_path / "report.json")


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_a_run_stopped_and_resumed_equals_one_run_through(tmp_path, algorithm, monkeypatch):
    straight, halted = tmp_path / "a", tmp_path / "b"
    esp("train", *options(algorithm), "--out", straight)
    with monkeypatch.context() as patch:
        patch.setattr("esp_cli.training.trainer.CHECKPOINT_SECONDS", 0.0)
        patch.setattr("esp_cli.training.trainer.CHECKPOINT_SPACING", 0)
        patch.setattr(RunFolder, "write_policy", lambda *anything: None)  # as if killed before: then checkpoints go
        esp("train", *options(algorithm), "--out", halted)
    for file in (halted / "checkpoints").glob("*-final*"):
        file.unlink()
    newest = RunFolder.open(halted).checkpoints()[-1]
    tensors, meta = load_checkpoint(newest)
    assert meta["step"] < 200
    assert tensors["replay.obs"].shape[1] == meta["step"] // 25, "the filled part of the replay, in episodes"
    esp("train", "--resume", halted)
    (ours,), (theirs,) = (
        [f for f in RunFolder.open(run).checkpoints() if "final" in f.name] for run in (straight, halted)
    )
    assert load_checkpoint(ours)[0].keys() == load_checkpoint(theirs)[0].keys()
    assert all((a == load_checkpoint(theirs)[0][name]).all() for name, a in load_checkpoint(ours)[0].items())
    assert not any(name.startswith("replay") for name in load_checkpoint(ours)[0])

    def untimed(run: Path) -> list[dict[str, object]]:
        rows = read_metrics(run / "metrics.jsonl")
        return [{name: x for name, x in row.items() if not name.startswith("time/")} for row in rows]

    assert untimed(straight) == untimed(halted)


def test_what_does_not_go_together_is_refused_before_a_folder_is_made(tmp_path: Path) -> None:
    run = tmp_path / "run"
    cases = {
        ("qmix", "task.actions=continuous"): "qmix chooses among discrete actions",
        ("qmix", "prior.transforms=c8"): "c8",
        ("maddpg", "maddpg.tau=0"): "bad value 0 for 'maddpg.tau'",
        ("maddpg", "qmix.double_q=false"): "cannot set 'qmix.double_q'",
    }
    for (algorithm, setting), sentence in cases.items():
        assert sentence in refused("train", *options(algorithm), "--set", setting, "--out", run)
    assert not run.exists()
