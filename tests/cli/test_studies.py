"""`esp ablate` and `esp reproduce`: plans, costs, and studies that survive being killed."""

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from esp_cli import app, console
from esp_cli.commands import studying
from esp_cli.commands.study_options import StudyChoices, parse_names, parse_study_steps
from esp_cli.commands.study_progress import StudyProgress, share, whole_status
from esp_cli.commands.studying import open_resources, run_cells
from esp_cli.files.opening import holding
from esp_cli.studies.engine import Job, LocalEngine
from esp_cli.studies.kinds import KINDS
from esp_cli.studies.scheduler import Scheduler
from esp_cli.studies.study import StudyFolder
from esp_cli.studies.symmetry import METHODS
from esp_cli.training import trainer
from esp_cli.training.folder_names import FINAL
from esp_cli.training.metrics import read_metrics
from esp_envs.errors import UserError
from esp_envs.installed import install
from tests.cli.running import TINY_OPTIONS, esp, refused, train_tiny
from tests.forks import fork, killed, said, wait
from tests.studies.small_studies import small_study, stand_in

TINY = ("reproduce", "table1", "--tasks", "navigation", "--algos", "mappo", "--seeds", "2", "--episodes", "4")
KILLED_STEPS = 1500
"""Thirty iterations: time enough to kill it twice."""


def test_names_and_steps_are_read_from_lists() -> None:
    assert parse_names(["mappo, qmix", "maddpg"]) == ("mappo", "qmix", "maddpg")
    assert parse_names(None) is None
    with pytest.raises(ValueError, match="',,' names nothing; name something, or leave the option out"):
        parse_names([",,"])
    names = parse_names(["none,rot90,rot90, rot180", "C4, drawn"], KINDS["ablate-transforms"].variants)
    assert names == ("none", "rot90", "rot90, rot180", "C4, drawn")
    assert parse_names(["plain,sets,ESP"], METHODS) == ("plain", "sets", "ESP")
    assert parse_names(["plain, sets, ESP"], METHODS) == ("plain", "sets, ESP")
    steps = parse_study_steps(["500k,formation=1M", "3M"])
    assert steps == ((None, 500_000), ("formation", 1_000_000), (None, 3_000_000))
    with pytest.raises(ValueError, match="'soon' is not a number of steps"):
        parse_study_steps(["formation=soon"])


def test_a_dry_run_states_time_makes_nothing_and_refuses_what_the_run_refuses(tmp_path: Path) -> None:
    out, plan = tmp_path / "s", tmp_path / "plan.json"
    assert "is not empty and no study" in refused(*TINY, *TINY_OPTIONS, "--out", Path(__file__).parent, "--dry-run")
    told = esp(*TINY, "--steps", 100, *TINY_OPTIONS, "--out", out, "--dry-run", "--jobs", 2, "--json", plan)
    assert not out.exists()
    found = json.loads(plan.read_text())
    assert [run["status"] for run in found["runs"]] == ["new", "new"]
    first, second = (run["seconds"] for run in found["runs"])
    assert found["core_seconds"] == pytest.approx(first + second)
    assert found["seconds"] == pytest.approx(max(first, second))
    assert "2 runs to do:" in told.stdout
    assert "with 2 side by side" in told.stdout


@pytest.mark.usefixtures("forked_jobs")
def test_a_setting_that_no_run_of_a_study_heeds_is_named(tmp_path: Path) -> None:
    words = ("ablate", "prior", "--steps", 100, "--seeds", 1, *TINY_OPTIONS, "--out", tmp_path / "s", "--dry-run")
    idle, heeded = ("--set", "prior.replay=stored"), ("--set", "prior.consistency_coef=0")
    told = esp(*words, *idle, *heeded).stderr
    assert "without effect beside the other settings: prior.replay\n" in told


