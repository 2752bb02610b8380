"""Results and tables of a study whose runs were written by hand."""

import json
import math
from dataclasses import replace

import pytest

from esp_cli.policies.statistics import Passing, leader
from esp_cli.reporting.collect import collect_study
from esp_cli.reporting.results import read_results, summarise_cell, summarised
from esp_cli.reporting.tables import TABLES, all_tables, returns_table
from esp_cli.studies.study import StudyFolder
from esp_cli.training.folder_names import FINAL, POLICY
from tests.studies.small_studies import small_study, write_study

PLAIN, ESP = [-150.0, -160.0, -140.0], [-130.0, -120.0, -140.0]

EMPTY = {"format": "esp-results", "version": 1, "kind": "table1", "title": "", "command": "", "esp_version": "0.1.0"}
EMPTY |= {"mode": "greedy", "rows": "panels", "episodes": 4, "config": {}, "cells": []}


def column(results, name, heading):
    table = TABLES[name](summarised(results))
    return [row[table.headings.index(heading)] for row in table.rows]


@pytest.fixture
def results(tmp_path):
    return collect_study(write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN, "MAPPO-ESP": ESP})).results


def test_a_cell_by_hand(results):
    plain, esp = (summarise_cell(results, cell) for cell in results.cells)
    # -150 -160 -140: mean -150, s.e.m. 10 / sqrt(3); anchors -200 and -100 put -150 half way
    assert (plain.returns.mean, plain.returns.sem) == (-150.0, pytest.approx(10 / math.sqrt(3)))
    assert plain.normalised.mean == pytest.approx(0.5)
    assert plain.gap is None
    # seed by seed +20 +40 0: mean 20; two wins and a tie of three
    assert (esp.gap.difference.value, esp.gap.difference.ci95, esp.gap.paired) == (20.0, (0.0, 40.0), True)
    assert esp.gap.probability.value == pytest.approx(2.5 / 3)
    # -130 and -120 beat all three of plain, -140 beats two and ties with one: 8.5 of nine pairs
    assert esp.gap.over_all_pairs.value == pytest.approx(8.5 / 9)
    assert esp.gap.ahead == "level", "the interval begins at 0"
    # three seeds: none is a quarter, so the middle half is all of them
    assert plain.iqm.value == pytest.approx(-150.0)
    # evaluations at 0, 100, 200 are -40, -20, 0 from the end: mean height -20
    assert plain.area.mean == pytest.approx(-170.0)


def test_returns_are_normalised_by_the_best_heuristic(results):
    cell = results.cells[0].model_copy(update={"anchors": {"random": -200.0, "heuristic": -150.0, "straight": -50.0}})
    assert summarise_cell(results, cell).normalised.mean == pytest.approx(1 / 3), "-150 is a third of -200 to -50"
    alone = cell.model_copy(update={"anchors": {"random": -200.0}})
    assert summarise_cell(results, alone).normalised is None
    poor = cell.model_copy(update={"anchors": {"random": -50.0, "heuristic": -60.0}})
    assert summarise_cell(results, poor).normalised is None, "a worse run would have the higher score"


def test_the_study_says_how_many_seeds_stopped(results):
    first, second = results.cells
    stopped = second.model_copy(update={"returns": {"greedy": (-20.0, -21.0, None)}})
    shown = returns_table(summarised(results.model_copy(update={"cells": (first, stopped)})))
    assert "-20.50 ± 0.50 (1 stopped)" in [text for row in shown.rows for text in row]


def test_steps_to_where_the_reference_ended(results):
    plain, esp = results.cells
    # plain's mean curve: -190 -170 -150; that with the prior: -170 -150 -130
    assert plain.steps_to == (Passing(threshold=-150.0, of_mean=200, per_seed=(200, None, 200)),)
    assert esp.steps_to == (Passing(threshold=-150.0, of_mean=100, per_seed=(100, 100, 200)),)
    assert column(results, "steps", "return>") == ["-150.00", "-150.00"]
    assert column(results, "steps", "mean>") == ["200", "100"]
    assert column(results, "steps", "median seed>") == ["200", "100"]
    assert column(results, "steps", "share of reference run>") == [f"{200 / plain.step:.2f}", f"{100 / plain.step:.2f}"]
    assert column(results, "steps", "ratio of median steps>") == ["", "0.50"], "100 of 200 steps"


