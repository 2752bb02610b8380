"""`esp train`: what the options mean, what is refused before a folder is made, and how runs stop and go on."""

import json
import math
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from esp_cli import console
from esp_cli.algorithms.learner import Iteration
from esp_cli.algorithms.mappo import Mappo
from esp_cli.checking import SymmetryReport, measured
from esp_cli.policies.evaluation import rough_anchors
from esp_cli.reporting.live import LIVE
from esp_cli.run import Run
from esp_cli.training.checkpoint import load_checkpoint
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from tests.cli.running import DAMAGE, STEPS, TINY_OPTIONS, edit_config, esp, refused, train_tiny


def config_of(run: Path) -> dict[str, Any]:
    return RunFolder.open(run).config


def test_every_option_reaches_the_configuration(tmp_path: Path) -> None:
    run = train_tiny(
        tmp_path / "deep" / "run",
        *("--algo", "mappo", "--task", "predator-prey", "--prior", "consistency", "--transforms", "rot90,flip-x"),
        *("--set", "prior.consistency_coef=0.25", "--network", "gru", "--seed-list", "3,7", "--device", "cpu"),
        *("--set", "mappo.learning_rate=5e-4", "--set", "task.prey=fleeing"),
        steps="0.05k",
    )
    config = config_of(run)
    assert (config["task"], config["algorithm"], config["preset"]) == ("predator-prey", "mappo", "default")
    assert (config["steps"], config["seeds"], config["device"]) == (50, [3, 7], "cpu")
    assert (config["network"]["name"], config["network"]["hidden"]) == ("gru", [8])
    assert config["algorithm_settings"]["learning_rate"] == 5e-4
    assert config["task_settings"]["prey"] == "fleeing"
    prior = config["prior"]
    assert (prior["kind"], prior["transforms"], prior["consistency_coef"]) == ("consistency", "rot90,flip-x", 0.25)
    assert len(read_metrics(run / "metrics.jsonl")[-1]["train/return"]) == 2


def test_what_is_printed_where(tmp_path: Path) -> None:
    run = tmp_path / "run"
    told = esp("train", *TINY_OPTIONS, *STEPS, "--out", run)
    assert "training: mappo on navigation, prior esp (d4, c = 0.1), 1 seed(s), 150 steps each" in told.stderr
    assert "100%  150/150" in told.stderr
    assert f"next: esp eval {run}    esp render {run} -o out.gif" in told.stderr
    last = read_metrics(run / "metrics.jsonl")[-1]
    for mode in ("greedy", "stochastic"):
        (row,) = (line for line in told.stdout.splitlines() if f" {mode} " in line)
        assert f"{last[f'eval/return_{mode}'][0]:.2f}" in row
    assert "training" not in told.stdout
    assert "normalised" not in told.stdout + told.stderr, "two episodes give no scale"
    assert "no prior" in esp("train", *TINY_OPTIONS, *STEPS, "--out", tmp_path / "b", "--prior", "none").stderr


