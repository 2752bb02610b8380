"""The study of broken symmetry: what it runs, and what its report shows."""

from pathlib import Path

import pytest

from esp_cli.checking import measured
from esp_cli.reporting.collect import Material, collect_study
from esp_cli.reporting.page import write_report
from esp_cli.reporting.results import read_results, summarised
from esp_cli.reporting.study_figures import series_of
from esp_cli.reporting.tables import statistics_table
from esp_cli.studies.catalogue import plan
from esp_cli.studies.kinds import BREAKINGS, KINDS
from esp_cli.studies.study import StudyFolder
from esp_cli.training.build import build_learner
from esp_envs import task_class
from tests.studies.small_studies import request, small_study, write_run, write_study

METHODS = list(KINDS["ablate-breaking"].variants)
BASE = dict(zip(METHODS, (-150.0, -120.0, -120.5, -120.0, -120.0, -125.0, -120.0), strict=True))
"""Returns where nothing is broken; the standard error is 1 / sqrt(3) = 0.577."""
BROKEN = dict(zip(METHODS, (-150.0, -180.0, -150.0, -140.0, -140.0, -130.0, -200.0), strict=True))
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
    assert (configs["measured weights"].prior.trust, configs["relaxed weights"].network.relax) == ("measured", 1.0)
    assert all(cell.reference is None or cell.reference.endswith("-plain") for cell in cells)


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
    cells = study(variants=("ESP", "measured weights", "compass")).cells
    weights = {
        cell.config.task_settings["wind"]: cell.config.prior.weights
        for cell in cells
        if cell.variant == "measured weights"
    }
    assert weights[0.0] == {}
    assert weights[0.6]["rot180"] < weights[0.3]["rot180"] < 1
    assert weights[0.6]["flip-x"] == 1
    whole = {cell.variant: cell.config for cell in cells if "unbroken" in cell.panel}
    assert whole["measured weights"] == whole["ESP"]
    assert whole["compass"] != whole["ESP"]


def test_some_methods_and_some_breakings_can_be_chosen(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(measured, "_breaking", lambda *_: (("rot90", 0.5),))
    cells = study(variants=("ESP", "compass"), breakings=("mud", "wind")).cells
    assert {cell.variant for cell in cells} == {"ESP", "compass"}
    assert len(cells) == 2 * (1 + 2 + 2)
    with pytest.raises(ValueError, match="'slope' breaks none of these tasks here; choose from action_turn_rad, "):
        study(breakings=("slope",))


def test_a_task_that_nobody_breaks_is_refused():
    with pytest.raises(ValueError, match="knows no breaking of nowhere"):
        plan("ablate-breaking", request(tasks=("nowhere",)))


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Material:
    """All runs of navigation: unbroken as in BASE, else as in BROKEN."""
    made = StudyFolder.create(tmp_path_factory.mktemp("breaking") / "study", study())
    for cell in made.study.cells:
        mean = (BASE if cell.config.task_settings["wind"] == 0 else BROKEN)[cell.variant]
        ends = [mean + x for x in NOISE]
        rows = [[x - 10.0 * (2 - k) for x in ends] for k in range(3)]
        write_run(made, cell, rows, ends)
    return collect_study(made)


def test_the_report_has_returns_at_a_fifth_and_draws_them_over_the_strength(material: Material, tmp_path: Path):
    table = statistics_table(material.results)
    assert len(table.rows) == 3 * len(METHODS)
    assert dict(zip(table.headings, table.rows[0], strict=True))["return at 20 %>"].startswith("-170.00")
    files = write_report(material, tmp_path / "report")
    assert "breaking-1.png" in {file.name for file in files}
    again = read_results(tmp_path / "report" / "results.json")
    assert summarised(again) == material.results, "the file alone gives the tables again"
    other = write_study(tmp_path / "other", small_study(), {"MAPPO": [-1.0, -2.0, -3.0]})
    assert "return at 20 %>" not in statistics_table(collect_study(other).results).headings


def test_all_settings_of_a_task_share_its_unbroken_runs(tmp_path: Path):
    empty = StudyFolder.create(tmp_path / "empty", study(breakings=("wind", "mud"), variants=("plain", "ESP")))
    mud, wind = sorted(series_of(collect_study(empty).results), key=lambda one: one.setting)
    assert (list(wind.cells), list(mud.cells)) == ([0.0, 0.3, 0.6], [0.0, 0.5, 0.9])
    assert wind.cells[0.0] == mud.cells[0.0]
