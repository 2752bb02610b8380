"""The search of settings with Optuna, over an engine without processes whose curves follow from the learning rate."""

import contextlib
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("optuna", reason="needs Optuna, of the extra tune")

from optuna.trial import TrialState

from esp_cli.reporting.tuning_page import budget_sentence, budget_table, settings_table, write_page
from esp_cli.studies.run_set import RefusedError
from esp_cli.studies.scheduler import Scheduler
from esp_cli.studies.search import Search
from esp_cli.studies.tuning import Point, Tuning
from esp_cli.studies.tuning_space import Dimension
from esp_cli.training.config import resolve_config
from esp_cli.training.settings import read_config_file
from esp_envs.errors import UserError
from tests.studies.test_tuning import SPACE, tuning


class CurveEngine:
    """Trains by formula: the return is the better the nearer the learning rate is to 1e-2, and rises with the steps."""

    def __init__(self, fails: str = "", breaks: str = "", late: bool = False) -> None:
        self.fails, self.breaks, self.late = fails, breaks, late
        self.started, self.running, self.most = [], 0, 0

    def places(self, device):
        return 2

    def start(self, arguments, log):
        job = CurveJob(self, Path(arguments[-1]))
        self.started.append(job.path.name)
        self.running += 1
        self.most = max(self.most, self.running)
        return job