def test_a_study_runs_from_a_command_to_a_page_and_a_small_file(tmp_path: Path) -> None:
    out = tmp_path / "s"
    told = esp(*TINY, "--steps", 100, *TINY_OPTIONS, "--out", out, "--jobs", 1)
    assert "2 runs, 0 of them finished, 1 side by side" in told.stderr
    assert "navigation, 100" in told.stdout
    assert f"next: esp report {out}" in told.stderr
    folder = StudyFolder.open(out)
    study = folder.study
    typed = map(str, ("esp", *TINY, "--steps", 100, *TINY_OPTIONS, "--out", out, "--jobs", 1))
    assert study.command == shlex.join(typed)
    assert json.loads((folder.run_path(study.cells[0]) / FINAL).read_text())["episodes"] == 4, (
        "and not that of training"
    )
    # the run is the one that training by itself gives
    alone = train_tiny(tmp_path / "alone", "--seeds", "2", "--prior", "none", steps=100)
    policy = "policy.safetensors"
    assert (out / "runs" / study.cells[0].name / policy).read_bytes() == (alone / policy).read_bytes()
    again = esp(*TINY, "--steps", 100, *TINY_OPTIONS, "--out", out, "--json", "-")
    assert "2 of them finished" in again.stderr
    results = json.loads(again.stdout)
    assert [cell["status"] for cell in results["cells"]] == ["finished"] * 2
    copied = (*TINY, "--steps", 100, *TINY_OPTIONS, "--out", tmp_path / "copied", "--reuse", out)
    assert "0 runs to do" in esp(*copied, "--dry-run").stdout
    assert not (tmp_path / "copied").exists()
    taken = esp(*copied)
    assert taken.stderr.count("taking over") == 2
    assert "2 runs, 2 of them finished" in taken.stderr
    assert "--reuse gives nothing" not in esp(*copied).stderr, "all is there"
    fewer = [*TINY[:-1], 2, "--steps", 100, *TINY_OPTIONS, "--out", tmp_path / "fewer", "--reuse", out]
    assert "--reuse gives nothing: no finished run there" in esp(*fewer).stderr
    small = tmp_path / "small.json"
    report = esp("report", out, "--films", "--results", small)
    assert [cell.pop("summary")["returns"]["per_seed"] for cell in results["cells"]] == [
        cell["returns"]["greedy"] for cell in results["cells"]
    ]
    assert json.loads(small.read_text()) == results
    assert f"report -> {out / 'report' / 'report.html'}" in report.stderr
    assert (out / "report" / "report.html").read_text().count("data:image/gif") == 2
    assert "| navigation, 100 |" in (out / "report" / "report.md").read_text()


@pytest.mark.usefixtures("forked_jobs")
def test_a_study_of_breakings_is_run_in_pieces_and_runs_once_what_trains_the_same(tmp_path: Path) -> None:
    out = tmp_path / "s"
    study = ("ablate", "breaking", "--tasks", "navigation", "--methods", "ESP,measured weights", "--seeds", "2")
    study += ("--episodes", "4", "--steps", 100, *TINY_OPTIONS, "--set", "prior.transforms=rot180", "--out", out)
    first = esp(*study, "--broken-by", "wind", "--jobs", 2)
    assert "5 runs, 0 of them finished" in first.stderr
    assert first.stderr.count(", which trains the same") == 1, "where nothing is broken"
    assert StudyFolder.open(out).study.command.endswith(" --broken-by wind --jobs 2")
    more = esp(*study, "--broken-by", "mud", "--dry-run", "--jobs", 2)
    assert "4 runs to do" in more.stdout, "the unbroken ones are there"
    assert refused("ablate", "modules", "--broken-by", "wind") == "--broken-by is for esp ablate breaking; leave it out"
    assert "'luck' is no variant of this study; choose from " in refused(*study, "--methods", "luck")