def test_a_return_has_its_normalised_score_beside_it(tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = ["evaluation.episodes=32" if "evaluation.episodes" in part else part for part in TINY_OPTIONS]
    told = esp("train", *options, *STEPS, "--out", run)
    anchors = rough_anchors(Run(run).config, 64)
    assert list(anchors) == ["random", "heuristic", "cover"]
    greedy = read_metrics(run / "metrics.jsonl")[-1]["eval/return_greedy"][0]
    score = (greedy - anchors["random"]) / (max(anchors.values()) - anchors["random"])
    (row,) = (line for line in told.stdout.splitlines() if " greedy " in line)
    assert f"{score:.2f}" in row
    assert f"normalised {score:.4g}" in told.stderr
    assert "normalised: 0 random, 1 the best heuristic" in told.stdout


@pytest.mark.parametrize(
    ("options", "idle"),
    [
        (["--prior", "none", "--set", "prior.transforms=c4"], "prior.transforms"),
        (["--set", 'prior.weights={"rot90":0.5}', "--set", "prior.doubt=2"], "prior.doubt, prior.weights"),
        (["--set", "prior.consistency_coef=0.2", "--transforms", "c4"], None),
        (["--set", "prior.replay=stored"], "prior.replay"),
        (["--set", "mappo.truncation=5", "--set", "mappo.critic_activation=tanh"], "mappo.truncation"),
        (["--set", "prior.trust=measured", "--set", 'prior.weights={"rot90":0.5}', "--transforms", "rot90"], None),
        (["--prior", "auto", "--set", "prior.doubt=4", "--set", "prior.fade=0.2"], None),
    ],
)
def test_a_setting_that_changes_nothing_beside_the_others_is_named(tmp_path: Path, options, idle) -> None:
    told = esp("train", *TINY_OPTIONS, "--steps", 50, *options, "--out", tmp_path / "run").stderr
    assert ("without effect" in told) == (idle is not None)
    assert idle is None or f"without effect beside the other settings: {idle}\n" in told
    assert ("broken" in told) == ("prior.trust=measured" in options)


def test_transforms_without_a_prior_and_options_of_other_programs_are_answered() -> None:
    assert "--prior none uses no symmetry" in refused("train", "--prior", "none", "--transforms", "c4")
    for option, told in {
        "--seed": "--seed-list 7",
        "--num-envs": "mappo.num_envs=64",
        "--wandb": "--track wandb",
    }.items():
        assert f"No such option: {option}; " in (message := refused("train", option, "3"))
        assert told in message
        assert told not in refused("eval", "navigation", option, "3"), "which has no such option"
    assert "did you mean 'navigation'?" in refused("train", "--task", "simple_spread")


def test_a_setting_of_a_small_file_that_changes_nothing_is_named_and_of_a_whole_one_is_not(tmp_path: Path) -> None:
    small = tmp_path / "small.json"
    small.write_text(json.dumps({"prior": {"kind": "none", "transforms": "c4"}}))
    told = esp("train", *TINY_OPTIONS, "--steps", 50, "--config", small, "--out", tmp_path / "a").stderr
    assert "without effect beside the other settings: prior.transforms\n" in told
    assert "without effect" not in esp("train", "--config", tmp_path / "a", "--out", tmp_path / "b").stderr


def test_what_was_measured_before_training_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("rot90", "rot180", "rot270", "flip-x", "flip-diagonal", "flip-y", "flip-antidiagonal")
    gaps = (0.0, math.inf, 0.0, 0.1, 0.5, 0.5, 0.5)
    monkeypatch.setattr(measured, "_breaking", lambda *_: tuple(zip(names, gaps, strict=True)))
    told = esp("train", *TINY_OPTIONS, "--steps", 50, "--prior", "auto", "--out", tmp_path / "auto").stderr
    left_out = "1 of 7 elements left out, not covered or broken by an unknown size: rot180"
    weighed = f"prior esp (d4, c = 0.1), {left_out}, 4 of 7 elements broken and weighed 0.018 to 0.45"
    assert f"{weighed}, fading out over 50% of the run, 1 seed(s)" in told
    monkeypatch.setattr(measured, "_breaking", lambda *_: tuple((name, 0.0) for name in names))
    assert "broken" not in esp("train", *TINY_OPTIONS, "--steps", 50, "--prior", "auto", "--out", tmp_path / "b").stderr
    nothing = SymmetryReport("navigation", "paired states", "d4", "c1", "", (), {})
    monkeypatch.setattr(measured, "check_symmetry", lambda *_: nothing)
    told = esp("train", *TINY_OPTIONS, "--steps", 50, "--transforms", "discovered", "--out", tmp_path / "c").stderr
    assert "no prior (no symmetry was discovered)" in told


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--transforms", "c8"], "c8 cannot act on navigation: action 'left' turned by 45 degrees is no action"),
        (["--transforms", "so2", "--set", "prior.copies=all", "--set", "task.actions=continuous"], "finite group"),
        (["--task", "navigaton"], "unknown task 'navigaton'; did you mean 'navigation'?"),
        (["--algo", "MAPPO"], "unknown algorithm 'MAPPO'; did you mean 'mappo'?"),
        (["--task", "nowhere:Task"], "No module named 'nowhere'; it is looked for in /"),
        (
            ["--prior", "some"],
            "Invalid value for '--prior': 'some' is not one of 'esp', 'none', 'augment', 'consistency', 'auto'",
        ),
        (["--network", "gru", "--set", "mappo.num_steps=10"], "set mappo.num_steps to a multiple of 25"),
        (["--device", "tpu"], "'tpu' is not one of 'auto', 'cpu', 'cuda'"),
        (["--set", "mappo.huber_delta=1e39"], "it has to be a finite number of at most 1e+30"),
        (["--set", "task.prey=still"], "unknown setting 'task.prey'"),
        (["--task", "predator-prey", "--set", "task.control=both", "--set", "task.prey=still"], "leave prey out"),
    ],
)
def test_what_is_wrong_is_told_in_one_sentence_and_leaves_no_folder(tmp_path, options, sentence):
    assert sentence in refused("train", *STEPS, "--out", tmp_path / "run", *options)
    assert not (tmp_path / "run").exists()