def test_a_reference_that_has_only_begun_has_no_share(results):
    plain, esp = results.cells
    begun = plain.model_copy(update={"step": 0})
    found = results.model_copy(update={"cells": (begun, esp)})
    assert column(found, "steps", "share of reference run>") == ["-", "-"]


def test_seeds_that_never_get_there_count_as_infinitely_late(results):
    plain, esp = results.cells
    slow = Passing(threshold=-150.0, of_mean=None, per_seed=(100, 150, 150, 200, None, None, None))
    found = results.model_copy(update={"cells": (plain, esp.model_copy(update={"steps_to": (slow,), "step": 200}))})
    assert column(found, "steps", "mean>")[1] == "> 200"
    assert column(found, "steps", "median seed>")[1] == "200"
    assert column(found, "steps", "95 % interval>") == ["-", "[100, > 200]"]
    slower = replace(slow, per_seed=(100, None, None))
    never = results.model_copy(update={"cells": (plain, esp.model_copy(update={"steps_to": (slower,), "step": 200}))})
    assert column(never, "steps", "median seed>")[1] == "> 200"
    assert column(never, "steps", "ratio of median steps>")[1] == "-"


@pytest.mark.parametrize(("seeds", "shown", "verdict"), [((0, 1), "-", "-"), ((0, 1, 2), "1.00", "yes")])
def test_a_probability_of_improvement_and_a_verdict_need_three_shared_seeds(tmp_path, seeds, shown, verdict):
    ends = {"MAPPO": PLAIN[: len(seeds)], "MAPPO-ESP": [x + 5 + k for k, x in enumerate(PLAIN[: len(seeds)])]}
    found = collect_study(write_study(tmp_path / "s", small_study(seeds=seeds), ends)).results
    assert column(found, "comparison", "P(improvement)>") == ["", shown]
    assert column(found, "comparison", "ahead of reference") == ["", verdict]
    assert column(found, "comparison", "minus reference>")[1].startswith("+6.00" if verdict == "yes" else "+5.50")


def test_a_stopped_seed_sets_no_threshold_and_leaves_medians_that_hang_on_it_unknown(tmp_path):
    ends = [-110.0, None, -100.0]
    found = collect_study(write_study(tmp_path / "a", small_study(), {"MAPPO": ends, "MAPPO-ESP": ESP})).results
    assert [cell.steps_to for cell in found.cells] == [(), ()], "the seeds beside one that stopped are no fair sample"
    found = collect_study(write_study(tmp_path / "b", small_study(), {"MAPPO": PLAIN, "MAPPO-ESP": ends})).results
    plain, esp = found.cells
    assert column(found, "steps", "median seed>") == ["200", "0"], "the other two were there at once"
    late = replace(esp.steps_to[0], per_seed=(0, None, 200))
    esp = esp.model_copy(update={"steps_to": (late,)})
    found = found.model_copy(update={"cells": (plain, esp)})
    assert column(found, "steps", "median seed>") == ["200", "-"], "it may have got there before 200, or not"
    assert column(found, "steps", "ratio of median steps>") == ["", "-"]
    whole = esp.model_copy(update={"returns": dict.fromkeys(esp.returns, (-110.0, -400.0, -100.0))})
    never = found.model_copy(update={"cells": (plain, whole)})
    assert column(never, "steps", "median seed>")[1] != "-", "a seed that went on and never got there is late"


def test_other_thresholds_can_be_asked_for(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN})
    plain = collect_study(folder, thresholds=[-180.0, 0.0]).results.cells[0]
    assert [(passed.threshold, passed.of_mean) for passed in plain.steps_to] == [(-180.0, 100), (0.0, None)]


def test_ahead_and_behind_are_on_either_side_of_0(tmp_path):
    better = {"MAPPO": PLAIN, "MAPPO-ESP": [x + 5 + k for k, x in enumerate(PLAIN)]}
    worse = {"MAPPO": PLAIN, "MAPPO-ESP": [x - 5 - k for k, x in enumerate(PLAIN)]}
    for name, ends, side, word in (("b", better, "ahead", "yes"), ("w", worse, "behind", "no")):
        found = collect_study(write_study(tmp_path / name, small_study(), ends)).results
        assert summarise_cell(found, found.cells[1]).gap.ahead == side
        assert column(found, "comparison", "ahead of reference") == ["", word]


