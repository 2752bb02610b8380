"""The script that fills the pages: tables from results files and nothing else, and verdicts on broken symmetry."""

import json
import os
import runpy
from pathlib import Path

import pytest

from esp_cli.reporting.collect import collect_study
from esp_cli.reporting.study_figures import series_of
from esp_cli.studies.study import StudyFolder
from tests.reporting.test_breaking import BASE, BROKEN, NOISE, material, study
from tests.studies.small_studies import small_study, write_run, write_study

FILL = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "fill_tables.py"))
Verdict, filled, files_of, join = (FILL[n] for n in ("Verdict", "filled", "files_of", "join"))
methods_table, side, verdicts = (FILL[n] for n in ("methods_table", "side", "verdicts"))
verdicts_table = FILL["verdicts_table"]
__all__ = ["material"]  # a fixture
BLOCK = "<!-- results: measured/a.json {} -->\nstale\n<!-- end of results -->"


@pytest.fixture
def page(tmp_path):
    ends = {"MAPPO": [-150.0, -160.0, -140.0], "MAPPO-ESP": [-130.0, -120.0, -140.0]}
    found = collect_study(write_study(tmp_path / "s", small_study(), ends)).results.document()
    (tmp_path / "measured").mkdir()
    (tmp_path / "measured" / "a.json").write_text(json.dumps(found))
    page = tmp_path / "page.md"
    page.write_text(f"# Before\n\n{BLOCK.format('returns')}\n\nbetween\n\n{BLOCK.format('comparison')}\n\nafter\n")
    return page


def test_what_stands_between_the_marks_is_computed_and_the_rest_stays(page):
    example = "```\n  <!-- results: measured/no.json paper -->\n  <!-- end of results -->\n```\n"  # indented
    page.write_text(example + page.read_text())
    assert filled(page).startswith(example)
    text = filled(page).removeprefix(example)
    assert "stale" not in text
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in text
    assert text.startswith("# Before\n\n<!-- results: measured/a.json returns -->\n\n| ")
    assert "\n\nbetween\n\n" in text
    assert text.endswith("<!-- end of results -->\n\nafter\n")
    assert files_of(page) == ["measured/a.json"]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("a.json returns", "a.json wishes", "asks for the table 'wishes'"),
        (
            "json returns",
            "json steps stochastic",
            "'steps stochastic'; .*; returns, paper, comparison, pairs take a mode",
        ),
        ("a.json", "b.json", "cannot read"),
        ("results:", "result:", "has no table to compute"),
    ],
)
def test_a_table_or_file_that_is_not_there_is_told(page, old, new, sentence):
    page.write_text(page.read_text().replace(old, new))
    with pytest.raises(ValueError, match=sentence):
        filled(page)
    with pytest.raises(ValueError, match="cannot read"):
        filled(page.with_name("no.md"))


def longer(page, seeds=(0, 1), **change):
    """Write the results of a second study, of more steps and fewer seeds, beside those of the page."""
    study = small_study(steps=((None, 400),), seeds=seeds)
    found = (
        collect_study(write_study(page.parent / "longer", study, {"MAPPO": [-110.0, -112.0]})).results.document()
        | change
    )
    (page.parent / "measured" / "b.json").write_text(json.dumps(found))
    page.write_text("<!-- results: measured/a.json measured/b.json returns -->\n<!-- end of results -->\n")


def test_a_row_of_pairs_says_who_is_ahead_of_what_and_the_steps_of_both(page):
    file = page.parent / "measured" / "a.json"
    found = json.loads(file.read_text())
    for cell, steps in zip(found["cells"], ([200, 400, 400], [100, 100, 100]), strict=True):
        cell["anchors"] = {"random": -200.0, "greedy": -100.0}
        cell["steps_to"] = [{"threshold": -150.0, "per_seed": steps, "of_mean": None}]
    file.write_text(json.dumps(found))
    page.write_text(BLOCK.format("pairs"))
    text = filled(page)
    assert "| navigation, 200: MAPPO-ESP | " in text
    assert " | -130.00 ± 5.77 | -150.00 ± 5.77 | +20.00 [" in text
    assert "] | 0.50, 0.70 | 400, 100 | 0.25 |" in text
    page.write_text(BLOCK.format("references"))
    assert "| navigation, 200 | -200.0 | greedy -100.0 |" in filled(page)


def test_studies_of_one_kind_stand_in_one_table_and_fewer_seeds_are_told(page):
    longer(page)
    text = filled(page)
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in text
    assert "| navigation, 400 | -111.00 ± 1.00 (n = 2) | not run |" in text
    assert "over 2 to 3 seeds" in text
    assert files_of(page) == ["measured/a.json", "measured/b.json"]


def test_studies_that_do_not_go_together_are_refused(page):
    longer(page, kind="agents")
    with pytest.raises(ValueError, match="different kinds"):
        filled(page)
    page.write_text(page.read_text().replace("b.json", "a.json"))
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in filled(page), "what is the same counts once"
    first, second = (page.parent / "measured" / name for name in ("a.json", "b.json"))
    second.write_text(first.read_text().replace("-130.0", "-131.0"))
    page.write_text(page.read_text().replace("a.json", "b.json", 1))
    with pytest.raises(ValueError, match="navigation-200-mappo-esp stands in two of the results files, with different"):
        filled(page)