def test_unlike_numbers_of_episodes_are_told(finished: Path, copied: Path, tmp_path: Path) -> None:
    config = json.loads((copied / "config.json").read_text())
    fewer = config["evaluation"]["episodes"]
    config["evaluation"]["episodes"] = 5 * fewer
    (copied / "config.json").write_text(json.dumps(config))
    esp("report", finished, copied, "--out", tmp_path / "page")
    text = (tmp_path / "page" / "report.md").read_text()
    assert f"greedy return, {fewer} to {5 * fewer} episodes a seed. Convention: esp: team sum" in text
    esp("report", copied, "--out", tmp_path / "alone")
    assert f"greedy return, {5 * fewer} episodes a seed." in (tmp_path / "alone" / "report.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["ablate", "colours"], "'colours' is not one of"),
        (["ablate", "modules", "--steps", "soon"], "'soon' is not a number of steps"),
        (["ablate", "transforms", "--methods", "rot90, rot270"], "choose from 'none', 'rot90', 'rot90, rot180', "),
        (["ablate", "modules", "--set", "prior.transforms=c8"], "c8 cannot act on navigation"),
        (["reproduce", "table1", "--jobs", "0"], "--jobs"),
        (["ablate", "modules", "--reuse", "none"], "none is no study"),
        (["ablate", "modules", "--address", "auto"], "--address is that of a Ray cluster; add --engine ray"),
        (["report"], "Missing argument"),
    ],
)
def test_what_is_wrong_is_told_before_there_is_a_folder(tmp_path: Path, arguments: list[str], sentence: str) -> None:
    out = [] if arguments == ["report"] else ["--out", tmp_path / "s"]
    assert sentence in refused(*arguments, *out)
    assert not (tmp_path / "s").exists()


def test_without_ray_a_cluster_is_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "esp_cli.studies.engine_ray", raising=False)
    told = refused(*TINY, "--steps", 200, *TINY_OPTIONS, "--out", tmp_path / "s", "--engine", "ray")
    assert told == f"Ray is not installed: {install('cluster')}, or use --engine local"
    assert not (tmp_path / "s").exists()


def test_a_gpu_of_a_cluster_may_be_elsewhere() -> None:
    assert StudyChoices(engine="ray", device="cuda").request().device == "cuda"


class RefusingEngine:
    """Starts nothing, and keeps what it was asked to start."""

    def __init__(self) -> None:
        self.asked: list[list[str]] = []

    def places(self, device: str) -> int:
        return 1

    def start(self, arguments: Sequence[str], log: Path) -> Job:
        self.asked.append(list(arguments))
        raise UserError("nothing is started here")


@pytest.mark.parametrize("no_check", [False, True])
def test_a_study_hands_on_whether_its_runs_look_at_the_task(tmp_path: Path, no_check: bool) -> None:
    engine, study = RefusingEngine(), small_study()
    with open_resources(StudyChoices(no_check=no_check), tmp_path, "cpu") as resources:
        run_cells(StudyFolder.create(tmp_path / "s", study), study, replace(resources, engine=engine))
    assert engine.asked
    assert all(("--no-check" in words) == no_check for words in engine.asked if words[0] == "train")


def test_a_study_is_reported_by_itself_and_held_by_one_process(tmp_path: Path, finished: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study())
    assert "a study is reported by itself" in refused("report", folder.path, finished)
    assert "no run has an evaluation yet" in esp("report", folder.path).stderr
    options = [*TINY, "--steps", 200, *TINY_OPTIONS, "--out", tmp_path / "s"]
    assert "holds another study" in refused(*options)
    options[-1] = tmp_path / "t"
    (tmp_path / "t").mkdir()
    with holding(tmp_path / "t" / "study.lock"):
        assert "is in use by process" in refused(*options)
    assert not (tmp_path / "t" / "runs").exists()


