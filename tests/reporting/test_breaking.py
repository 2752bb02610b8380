"""The study of broken symmetry: what it runs, and what its tables say of made-up returns."""

from __future__ import annotations

from pathlib import Path

import pytest

from esp_cli.checking import measured
from esp_cli.reporting.breaking import Verdict, leaders, series_of, side, verdicts
from esp_cli.reporting.collect import collect
from esp_cli.reporting.page import write_report
from esp_cli.reporting.results import read_results
from esp_cli.reporting.tables import breaking_table, methods_table, returns_table, verdicts_table
from esp_cli.studies.catalogue import plan
from esp_cli.studies.kinds import BREAKINGS, KINDS
from esp_cli.studies.study import StudyFolder
from esp_cli.training.build import build_learner
from esp_envs import task_class
from tests.studies.small_studies import request, small_study, write_run, write_study

METHODS = list(KINDS["ablate-breaking"].variants)
BASE = {
    "plain": -150.0,
    "ESP": -120.0,
    "ESP that fades": -120.5,
    "auto": -120.0,
    "measured weights": -120.0,
    "gate": -121.0,
    "compass": -125.0,
    "relaxed weights": -120.0,
}
"""Returns where nothing is broken; the standard error is 1 / sqrt(3) = 0.577."""
BROKEN = {
    "plain": -150.0,
    "ESP": -180.0,
    "ESP that fades": -150.0,
    "auto": -140.0,
    "measured weights": -140.0,
    "gate": -140.0,
    "compass": -130.0,
    "relaxed weights": -200.0,
}
NOISE = (-1.0, 0.0, 1.0)


def study(**choice):
    return small_study("ablate-breaking", **{"tasks": ("navigation",), "breakings": ("wind",), **choice})