def test_a_page_that_is_none_is_told_in_one_sentence(tmp_path):
    (tmp_path / "weights.md").write_bytes(b"\xf8\x00")
    with pytest.raises(ValueError, match=r"cannot read .*weights.md: 'utf-8' codec"):
        filled(tmp_path / "weights.md")
    os.mkfifo(tmp_path / "pipe.md")
    with pytest.raises(ValueError, match=r"cannot read .*pipe.md: .*regular file"):
        filled(tmp_path / "pipe.md")


def test_each_method_gets_its_verdict(material):
    """Fading: within an error of ESP, then level with plain. Compass: 5 below ESP. Measured: as ESP, then ahead."""
    results = material.results
    (one,) = series_of(results)
    assert (one.name, one.setting, list(one.cells)) == ("navigation, MAPPO, 200", "wind", [0.0, 0.3, 0.6])
    assert verdicts(results) == [
        Verdict("ESP that fades", True, True, True),
        Verdict("auto", True, True, True),
        Verdict("measured weights", True, True, True),
        Verdict("compass", False, True, True),
        Verdict("relaxed weights", True, False, False),
    ]
    assert verdicts_table(results).rows[3] == ("compass", "no", "yes", "yes")


def test_a_method_behind_the_plain_learner_fails(tmp_path: Path):
    worse = StudyFolder.create(tmp_path / "study", study())
    for cell in worse.study.cells:
        wind = cell.config.task_settings["wind"]
        mean = (BASE if wind == 0 else BROKEN)[cell.variant] - (60 if wind == 0.6 and cell.variant == "compass" else 0)
        mean -= 60 if wind == 0.3 and cell.variant == "measured weights" else 0
        mean += 30 if wind == 0 and cell.variant == "relaxed weights" else 0
        ends = [mean + x for x in NOISE]
        write_run(worse, cell, [ends, ends, ends], ends)
    found = {verdict.method: verdict for verdict in verdicts(collect_study(worse).results)}
    assert found["compass"].largest is False
    assert found["relaxed weights"].unbroken is True, "ahead of ESP is not behind it"
    assert found["measured weights"] == Verdict("measured weights", True, True, False)


def test_a_method_may_be_behind_by_the_larger_of_both_errors(material):
    """Behind by 5, with an error of 10 / sqrt(3) instead of 1 / sqrt(3)."""
    results = material.results
    wide = tuple(
        cell.model_copy(update={"returns": {"greedy": (-135.0, -125.0, -115.0)}})
        if cell.variant == "compass" and "unbroken" in cell.panel
        else cell
        for cell in results.cells
    )
    both = (results, results.model_copy(update={"cells": wide}))
    assert [{v.method: v.unbroken for v in verdicts(one)}["compass"] for one in both] == [False, True]


def test_equal_runs_are_level_and_one_seed_says_nothing(material):
    results = material.results
    cells = series_of(results)[0].cells[0.0]
    assert side(results, cells["measured weights"], cells["ESP"]) == "level"
    assert side(results, cells["plain"], cells["ESP"]) == "behind"
    alone = {name: cell.model_copy(update={"returns": {"greedy": (-1.0,)}}) for name, cell in cells.items()}
    assert side(results, alone["plain"], alone["ESP"]) is None


def test_without_runs_nothing_is_said_and_other_studies_have_no_such_table(tmp_path: Path):
    empty = StudyFolder.create(tmp_path / "empty", study())
    assert {(v.unbroken, v.largest, v.between) for v in verdicts(collect_study(empty).results)} == {(None, None, None)}
    other = write_study(tmp_path / "other", small_study(), {"MAPPO": [-1.0, -2.0, -3.0]})
    results = collect_study(other).results
    assert methods_table(results).rows == verdicts_table(results).rows == ()


def test_a_cell_that_one_file_has_not_finished_is_taken_from_the_other(tmp_path):
    ends = {"MAPPO": [-150.0, -160.0, -140.0], "MAPPO-ESP": [-130.0, -120.0, -140.0]}
    results = collect_study(write_study(tmp_path / "s", small_study(), ends)).results
    first, second = results.cells
    begun = second.model_copy(update={"status": "not run", "returns": {}, "step": 0})
    early = results.model_copy(update={"cells": (first, begun)})
    for several in ([early, results], [results, early]):
        assert [cell.returns for cell in join(several).cells] == [first.returns, second.returns]
    other = second.model_copy(update={"returns": first.returns})
    with pytest.raises(ValueError, match="stands in two of the results files, with different returns"):
        join([results, results.model_copy(update={"cells": (first, other)})])


def test_cells_of_one_name_in_other_panels_are_other_cells(tmp_path):
    ends = {"MAPPO": [-150.0, -160.0, -140.0], "MAPPO-ESP": [-130.0, -120.0, -140.0]}
    results = collect_study(write_study(tmp_path / "s", small_study(), ends)).results
    moved = tuple(cell.model_copy(update={"panel": "elsewhere", "returns": {}}) for cell in results.cells)
    plain, prior, other_plain, other_prior = join([results, results.model_copy(update={"cells": moved})]).cells
    assert (plain.name, prior.reference) == (results.cells[0].name, results.cells[1].reference)
    assert other_plain.name == f"elsewhere: {plain.name}"
    assert other_prior.reference == f"elsewhere: {prior.reference}"