def test_progress_in_a_pipe_says_what_changed_and_a_line_a_minute(tmp_path, capsys):
    folder = StudyFolder.create(tmp_path / "s", small_study())
    scheduler = Scheduler(folder, folder.study.cells, 1, LocalEngine(stand_in()))
    plain, esp_run = scheduler.runs
    now = [0.0]
    with StudyProgress(clock=lambda: now[0]) as progress:
        plain.status = "training"
        progress.update(scheduler)
        plain.step, plain.trained_s = 100, 10.0
        now[0] = 30.0
        progress.update(scheduler)
        now[0] = 61.0
        progress.update(scheduler)
        plain.status, plain.step = "evaluating", 200
        assert whole_status(scheduler).endswith("  ? left")
        plain.status, esp_run.status, esp_run.message = "finished", "failed", "no disk"
        progress.update(scheduler)
    assert capsys.readouterr().err.splitlines() == [
        f"training {plain.cell.name}",
        f"  {plain.cell.name}  0/200",
        "0%  0/2 runs finished  ? left",
        f"  {plain.cell.name}  100/200  30 seed-steps/s  10 s left",
        "25%  0/2 runs finished  30 s left",
        f"finished {plain.cell.name} after 10 s",
        f"error: {esp_run.cell.name} failed: no disk; the others go on",
    ]
    assert share(scheduler) == 0.5
    assert "1 failed" in whole_status(scheduler)


def test_progress_on_a_terminal_has_a_bar_for_each_running_process(tmp_path, monkeypatch):
    terminal = console.streams.SafeConsole(force_terminal=True, width=120, file=(tmp_path / "screen").open("w"))
    monkeypatch.setattr(console.progress, "err", terminal)
    folder = StudyFolder.create(tmp_path / "s", small_study())
    scheduler = Scheduler(folder, folder.study.cells, 1, LocalEngine(stand_in()))
    runs = scheduler.runs
    runs[0].status, runs[0].step, runs[0].trained_s = "training", 100, 10.0
    with StudyProgress() as progress:
        progress.update(scheduler)
    terminal.file.close()
    screen = (tmp_path / "screen").read_text()
    assert runs[0].cell.name in screen
    assert "30 seed-steps/s" in screen
    assert "whole study" in screen
    assert runs[1].cell.name not in screen


@pytest.mark.slow
@pytest.mark.usefixtures("forked_jobs")
def test_a_study_that_is_killed_twice_loses_nothing_and_runs_nothing_twice(tmp_path: Path) -> None:
    out = tmp_path / "s"
    words = [str(x) for x in (*TINY, "--steps", KILLED_STEPS, *TINY_OPTIONS, "--out", out, "--jobs", 1)]

    def study() -> None:
        trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
        app.app(words)

    def rows(name: str) -> int:
        file = out / "runs" / name / "metrics.jsonl"
        return file.read_bytes().count(b"\n") if file.exists() else 0

    names = ["navigation-1.5k-mappo-plain", "navigation-1.5k-mappo-esp"]
    for name in names:  # each time in the middle of another run
        killed(study, out, lambda name=name: rows(name), 5)
    first = (out / "runs" / names[0] / "policy.safetensors").stat().st_mtime_ns
    assert wait(fork(study, out)) == 0, said(out)
    assert (out / "runs" / names[0] / "policy.safetensors").stat().st_mtime_ns == first, "not run again"
    for name, prior in zip(names, ("none", "esp"), strict=True):
        run = out / "runs" / name
        alone = train_tiny(tmp_path / prior, "--seeds", "2", "--prior", prior, steps=KILLED_STEPS)
        steps = [row["step"] for row in read_metrics(run / "metrics.jsonl")]
        assert steps == [row["step"] for row in read_metrics(alone / "metrics.jsonl")]
        assert (run / "policy.safetensors").read_bytes() == (alone / "policy.safetensors").read_bytes()


def test_failed_runs_are_named_and_where_their_logs_are(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^2 runs failed \(esp, plain\); .* in log\.txt of their folders below"):
        studying.refuse_failed(["esp", "plain"], tmp_path)
    studying.refuse_failed([], tmp_path)