def test_every_method_meets_every_strength_of_its_task(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(measured, "_breaking", lambda *_: (("rot90", 0.5),))
    cells = plan("ablate-breaking", request(tasks=("navigation", "predator-prey"), seeds=(0,))).cells
    for task in ("navigation", "predator-prey"):
        own = [cell for cell in cells if cell.config.task == task]
        known = set(task_class(task).Settings.breakable())
        broken = [{s: v for s in known if (v := cell.config.task_settings[s])} for cell in own]
        expected = [{}, *({s: value} for s, values in BREAKINGS[task].items() for value in values)]
        assert list(zip(broken, (cell.variant for cell in own), strict=True)) == [
            (one, method) for one in expected for method in METHODS
        ]
    for task, settings in BREAKINGS.items():
        assert set(settings) <= set(task_class(task).Settings.breakable())
        assert all(0 < low < high for low, high in settings.values())
    configs = {cell.variant: cell.config for cell in cells}
    assert [configs[m].prior.kind for m in METHODS] == ["none", *["esp"] * (len(METHODS) - 2), "none"]
    assert configs["ESP that fades"].prior.fade > 0
    assert configs["compass"].prior.compass > 0
    assert (configs["gate"].prior.trust, configs["relaxed weights"].network.relax) == ("gate", 1.0)
    assert all(cell.reference is None or cell.reference.endswith("-plain") for cell in cells)


@pytest.mark.parametrize("fewer", ["MAPPO", "MAPPO-ESP"])
def test_one_seed_proves_nothing_on_either_side(tmp_path: Path, fewer: str):
    ends = {"MAPPO": [-119.5, -119.5, -119.5], "MAPPO-ESP": [-119.0, -118.0, -119.0]}
    results = collect(write_study(tmp_path / "s", small_study(), ends)).results
    plain, esp = results.cells
    assert side(results, esp, plain) == "ahead"
    cut = {cell.variant: cell for cell in results.cells}
    one = cut[fewer]
    cut[fewer] = one.model_copy(update={"seeds": one.seeds[:1], "returns": {"greedy": one.returns["greedy"][:1]}})
    assert side(results, cut["MAPPO-ESP"], cut["MAPPO"]) is None


def test_what_a_task_cannot_take_is_left_out_of_its_study(monkeypatch: pytest.MonkeyPatch):
    turns, mirrors = ("rot90", "rot180", "rot270"), ("flip-x", "flip-diagonal", "flip-y", "flip-antidiagonal")
    gaps = {"c4": turns, "d4": turns + mirrors}
    monkeypatch.setattr(measured, "_breaking", lambda _, text: tuple((name, 0.5) for name in gaps[text]))
    left_out = {"compass", "relaxed weights"}
    cells = plan("ablate-breaking", request(tasks=("wildlife",), seeds=(0,), overrides={})).cells
    unbroken = {cell.variant: cell.config for cell in cells if cell.panel.startswith("wildlife, unbroken")}
    assert list(unbroken) == [method for method in METHODS if method not in left_out]
    for config in unbroken.values():
        build_learner(config)
    named = plan("ablate-breaking", request(tasks=("wildlife",), seeds=(0,), variants=tuple(left_out), overrides={}))
    for cell in named.cells[:2]:
        with pytest.raises(ValueError, match=r"shows compass too; use mlp|shows pictures"):
            build_learner(cell.config)


def test_weights_are_measured_when_the_study_is_planned_and_methods_that_train_as_esp_does_are_one_run():
    cells = study(variants=("ESP", "measured weights", "gate", "compass")).cells
    weights = {
        cell.config.task_settings["wind"]: cell.config.prior.weights
        for cell in cells
        if cell.variant == "measured weights"
    }
    assert weights[0.0] == {}
    assert weights[0.6]["rot180"] < weights[0.3]["rot180"] < 1
    assert weights[0.6]["flip-x"] == 1
    whole = {cell.variant: cell.config for cell in cells if "unbroken" in cell.panel}
    assert whole["measured weights"] == whole["gate"] == whole["ESP"]
    assert whole["compass"] != whole["ESP"]


def test_some_methods_and_some_breakings_can_be_chosen(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(measured, "_breaking", lambda *_: (("rot90", 0.5),))
    cells = study(variants=("ESP", "gate"), breakings=("mud", "wind")).cells
    assert {cell.variant for cell in cells} == {"ESP", "gate"}
    assert len(cells) == 2 * (1 + 2 + 2)
    with pytest.raises(ValueError, match="'slope' breaks none of these tasks here; choose from action_turn_rad, "):
        study(breakings=("slope",))


@pytest.mark.parametrize("setting", ["prior.compass", "task.wind", "prior.kind"])
def test_what_the_study_varies_cannot_be_set(setting: str):
    with pytest.raises(ValueError, match="what this study varies by itself"):
        plan("ablate-breaking", request(overrides={setting: 1}))


def test_a_task_that_nobody_breaks_is_refused():
    with pytest.raises(ValueError, match="knows no breaking of nowhere"):
        plan("ablate-breaking", request(tasks=("nowhere",)))


@pytest.fixture
def folder(tmp_path: Path) -> StudyFolder:
    """All runs of navigation: unbroken as in BASE, else as in BROKEN."""
    made = StudyFolder.create(tmp_path / "study", study())
    for cell in made.study.cells:
        mean = (BASE if cell.config.task_settings["wind"] == 0 else BROKEN)[cell.variant]
        ends = [mean + x for x in NOISE]
        rows = [[x - 10.0 * (2 - k) for x in ends] for k in range(3)]
        write_run(made, cell, rows, ends)
    return made


def test_each_method_gets_its_verdict(folder: StudyFolder):
    """Fading: within an error of ESP, then level with plain. Gate: 1 below ESP. Measured: as ESP, then ahead."""
    results = collect(folder).results
    (one,) = series_of(results)
    assert (one.name, one.setting, list(one.cells)) == ("navigation, MAPPO, 200", "wind", [0.0, 0.3, 0.6])
    assert verdicts(results) == [
        Verdict("ESP that fades", True, True, True),
        Verdict("auto", True, True, True),
        Verdict("measured weights", True, True, True),
        Verdict("gate", False, True, True),
        Verdict("compass", False, True, True),
        Verdict("relaxed weights", True, False, False),
    ]
    table = verdicts_table(results)
    assert table is not None
    assert table.rows[4] == ("compass", "no", "yes", "yes")


def test_a_method_behind_the_plain_learner_fails(tmp_path: Path):
    worse = StudyFolder.create(tmp_path / "study", study())
    for cell in worse.study.cells:
        wind = cell.config.task_settings["wind"]
        mean = (BASE if wind == 0 else BROKEN)[cell.variant] - (60 if wind == 0.6 and cell.variant == "compass" else 0)
        mean -= 60 if wind == 0.3 and cell.variant == "measured weights" else 0
        mean += 30 if wind == 0 and cell.variant == "relaxed weights" else 0
        ends = [mean + x for x in NOISE]
        write_run(worse, cell, [ends, ends, ends], ends)
    found = {verdict.method: verdict for verdict in verdicts(collect(worse).results)}
    assert found["compass"].largest is False
    assert found["relaxed weights"].unbroken is True, "ahead of ESP is not behind it"
    assert found["measured weights"] == Verdict("measured weights", True, True, False)


def test_a_method_may_be_behind_by_the_larger_of_both_errors(folder: StudyFolder):
    """Behind by 1, with an error of 3 / sqrt(3) instead of 1 / sqrt(3)."""
    results = collect(folder).results
    wide = tuple(
        cell.model_copy(update={"returns": {"greedy": (-124.0, -121.0, -118.0)}})
        if cell.variant == "gate" and "unbroken" in cell.panel
        else cell
        for cell in results.cells
    )
    both = (results, results.model_copy(update={"cells": wide}))
    assert [{v.method: v.unbroken for v in verdicts(one)}["gate"] for one in both] == [False, True]


def test_the_table_has_returns_at_a_fifth_and_at_the_end(folder: StudyFolder):
    table = breaking_table(collect(folder).results)
    assert table is not None
    assert len(table.rows) == 3 * len(METHODS)
    first = dict(zip(table.headings, table.rows[0], strict=True))
    assert first["breaking"] == "wind 0"
    assert first["at 20 %>"].startswith("-170.00")
    assert first["at 100 %>"].startswith("-150.00")
    rows = {(row[1], row[2]): row for row in table.rows}
    assert rows["wind 0.6", "compass"][-2:] == ("yes", "yes")
    assert rows["wind 0.3", "ESP"][-2:] == ("no", "")
    assert rows["wind 0", "measured weights"][-1] == "not told apart"


def test_a_page_has_one_column_for_each_method_and_marks_the_best(folder: StudyFolder):
    """Seeds of all methods differ by the same noise, so methods are level only where their means are equal."""
    results = collect(folder).results
    end, early = methods_table(results), methods_table(results, early=True)
    assert end is not None
    assert early is not None
    assert end.headings == ("navigation, MAPPO, 200", *(f"{method}>" for method in METHODS))
    assert [row[0] for row in end.rows] == ["unbroken", "wind 0.3", "wind 0.6"]
    best = [{method for method, text in zip(METHODS, row[1:], strict=True) if "(*)" in text} for row in end.rows]
    assert best == [{name for name, mean in BASE.items() if mean == -120.0}, {"compass"}, {"compass"}]
    assert end.rows[1][1:3] == ("-150.00 ± 0.58", "-180.00 ± 0.58")
    assert early.rows[1][1].startswith("-170.00")
    twice = [cell.model_copy(update={"panel": cell.panel.replace("MAPPO", "QMIX")}) for cell in results.cells]
    both = methods_table(results.model_copy(update={"cells": (*results.cells, *twice)}))
    assert both is not None
    assert (both.headings[0], both.rows[3][0]) == ("run", "navigation, QMIX, 200, unbroken")
    cells = {name: cell.model_copy(update={"early": None}) for name, cell in series_of(results)[0].cells[0.3].items()}
    assert leaders(results, cells, early=True) == set()


def test_who_leads_early_is_told_by_the_early_returns(tmp_path: Path):
    ends = {"MAPPO": [-150.0, -160.0, -140.0], "MAPPO-ESP": [-110.0, -120.0, -130.0]}
    results = collect(write_study(tmp_path / "s", small_study(), ends)).results
    cells = {cell.variant: cell.model_copy(update={"early": (-180.0, -190.0, -170.0)}) for cell in results.cells}
    assert leaders(results, cells, early=True) == {"MAPPO", "MAPPO-ESP"}
    assert leaders(results, cells, early=False) == {"MAPPO-ESP"}


def test_the_report_draws_returns_over_the_strength(folder: StudyFolder, tmp_path: Path):
    files = write_report(collect(folder), tmp_path / "report")
    assert "breaking-1.png" in {file.name for file in files}
    again = read_results(tmp_path / "report" / "results.json")
    assert verdicts(again) == verdicts(collect(folder).results), "the file alone gives the tables again"


def test_equal_runs_are_level_and_one_seed_says_nothing(folder: StudyFolder):
    results = collect(folder).results
    cells = series_of(results)[0].cells[0.0]
    assert side(results, cells["measured weights"], cells["ESP"]) == "level"
    assert side(results, cells["plain"], cells["ESP"]) == "behind"
    alone = {name: cell.model_copy(update={"returns": {"greedy": (-1.0,)}}) for name, cell in cells.items()}
    assert side(results, alone["plain"], alone["ESP"]) is None


def test_all_settings_of_a_task_share_its_unbroken_runs(tmp_path: Path):
    empty = StudyFolder.create(tmp_path / "empty", study(breakings=("wind", "mud"), variants=("plain", "ESP")))
    mud, wind = sorted(series_of(collect(empty).results), key=lambda one: one.setting)
    assert (list(wind.cells), list(mud.cells)) == ([0.0, 0.3, 0.6], [0.0, 0.5, 0.9])
    assert wind.cells[0.0] == mud.cells[0.0]


def test_without_runs_nothing_is_said_and_other_studies_have_no_such_table(tmp_path: Path):
    empty = StudyFolder.create(tmp_path / "empty", study())
    assert {(v.unbroken, v.largest, v.between) for v in verdicts(collect(empty).results)} == {(None, None, None)}
    other = write_study(tmp_path / "other", small_study(), {"MAPPO": [-1.0, -2.0, -3.0]})
    results = collect(other).results
    assert breaking_table(results) is None
    assert methods_table(results) is None
    assert verdicts_table(results) is None
    assert returns_table(results).rows
    assert all(cell.early is None for cell in results.cells)