def test_there_is_no_verdict_between_two_runs_below_the_policy_that_sees_nothing(tmp_path):
    ends = {"MAPPO": PLAIN, "MAPPO-ESP": [x + 5 + k for k, x in enumerate(PLAIN)]}
    found = collect_study(write_study(tmp_path / "s", small_study(), ends)).results
    for blind, word in ((max(ends["MAPPO-ESP"]), "both below blind"), (sum(PLAIN) / len(PLAIN), "yes")):
        cells = tuple(c.model_copy(update={"anchors": {**c.anchors, "blind": blind}}) for c in found.cells)
        judged = summarised(found.model_copy(update={"cells": cells}))
        assert column(judged, "comparison", "ahead of reference") == ["", word]


def test_the_paper_stands_beside_a_cell_and_is_compared_by_the_errors_of_both(tmp_path):
    ends = {"MAPPO": [-133.0, -132.0, -131.0], "MAPPO-ESP": [-100.0, -101.0, -102.0]}
    found = collect_study(write_study(tmp_path / "s", small_study(steps=((None, 500_000),)), ends)).results
    assert column(found, "comparison", "paper>") == ["-132.65 ± 2.89", "-122.25 ± 1.62"]
    assert column(found, "comparison", "ours or paper ahead") == ["not told apart", "ours"]
    assert found.cells[0].paper == (-132.65, 2.89)


def test_who_leads_by_welch():
    # difference 4, error sqrt(1 + 1): t = 2.83 with 18 degrees of freedom, p = 0.011
    assert leader((4.0, 1.0, 10), (0.0, 1.0, 10)) == "first"
    assert leader((0.0, 1.0, 10), (4.0, 1.0, 10)) == "second"
    # t = 1.41, p = 0.17
    assert leader((2.0, 1.0, 10), (0.0, 1.0, 10)) == "neither"
    assert leader((4.0, None, 1), (0.0, 1.0, 10)) is None
    assert leader((4.0, 1.0, 10), (0.0, None, 10)) is None


def test_who_leads_with_few_seeds_beside_many():
    # error sqrt(1 + 1), (1 + 1)^2 / (1 / 3 + 1 / 15) = 10 degrees of freedom: t = 2.83 has p = 0.018, 2.12 has 0.06
    assert leader((4.0, 1.0, 4), (0.0, 1.0, 16)) == "first"
    assert leader((0.0, 1.0, 16), (4.0, 1.0, 4)) == "second"
    assert leader((3.0, 1.0, 4), (0.0, 1.0, 16)) == "neither"


def test_a_stopped_seed_is_shown_and_nothing_is_compared_with_it(tmp_path):
    found = collect_study(
        write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN, "MAPPO-ESP": [-130.0, None, -140.0]})
    ).results
    esp = summarise_cell(found, found.cells[1])
    assert (esp.returns.mean, esp.returns.per_seed, esp.gap) == (-135.0, (-130.0, None, -140.0), None)
    assert column(found, "statistics", "seeds>") == ["3", "2"]
    gone = collect_study(write_study(tmp_path / "t", small_study(), {"MAPPO": [None] * 3})).results
    assert column(gone, "comparison", "return>")[0] == "every seed stopped"


def test_what_is_unfinished_or_not_run_is_said(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN})
    (folder.run_path(folder.study.cells[0]) / FINAL).unlink()
    found = collect_study(folder).results
    assert [cell.status for cell in found.cells] == ["unfinished", "not run"]
    assert column(found, "comparison", "return>") == ["at 200", "not run"]
    assert TABLES["statistics"](found).rows == ()
    fresh = collect_study(StudyFolder.create(tmp_path / "fresh", small_study())).results
    assert next(table.title for table in all_tables(fresh)) == "Table 1 of the paper"


def test_an_evaluation_beside_which_no_trained_policy_lies_does_not_count(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN})
    cell = folder.study.cells[0]
    assert collect_study(folder).results.cells[0].status == "finished"
    (folder.run_path(cell) / POLICY).unlink()
    assert ((folder.run_path(cell) / FINAL).is_file(), folder.is_trained(cell)) == (True, False)
    assert collect_study(folder).results.cells[0].status == "unfinished"