def test_a_gpu_that_is_not_there_is_told(copied: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    missing = "there is no CUDA device here; use --device cpu or auto"
    assert refused("train", "--device", "cuda", "--out", tmp_path / "run") == missing
    assert not (tmp_path / "run").exists()
    assert missing in refused("train", "--resume", edit_config(copied, device="cuda"))
    assert config_of(train_tiny(tmp_path / "auto", "--device", "auto", steps=50))["device"] == "cpu"


def test_a_place_that_is_taken_is_refused_and_stays_as_it_was(copied: Path, tmp_path: Path) -> None:
    before = {file: file.read_bytes() for file in copied.rglob("*") if file.is_file()}
    sentence = refused("train", *TINY_OPTIONS, *STEPS, "--out", copied)
    assert sentence == f"{copied} exists: resume with esp train --resume {copied} or choose another --out"
    assert {file: file.read_bytes() for file in copied.rglob("*") if file.is_file()} == before
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("\\section{Symmetry}")
    assert "is not empty and no run folder" in refused("train", *STEPS, "--out", tmp_path / "thesis")
    assert [entry.name for entry in (tmp_path / "thesis").iterdir()] == ["chapter.tex"]


def test_a_finished_run_has_nothing_to_resume_and_no_policy_file_is_left_out(copied: Path) -> None:
    assert esp("train", "--resume", copied).stderr == f"{copied} is complete at 150 steps\n"
    policy = (copied / "policy.safetensors").read_bytes()
    (copied / "policy.safetensors").unlink()  # as if killed between the last checkpoint and the policy file
    esp("train", "--resume", copied)
    assert (copied / "policy.safetensors").read_bytes() == policy


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_after_the_iteration_and_the_run_goes_on_to_the_same_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finished: Path, number: signal.Signals
) -> None:
    update = console.TrainingProgress.update

    def interrupted(self: console.TrainingProgress, done: int, metrics: dict[str, float]) -> None:
        update(self, done, metrics)
        if done == 50:
            signal.raise_signal(number)

    run = tmp_path / "run"
    before = signal.getsignal(number)
    if before is signal.SIG_IGN:
        pytest.skip("these tests run under nohup, and so does what they start")
    with monkeypatch.context() as patch:
        patch.setattr(console.TrainingProgress, "update", interrupted)
        stopped = esp("train", "--network", "mlp", *TINY_OPTIONS, *STEPS, "--seed-list", "3,7", "--out", run, code=130)
    assert signal.getsignal(number) is before
    assert "stopping after this iteration" in stopped.stderr
    assert stopped.stderr.endswith(f"stopped at 50 steps; continue with: esp train --resume {run}\n")
    assert stopped.stdout == ""
    resumed = esp("train", "--resume", run)
    assert "resuming at 50" in resumed.stderr
    ends = [load_checkpoint(r / "policy.safetensors", format_name="esp-policy")[0] for r in (run, finished)]
    assert all(torch.equal(tensor, ends[1][name]) for name, tensor in ends[0].items())


def test_a_second_interrupt_stops_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def impatient(self: console.TrainingProgress, done: int, metrics: dict[str, float]) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(console.TrainingProgress, "update", impatient)
    stopped = esp("train", *TINY_OPTIONS, *STEPS, "--out", tmp_path / "run", code=130)
    assert stopped.stderr.endswith("interrupted\n")


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--steps", "3M"], "--steps"),
        (["--steps", "1M"], "--steps"),
        (["--seeds", "10", "--out", "elsewhere"], "--seeds, --out"),
        (["--task", "navigation", "--prior", "none"], "--task, --prior"),
        (["-a", "mappo", "--preset", "paper", "--transforms", "c4"], "--algo, --preset, --transforms"),
        (["--network", "gru", "--transforms", "c4"], "--transforms, --network"),
        (["--device", "cpu", "--set", "mappo.gamma=0.9"], "--set"),
    ],
)
def test_options_that_a_resumed_run_would_ignore_are_refused(copied: Path, options: list[str], named: str) -> None:
    sentence = f"--resume continues a run with its own settings; leave out {named}, or start a new run"
    assert refused("train", "--resume", copied, *options) == sentence


def test_tensorboard_may_be_asked_for_on_resuming(copied: Path) -> None:
    pytest.importorskip("tensorboard")
    (copied / "policy.safetensors").unlink()
    esp("train", "--resume", copied, "--track", "tensorboard")
    assert (copied / "tensorboard").is_dir()


@pytest.mark.parametrize(
    "kind", ["truncated checkpoints", "config of a newer version", "a task nobody has", "another number of seeds"]
)
def test_a_damaged_run_is_not_resumed(copied: Path, kind: str) -> None:
    damage, sentence = DAMAGE[kind]
    assert sentence in refused("train", "--resume", damage(copied))