class CurveJob:
    def __init__(self, engine: CurveEngine, path: Path) -> None:
        self.engine, self.path, self.code, self.stopped = engine, path, None, False
        self.config = json.loads((path / "config.json").read_text())
        self.distance = abs(math.log10(self.config["algorithm_settings"]["learning_rate"]) + 2)
        rows = (path / "metrics.jsonl").read_text().splitlines()
        self.step = json.loads(rows[-1])["step"] if rows else -100

    def poll(self):
        if self.code is not None:
            return self.code
        if self.stopped:
            return self._end(130)
        if self.path.name == self.engine.fails:
            return self._end(2)
        if self.step >= self.config["steps"]:  # a look later than the last row, as writing a policy takes a while
            return self._finish()
        self.step += 100
        value = None if self.path.name == self.engine.breaks else -100 * self.distance + self.step / 100
        row = {"step": self.step, "eval/return_greedy": [value] * 2, "time/elapsed_s": self.step / 10}
        with (self.path / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        (self.path / "checkpoints" / f"step-{self.step:012d}.safetensors").touch()
        return self._finish() if self.step >= self.config["steps"] and not self.engine.late else None

    def _finish(self) -> int:
        (self.path / "policy.safetensors").write_bytes(b"weights")
        return self._end(0)

    def _end(self, code: int) -> int:
        self.code = code
        self.engine.running -= 1
        return code

    def ask_to_stop(self):
        self.stopped = True

    def kill(self):
        if self.code is None:
            self._end(-9)

    def last_words(self):
        return "the disk is on fire"


def search(path: Path, plan: Tuning, engine: CurveEngine | None = None, listener=lambda snapshot: True) -> Scheduler:
    made = Search.create(path, plan)
    scheduler = Scheduler(made, made.cells, 2, engine or CurveEngine())
    scheduler.complete = scheduler.run(listener, 0.0)
    return scheduler


def states(made: Search, prior: str) -> list[TrialState]:
    return [trial.state for trial in made.trials(prior)]


def last_step(path: Path) -> int:
    return json.loads((path / "metrics.jsonl").read_text().splitlines()[-1])["step"]


def test_a_tuning_goes_on_in_its_folder_with_a_budget_that_grows(tmp_path):
    Search.create(tmp_path / "t", tuning())
    assert Search.create(tmp_path / "t", tuning(budget=8)).tuning.budget == 8
    for other in (tuning(budget=2), tuning(budget=8, steps=100), tuning(budget=8, priors=("esp",))):
        with pytest.raises(UserError, match="holds another tuning"):
            Search.create(tmp_path / "t", other)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    with pytest.raises(UserError, match="is not empty and no tuning"):
        Search.create(tmp_path / "mine", tuning())


def test_each_prior_has_the_same_budget_and_what_does_not_keep_up_is_ended_early(tmp_path):
    engine = CurveEngine()
    tuner = search(tmp_path / "t", tuning(budget=12), engine)
    assert tuner.complete
    assert engine.most == 2
    assert sorted(engine.started) == sorted(f"{prior}-{k:03d}" for prior in ("esp", "none") for k in range(12))
    for prior in ("esp", "none"):
        found = tuner.folder.outcome(prior)
        assert (found.trials, found.completed + found.pruned) == (12, 12)
        assert found.pruned > 0
        assert set(states(tuner.folder, prior)) == {TrialState.COMPLETE, TrialState.PRUNED}
        paths = [tmp_path / "t" / "trials" / f"{prior}-{k:03d}" for k in range(12)]
        pruned = [state == TrialState.PRUNED for state in states(tuner.folder, prior)]
        assert [last_step(path) < 900 for path in paths] == pruned
        assert set(map(last_step, paths)) <= {100, 200, 300, 400, 900}, "at a rung, or a look later"
        assert found.env_steps == 2 * sum(map(last_step, paths))
        assert not any(list((path / "checkpoints").iterdir()) for path in paths)
        # the first trial has the default settings; the best is the best of all that were trained to the end
        first = json.loads((paths[0] / "config.json").read_text())
        assert (
            first["algorithm_settings"]["learning_rate"]
            == tuning().config(prior, {}).algorithm_settings["learning_rate"]
        )
        assert found.default_score is not None
        trials = tuner.folder.trials(prior)
        assert found.best_score == max(trial.value for trial in trials if trial.state == TrialState.COMPLETE)
    assert "prior.consistency_coef" in tuner.folder.outcome("esp").settings
    assert "prior.consistency_coef" not in tuner.folder.outcome("none").settings


def test_a_third_goes_on_after_a_ninth_and_after_a_third_of_the_steps(tmp_path):
    """Of 1, 2, 3, ... values at a rung the best 1, 1, 1, 1, 1, 2, 2, 2, 3, 3 may: 9, 8.5, 8.3, 8.4."""
    made = Search.create(tmp_path / "t", tuning(priors=("none",), budget=10))
    ends = []
    for number, value in enumerate((0.0, 9.0, 6.0, 7.0, 8.0, 5.0, 8.5, 8.2, 8.3, 8.4)):
        trial = made.trial("none", number)
        looks = [Point(step, value, value) for step in range(50, 901, 50)]
        assert made.keeps_up(trial, looks) == (number in (0, 1))
        ends.append(made.trials("none")[number].last_step)
    assert ends == [900, 900, 100, 100, 100, 100, 300, 100, 300, 300]


def test_a_search_that_is_killed_at_any_moment_loses_no_trial_and_changes_no_settings(tmp_path):
    looks, settings = [0], {}

    def kill(snapshot):
        looks[0] += 1
        if looks[0] % 7 == 0:
            raise KeyboardInterrupt
        return True

    for _ in range(40):
        try:
            tuner = search(tmp_path / "t", tuning(), listener=kill)
            break
        except KeyboardInterrupt:
            for file in (tmp_path / "t" / "trials").glob("*/config.json"):
                assert settings.setdefault(file.parent.name, file.read_text()) == file.read_text()
            with (tmp_path / "t" / "journal.jsonl").open("ab") as journal:
                journal.write(b'{"op_code":5,"trial')  # a kill in the middle of a line
    assert looks[0] > 14
    assert len(settings) > 2
    for prior in ("esp", "none"):
        assert len(states(tuner.folder, prior)) == 4
        assert all(state.is_finished() for state in states(tuner.folder, prior))
    engine = CurveEngine()
    search(tmp_path / "t", tuning(budget=5), engine)
    assert engine.started == ["esp-004", "none-004"]


def test_a_stopped_search_goes_on_with_the_trials_that_it_began(tmp_path):
    first = search(tmp_path / "t", tuning(), listener=lambda snapshot: snapshot.runs[0].step < 200)
    assert not first.complete
    assert states(first.folder, "esp") == [TrialState.RUNNING]
    again = CurveEngine()
    assert search(tmp_path / "t", tuning(), again).complete
    assert again.started[:2] == ["esp-000", "none-000"]


def test_a_broken_trial_is_never_the_best_and_a_failed_one_is_tried_again_with_its_settings(tmp_path):
    plan = tuning(priors=("none",), budget=3)
    tuner = search(tmp_path / "t", plan, CurveEngine(fails="none-001", breaks="none-002"))
    assert states(tuner.folder, "none") == [TrialState.COMPLETE, TrialState.RUNNING, TrialState.PRUNED]
    assert [(run.status, run.message) for run in tuner.runs] == [
        ("finished", ""),
        ("failed", "the disk is on fire"),
        ("finished", ""),
    ]
    config = (tmp_path / "t" / "trials" / "none-001" / "config.json").read_text()
    engine = CurveEngine()
    again = search(tmp_path / "t", plan, engine)
    assert engine.started == ["none-001"]
    assert all(state.is_finished() for state in states(again.folder, "none"))
    assert (tmp_path / "t" / "trials" / "none-001" / "config.json").read_text() == config


def test_a_trial_whose_settings_do_not_go_together_is_ended(tmp_path):
    flag = Dimension(choices=(True, False))
    both = {"network.separate_parts": flag, "network.symmetrise": Dimension(choices=(None, "c4"))}
    plan, engine = tuning(priors=("none",), budget=16, space=both), CurveEngine()
    tuner = search(tmp_path / "t", plan, engine)
    refused = [run for run in tuner.runs if run.message]
    assert 0 < len(refused) < 16
    assert any("separate_parts and symmetrise exclude each other" in run.message for run in refused)
    assert sorted(tuner.folder.outcome("none").refused) == sorted(run.message for run in refused)
    assert all(run.status == "finished" for run in tuner.runs)
    assert len(engine.started) == 16 - len(refused)
    assert all(state.is_finished() for state in states(tuner.folder, "none"))
    assert search(tmp_path / "t", plan, CurveEngine()).engine.started == []


def test_settings_that_only_building_the_learner_refuses_end_their_trial(tmp_path):
    space = {"mappo.num_minibatches": Dimension(choices=(1, 9999))}
    plan, engine = tuning(priors=("none",), budget=6, space=space), CurveEngine()
    tuner = search(tmp_path / "t", plan, engine)
    found = tuner.folder.outcome("none")
    assert all("num_minibatches" in reason for reason in found.refused)
    assert 0 < len(found.refused) == 6 - len(engine.started)
    assert found.completed + found.pruned == 6
    page = write_page(tuner.folder, [found], tmp_path / "t" / "report").read_text()
    assert f"plain: {len(found.refused)} of the pruned trials were refused, as the settings do not go" in page
    assert f"- {len(found.refused)} x {found.refused[0]}" in page
    whole = search(tmp_path / "u", tuning(priors=("none",), budget=1))
    outcome = whole.folder.outcome("none")
    assert "refused" not in write_page(whole.folder, [outcome], tmp_path / "u" / "report").read_text()


def test_a_trial_that_has_all_its_steps_is_complete_whenever_it_is_looked_at(tmp_path):
    tuner = search(tmp_path / "t", tuning(priors=("none",), budget=24), CurveEngine(late=True))
    paths = [tmp_path / "t" / "trials" / f"none-{k:03d}" for k in range(24)]
    whole = [state == TrialState.COMPLETE for state in states(tuner.folder, "none")]
    assert whole == [last_step(path) == 900 for path in paths]
    assert 3 < sum(whole) < 24


def test_a_damaged_journal_is_told_in_one_sentence(tmp_path):
    search(tmp_path / "t", tuning(priors=("none",), budget=1))
    journal = tmp_path / "t" / "journal.jsonl"
    first, *others = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(first + b"{torn}\n" + b"".join(others))
    with pytest.raises(UserError, match=r"journal.jsonl is damaged"):
        Search.create(tmp_path / "t", tuning(priors=("none",), budget=1))


def forgeries(rows: list[dict[str, object]]) -> Iterator[tuple[str, list[dict[str, object]]]]:
    """Yield journals with a field of the first row of a kind another one or missing, or that row missing or twice."""
    firsts = {row["op_code"]: k for k, row in reversed(list(enumerate(rows)))}
    for k, row in ((k, rows[k]) for k in firsts.values()):
        for name in set(row) - {"worker_id", "datetime_start", "datetime_complete"}:
            for other in (None, True, -1, 7, 1e300, "text", [1, 2], {"text": "text"}):
                yield f"row {k}: {name} = {other!r}", [*rows[:k], {**row, name: other}, *rows[k + 1 :]]
            yield f"row {k}: no {name}", [*rows[:k], {n: v for n, v in row.items() if n != name}, *rows[k + 1 :]]
        yield f"row {k} missing", rows[:k] + rows[k + 1 :]
        yield f"row {k} twice", rows[: k + 1] + rows[k:]


def test_a_forged_journal_is_refused_in_one_sentence_or_gone_on_with(tmp_path):
    plan = tuning(priors=("none",), budget=3, steps=300)
    search(tmp_path / "t", plan)
    journal = tmp_path / "t" / "journal.jsonl"
    whole = [json.loads(line) for line in journal.read_text().splitlines()]
    plan, refused, other = plan.model_copy(update={"budget": 4}), list[str](), 0
    for name, rows in forgeries(whole):
        journal.write_text("".join(f"{json.dumps(row)}\n" for row in rows))
        try:
            found = Search.create(tmp_path / "t", plan)
            outcome = found.outcome("none")
            assert math.isfinite(outcome.best_score or 0.0), name
            budget_table(plan, [outcome])
            settings_table([outcome])
            with contextlib.suppress(RefusedError):
                found.begin(found.cells[3])
            shutil.rmtree(found.run_path(found.cells[3]), ignore_errors=True)  # the next one proposes other settings
            other += 1
        except UserError as error:
            refused.append(str(error))
        except Exception as error:
            raise AssertionError(name) from error
    assert len(refused) > 150
    assert not [text for text in refused if not text.startswith(f"{journal} is damaged: ") or "\n" in text]
    assert other > 30


def test_checkpoints_that_a_kill_left_behind_are_removed(tmp_path):
    plan = tuning(priors=("none",), budget=2)
    search(tmp_path / "t", plan)
    left = tmp_path / "t" / "trials" / "none-001" / "checkpoints" / "step-000000000100.safetensors"
    left.touch()
    search(tmp_path / "t", plan)
    assert not left.exists()


@pytest.mark.parametrize(
    ("name", "choices"), [("mappo.value_coef", (1, 2)), ("mappo.anneal_entropy", (0, 1)), ("mappo.num_epochs", (1, 10))]
)
def test_the_first_trial_has_the_default_settings_however_a_number_is_written(tmp_path, name, choices):
    plan = tuning(priors=("none",), budget=1, space={name: Dimension(choices=choices)})
    default = plan.config("none", {}).algorithm_settings[name.removeprefix("mappo.")]
    assert default in choices
    tuner = search(tmp_path / "t", plan)
    assert tuner.folder.outcome("none").settings == {name: default}


@pytest.mark.parametrize(
    ("tried", "holds"),
    [
        (Dimension(choices=(0.5, 0.5)), False),
        (Dimension(choices=(0.5, 0.95)), True),
        (Dimension(low=0.9, high=0.99), True),
        (Dimension(low=0.5, high=0.6), False),
        (Dimension(low=0, high=1), False),  # whole numbers alone
    ],
)
def test_a_score_is_called_that_of_the_default_settings_only_where_trial_0_had_them(tmp_path, tried, holds):
    plan = tuning(priors=("none",), budget=2, space=SPACE | {"mappo.gae_lambda": tried})
    assert plan.config("none", {}).algorithm_settings["gae_lambda"] == 0.95
    found = search(tmp_path / "t", plan).folder.outcome("none")
    assert (found.default_score is not None) == holds
    table = budget_table(plan, [found])
    assert (table.rows[0][table.headings.index("default>")] == "-") != holds
    assert found.best_score is not None, "the trial has a score all the same"


def test_a_trial_that_does_not_state_its_seconds_as_a_number_counts_none(tmp_path):
    made = search(tmp_path / "t", tuning(priors=("none",), budget=1)).folder
    with (tmp_path / "t" / "trials" / "none-000" / "metrics.jsonl").open("a") as file:
        file.write('{"step": 901, "time/elapsed_s": [1.0]}\n')
    assert made.outcome("none").seconds == 0.0


def test_the_best_settings_are_a_file_for_training_and_the_page_states_the_budgets(tmp_path):
    tuner = search(tmp_path / "t", tuning(budget=16))
    made = tuner.folder
    outcomes = [made.outcome(prior) for prior in ("esp", "none")]
    for path, found in zip(made.write_presets(outcomes), outcomes, strict=True):
        file = read_config_file(path)
        own = resolve_config(file.choices["task"], file.choices["algorithm"], overrides=file.settings)
        best = made.tuning.config(found.prior, found.settings)
        assert own.algorithm_settings == best.algorithm_settings
        assert own.prior.effective() == best.prior
    page = write_page(made, outcomes, tmp_path / "t" / "report").read_text()
    assert budget_sentence(made.tuning) in page
    assert "Budget: 16 trials each of 2 seeds and at most 900 steps per seed" in page
    rows = budget_table(made.tuning, outcomes).rows
    assert [row[1] for row in rows] == ["16", "16"]
    assert all(f"| {' | '.join(row)} |" in page for row in (*rows, *settings_table(outcomes).rows))
    assert "Score: mean of the last three greedy evaluations." in page