def test_a_results_file_holds_configuration_version_and_every_seed(results, tmp_path):
    file = tmp_path / "results.json"
    file.write_text(json.dumps(results.document()))
    again = read_results(file)
    assert summarised(again) == results
    assert again.config["task"] == "navigation"
    assert [cell.config["prior.kind"] for cell in again.cells] == ["none", "esp"]
    assert {cell.esp_version for cell in again.cells} == {"0.0.1"}
    assert again.cells[1].returns["greedy"] == tuple(ESP)


def test_the_document_has_the_fields_that_it_always_had(results):
    written = results.document()
    assert " ".join(written) == "format version kind title command esp_version mode rows episodes config cells"
    cell = written["cells"][0]
    fields = ("name", "panel", "variant", "reference", "paper", "status", "step", "steps", "seeds", "config", "seconds")
    fields += ("esp_version", "task_version", "convention", "returns", "anchors", "metrics", "evaluations", "steps_to")
    assert set(cell) == {*fields, "area_under_curve"}
    assert (cell["reference"], cell["paper"]) == (None, None)
    whole = results.document(statistics=True)["cells"][1]
    assert set(whole) == {*cell, "summary"}
    assert whole["summary"]["gap"]["difference"] == {"value": 20.0, "ci95": [0.0, 40.0]}
    json.dumps(whole, allow_nan=False)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "cannot read"),
        ("{", "is not valid JSON"),
        ("{}", "is foreign: it is not the results of a study"),
        ('{"format": "esp-results", "version": 99}', "was written by a newer esp"),
        ('{"format": "esp-results", "version": 1}', "the setting 'kind' is missing"),
        (json.dumps(EMPTY), r"bad value \[\] for 'cells'"),
    ],
)
def test_what_is_no_results_file_is_told_in_one_sentence(tmp_path, content, sentence):
    file = tmp_path / "x.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ValueError, match=sentence):
        read_results(file)


def test_an_ablation_has_its_variants_as_rows(tmp_path):
    study = small_study("ablate-modules")
    found = collect_study(write_study(tmp_path / "s", study, {"none": PLAIN, "both": ESP})).results
    assert returns_table(found).rows == (
        ("none", "-150.00 ± 5.77"),
        ("loss", "not run"),
        ("augmentation", "not run"),
        ("both", "-130.00 ± 5.77"),
    )


def test_the_reference_is_called_the_plain_learner_only_where_it_is(tmp_path):
    for first, other, name in (
        ("none", "both", "the plain learner (the first run)"),
        ("both", "none", "the first run"),
    ):
        study = small_study("ablate-modules", variants=(first, other))
        found = collect_study(write_study(tmp_path / first, study, {first: PLAIN, other: ESP})).results
        assert TABLES["comparison"](found).caption.startswith(f"The reference is {name} of the same panel, compared")
    silent = found.model_copy(
        update={"config": {}, "cells": tuple(c.model_copy(update={"config": {}}) for c in found.cells)}
    )
    assert "The reference is the first run of" in TABLES["comparison"](silent).caption, "a file may say less"


def test_damaged_metrics_are_not_taken_for_a_run_that_has_only_begun(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN})
    metrics = folder.run_path(folder.study.cells[0]) / "metrics.jsonl"
    whole = metrics.read_text()
    for damaged, sentence in (
        ("{\n" + whole, "line 1 is not a row of metrics"),
        (whole + '{"step": 300, "eval/return_greedy": [1]}\n', "differ in the number of seeds"),
    ):
        metrics.write_text(damaged)
        with pytest.raises(ValueError, match=f"{metrics}.* {sentence}"):
            collect_study(folder)
    for young in ("", '{"step": 50}\n'):
        metrics.write_text(young)
        assert collect_study(folder).results.cells[0].step <= 50
    metrics.unlink()
    assert collect_study(folder).results.cells[0].step == 0


def test_runs_of_other_seeds_than_the_study_are_told(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), {"MAPPO": PLAIN})
    document = json.loads((folder.path / "study.json").read_text())
    document["cells"][0]["config"]["seeds"] = [0, 1, 2, 3]
    (folder.path / "study.json").write_text(json.dumps(document))
    more = StudyFolder.open(folder.path)
    config = folder.run_path(folder.study.cells[0]) / "config.json"
    with pytest.raises(ValueError, match="does not fit its study"):
        collect_study(more)
    config.write_text(json.dumps(json.loads(config.read_text()) | {"seeds": [0, 1, 2, 3]}))
    with pytest.raises(ValueError, match="its metrics have 3 seeds, its configuration 4"):
        collect_study(more)