def test_a_policy_file_and_damaged_metrics_are_not_resumed(copied: Path) -> None:
    assert "is a file, not a run folder" in refused("train", "--resume", copied / "policy.safetensors")
    metrics = copied / "metrics.jsonl"
    metrics.write_text("sleep less\n" + metrics.read_text())
    assert "line 1 is not a row of metrics" in refused("train", "--resume", copied)


def test_a_run_of_which_a_seed_stopped_is_summed_up_over_the_others(tmp_path, monkeypatch):
    iterate = Mappo.iterate

    def broken(self: Mappo, progress: float) -> Iteration:
        return replace(iterate(self, progress), finite=torch.tensor([False, True]))

    monkeypatch.setattr(Mappo, "iterate", broken)
    told = esp("train", "--network", "mlp", *TINY_OPTIONS, *STEPS, "--seed-list", "3,7", "--out", tmp_path / "run")
    assert "seed 3 stopped at step 50" in told.stderr
    value = read_metrics(tmp_path / "run" / "metrics.jsonl")[-1]["eval/return_greedy"]
    assert value[0] is None
    (row,) = (line for line in told.stdout.splitlines() if " greedy " in line)
    assert [cell.strip() for cell in row.strip("│").split("│")] == ["greedy", f"{value[1]:.2f}", "1"]
    monkeypatch.undo()
    (cell,) = json.loads(esp("report", tmp_path / "run", "--json", "-").stdout)["cells"]
    returns = cell["summary"]["returns"]
    assert returns["per_seed"] == [None, pytest.approx(value[1], abs=1e-4)]
    assert returns["sem"] is None


def test_a_run_whose_every_seed_stopped_ends_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    iterate = Mappo.iterate
    monkeypatch.setattr(Mappo, "iterate", lambda self, p: replace(iterate(self, p), finite=torch.tensor([False])))
    told = esp("train", *TINY_OPTIONS, *STEPS, "--out", tmp_path / "run", code=2)
    assert told.stderr.splitlines()[-1].startswith("error: every seed stopped on a number that is not finite")


def test_a_moved_run_goes_on_in_its_new_place(copied: Path, tmp_path: Path) -> None:
    shutil.move(copied, tmp_path / "moved")
    assert "is complete" in esp("train", "--resume", tmp_path / "moved").stderr


def test_a_run_that_ends_within_its_warm_up_says_so(tmp_path: Path) -> None:
    words = ("train", "--algo", "qmix", "--set", "qmix.num_envs=1", "--set", "evaluation.episodes=1", "--steps")
    warm = "nothing was learned: the run ended within its warm-up"
    assert warm in esp(*words, 100, "--out", tmp_path / "short").stderr
    longer = ("--set", "qmix.warmup_episodes=1", "--set", "qmix.batch_episodes=1", "--set", "network.hidden=[8]")
    assert warm not in esp(*words, 100, *longer, "--out", tmp_path / "longer").stderr


def test_a_page_to_watch_shows_curve_and_policy_and_changes_nothing(tmp_path: Path) -> None:
    plain = train_tiny(tmp_path / "plain", steps=120)
    told = esp("train", "--resume", plain, "--watch")
    assert "complete" in told.stderr
    watched = train_tiny(tmp_path / "watched", "--watch", steps=120)
    page = (watched / LIVE).read_text()
    assert page.count("data:image/svg+xml;base64,") == page.count("data:image/gif;base64,") == 1
    assert "The run is complete" in page
    assert "120 of 120 steps" in page, "though the last update ends at 150"
    assert 'http-equiv="refresh"' not in page
    assert not (plain / LIVE).exists(), "off by default"
    same = [(run / "policy.safetensors").read_bytes() for run in (plain, watched)]
    assert same[0] == same[1]


def test_a_page_that_cannot_be_drawn_is_told_once_and_stops_no_run(tmp_path, monkeypatch):
    def fails(*_: object, **__: object) -> None:
        raise MemoryError("no room for pixels")

    monkeypatch.setattr("esp_cli.reporting.live.draw_film", fails)
    said = esp("train", "--steps", 100, *TINY_OPTIONS, "--out", tmp_path / "run", "--watch").stderr
    assert said.count("tracking with --watch ended: it cannot write (no room for pixels); the run goes on") == 1
    assert (tmp_path / "run" / "policy.safetensors").is_file()


def test_a_run_of_a_gpu_goes_on_without_one(copied: Path) -> None:
    edit_config(copied, device="cuda")
    (copied / "policy.safetensors").unlink()
    assert "there is no CUDA device here" in refused("train", "--resume", copied)
    assert "resuming at 150" in esp("train", "--resume", copied, "--device", "cpu").stderr
    assert config_of(copied)["device"] == "cuda", "what it was begun on"
