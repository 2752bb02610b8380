"""The benchmark of symmetry: its protocol, its methods and tasks, and what it refuses."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from esp_cli.reporting.collect import collect_study
from esp_cli.reporting.page import answer
from esp_cli.reporting.results import summarised
from esp_cli.reporting.tables import TABLES
from esp_cli.studies.catalogue import Request
from esp_cli.studies.search import Trials, score
from esp_cli.studies.study import StudyFolder
from esp_cli.studies.symmetry import METHODS, TASKS, Benchmark, draws
from esp_cli.training.folder_names import FINAL
from esp_envs import make
from esp_envs.errors import UserError
from tests.studies.small_studies import write_run
from tests.training.runs import TINY

MEASURED = Path(__file__).parents[2] / "docs" / "measured" / "sets-orders-3.json"


def benchmark(budget: int = 3, **choice: Any) -> Benchmark:
    defaults = {"tasks": ("navigation",), "variants": ("plain", "ESP"), "seeds": (0, 1, 2, 3), "episodes": 4}
    return Benchmark(Request(**(defaults | choice)), budget)


def write_trials(path: Path, asked: Benchmark, ends: dict[str, float]) -> Trials:
    folder = Trials.create(path, asked.trials)
    for cell in folder.study.cells:
        run, end = folder.prepare(cell), ends.get(cell.name, 0.0)
        means = [None if math.isnan(mean) else mean for mean in (9.0, end, end)]
        rows = ({"step": k, "eval/return_greedy": [mean] * 3} for k, mean in enumerate(means))
        run.metrics_path.write_text("".join(json.dumps(row) + "\n" for row in rows))
        run.policy_path.write_bytes(b"weights")
    return folder


def test_the_draws_are_those_of_the_comparison_on_file() -> None:
    """So its protocol is that of docs/many-agents.md; the weight of relaxation, which that has not, comes after."""
    ours = [{name: value for name, value in one.items() if name != "network.relax"} for one in draws("mappo", 5)]
    assert ours == json.loads(MEASURED.read_text())["draws"]
    assert draws("mappo", 2) == draws("mappo", 5)[:2]
    assert {one["network.relax"] for one in draws("mappo", 20)[1:]} == {0.1, 0.3, 1.0, 3.0}


def test_the_score_is_the_mean_of_the_last_two_evaluations(tmp_path: Path) -> None:
    rows = [[-90.0, -90.0], [-30.0, -10.0], [-20.0, -40.0]]  # (-30 - 10 - 20 - 40) / 4 = -25
    file = tmp_path / "metrics.jsonl"
    file.write_text("".join(json.dumps({"step": k, "eval/return_greedy": row}) + "\n" for k, row in enumerate(rows)))
    assert score(tmp_path) == -25.0
    file.write_text(json.dumps({"step": 0, "eval/return_greedy": [-1.0, None]}) + "\n")
    assert score(tmp_path) == -math.inf


def test_a_trial_has_its_own_seeds_and_fewer_steps_and_only_what_counts_is_drawn() -> None:
    asked = benchmark(overrides={"mappo.num_epochs": 7})
    first, second = (asked.config("navigation", "plain", draw, trial=True) for draw in (0, 1))
    assert (first.seeds, first.steps, first.preset) == ((100, 101, 102), 60_000, "fast")
    assert (second.algorithm_settings["learning_rate"], second.algorithm_settings["num_epochs"]) == (0.008, 7)
    judged = asked.config("navigation", "ESP", 1, trial=False)
    assert (judged.seeds, judged.steps, judged.prior.consistency_coef) == ((0, 1, 2, 3), 200_000, 0.3)
    assert second.prior == first.prior, "nothing of a prior is drawn where there is none"
    assert asked.without_effect() == []
    idle = {"mappo.truncation": 5, "prior.old_log_prob": "recompute", "prior.replay": "stored"}
    assert benchmark(overrides=idle).without_effect() == ["mappo.truncation", "prior.replay"]
    shorter = benchmark(steps=((None, 1000),))
    assert shorter.config("navigation", "plain", 0, trial=True).steps == 300
    pictures = benchmark(tasks=("wildlife",), variants=("plain", "homomorphic network"))
    assert [pictures.config("wildlife", method, 1, True).network.name for method in pictures.methods] == ["mpn", "empn"]
    settings = pictures.config("wildlife", "plain", 1, trial=True).algorithm_settings
    assert (settings["num_envs"], settings["gamma"]) == (64, 0.99), "batch and horizon stay the preset's there"


@pytest.mark.parametrize("task", ["navigation", "predator-prey"])
@pytest.mark.parametrize(
    ("way", "left"), [("subgroup", "c4"), ("feature", "flip-x"), ("region", "flip-x"), ("approximately", "flip-x")]
)
def test_a_broken_task_has_less_symmetry_and_differs_in_one_setting(task: str, way: str, left: str) -> None:
    board = TASKS[f"{task}-{way}"]
    settings = {name.removeprefix("task."): value for name, value in board.settings.items()}
    assert (board.task, len(settings)) == (task, 1)
    whole, broken = (make(task, 1, (0,), chosen).spec.symmetry.split("*")[0] for chosen in ({}, settings))
    assert (whole, broken) == ("d4", left)


def test_what_a_task_cannot_take_is_left_out_with_a_reason_and_the_first_taken_is_the_reference(tmp_path):
    asked = benchmark(tasks=("wildlife",), variants=("local frames", "plain", "frame averages"), budget=1)
    assert asked.candidates == (("wildlife", "plain"), ("wildlife", "frame averages"))
    reason = asked.left_out["wildlife: local frames"]
    assert reason == "network.symmetrise=local-d4 is for networks without memory and messages; use d4"
    study = asked.judged(write_trials(tmp_path / "s", asked, {}))
    assert [cell.reference for cell in study.cells] == [None, "wildlife-200k-plain"]
    folder = StudyFolder.create(tmp_path / "s" / "fresh", study)
    found = TABLES["left-out"](collect_study(folder).results)
    assert found.rows == (("wildlife", "local frames", reason),)


def test_every_method_is_taken_somewhere() -> None:
    assert {method for _, method in benchmark(variants=None, budget=1).candidates} == set(METHODS)


def test_the_best_trial_is_judged_and_the_first_of_equal_ones(tmp_path: Path) -> None:
    asked = benchmark()
    ends = {"navigation-200k-plain-2": 5.0, "navigation-200k-esp-0": -1.0}
    plain, esp = asked.judged(write_trials(tmp_path / "s", asked, ends)).cells
    assert plain.config == asked.config("navigation", "plain", 2, trial=False)
    assert esp.config == asked.config("navigation", "ESP", 1, trial=False)
    assert json.loads((tmp_path / "s" / "trials.json").read_text())["scores"] == {
        "navigation, 60k: plain": [0.0, 0.0, 5.0],
        "navigation, 60k: ESP": [-1.0, 0.0, 0.0],
    }


def test_scores_of_methods_that_were_tried_before_stay_on_file(tmp_path: Path) -> None:
    for methods, budget in ((("plain", "ESP"), 2), (("copies",), 3)):
        asked = benchmark(variants=methods, budget=budget)
        asked.judged(write_trials(tmp_path / "s", asked, {}))
    found = json.loads((tmp_path / "s" / "trials.json").read_text())
    assert {name: len(own) for name, own in found["scores"].items()} == {
        "navigation, 60k: plain": 2,
        "navigation, 60k: ESP": 2,
        "navigation, 60k: copies": 3,
    }
    assert len(found["draws"]) == 3
    (tmp_path / "s" / "trials.json").write_text('{"draws": 7, "scores": []}')
    asked.judged(Trials.open(tmp_path / "s"))
    assert json.loads((tmp_path / "s" / "trials.json").read_text())["scores"].keys() == {"navigation, 60k: copies"}


def test_why_a_method_is_left_out_is_on_file_until_it_is_judged(tmp_path: Path) -> None:
    first = benchmark(variants=("plain",), tasks=("wildlife",), budget=1)
    folder = Trials.create(tmp_path / "s", first.trials)
    more = benchmark(variants=("plain", "local frames"), tasks=("wildlife",), budget=1)
    assert folder.study.left_out == {}
    left_out = Trials.create(tmp_path / "s", more.trials).study.left_out
    assert list(left_out) == ["wildlife: local frames"], "though it adds no run"
    judged = benchmark(variants=("plain", "ESP"), budget=1)
    study = judged.judged(write_trials(tmp_path / "t", judged, {"navigation-200k-esp-0": math.nan}))
    assert list(StudyFolder.create(tmp_path / "f", study).study.left_out) == ["navigation: ESP"]
    again = judged.judged(write_trials(tmp_path / "t", judged, {}))
    assert StudyFolder.create(tmp_path / "f", again).study.left_out == {}


def test_a_trial_whose_seeds_all_stopped_has_ended_and_a_method_of_such_trials_is_left_out(tmp_path: Path) -> None:
    asked = benchmark(variants=("plain", "ESP", "copies"), budget=2)
    ends = {f"navigation-200k-{stopped}": math.nan for stopped in ("plain-0", "plain-1", "esp-0")}
    trials = write_trials(tmp_path / "s", asked, ends)
    for cell in trials.study.cells[:3]:
        (trials.run_path(cell) / "policy.safetensors").unlink()
    assert all(map(trials.is_finished, trials.study.cells))
    study = asked.judged(trials)
    references = {cell.variant: cell.reference for cell in study.cells}
    assert references == {"ESP": None, "copies": "navigation-200k-esp"}
    assert study.left_out == {"navigation: plain": "a seed stopped in each of its trials"}
    assert study.cells[0].config == asked.config("navigation", "ESP", 1, trial=False)
    with pytest.raises(UserError, match="so there is nothing to judge"):
        benchmark(variants=("plain",), budget=2).judged(trials)


def test_what_is_judged_gets_no_further_trials_but_other_methods_do(tmp_path: Path) -> None:
    asked = benchmark()
    judged = asked.judged(write_trials(tmp_path / "s", asked, {}))
    Trials.create(tmp_path / "s", benchmark(budget=4, variants=("plain",)).trials)
    StudyFolder.create(tmp_path / "s" / "fresh", judged)
    judged_by_3 = "has trials on navigation, 60k, 3 each, and fresh judges them; keep its --budget, or"
    for more in ({"budget": 4}, {"budget": 2}, {"budget": 2, "variants": ("copies",)}):
        with pytest.raises(UserError, match=judged_by_3):
            Trials.create(tmp_path / "s", benchmark(**more).trials)
    assert len(Trials.create(tmp_path / "s", benchmark(variants=("copies",)).trials).study.cells) == 6 + 1 + 3


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ({"variants": ("plain", "magic")}, "'magic' is no method; choose from 'plain', 'ESP', "),
        ({"variants": ("plain", "plain")}, "'plain' is named twice"),
        ({"algorithms": ("mappo", "qmix")}, "this benchmark tunes one learner, whose space it has"),
        ({"algorithms": ("reinforce",)}, "this benchmark tunes one learner, whose space it has"),
        ({"seeds": (0, 101)}, "seed 101 belongs to the trials"),
        ({"overrides": {"prior.kind": "esp"}}, "--set prior.kind is what this study varies by itself"),
        (
            {"tasks": ("navigation-8",), "overrides": {"navigation.num_agents": 4}},
            "--set navigation.num_agents is what this study varies",
        ),
        ({"overrides": {"mappo.lr": 1}}, "unknown setting 'mappo.lr'"),
        ({"tasks": ("navigation", "chess")}, "unknown task 'chess'"),
        ({"overrides": {"qmix.learning_rate": 0.5}}, "--set qmix.learning_rate concerns no run of this study; it has "),
        ({"overrides": {"formation.no_such": 1}}, "--set formation.no_such concerns no run of this study"),
        ({"steps": (("formation", 1000),)}, "--steps formation=1000 concerns no run here; the tasks are "),
        ({"steps": ((None, 100), (None, 200))}, "--steps gives navigation several numbers"),
    ],
)
def test_what_cannot_be_run_is_refused(choice: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        benchmark(**choice)


def test_the_report_corrects_for_the_number_of_methods(tmp_path: Path) -> None:
    """Four seeds against four that are all lower have p = 2 / 70; with a second comparison, Holm doubles it."""
    asked = benchmark(variants=("plain", "ESP", "copies"), overrides=TINY | {"evaluation.every_steps": 10}, budget=1)
    folder = StudyFolder.create(tmp_path / "fresh", asked.judged(write_trials(tmp_path / "s", asked, {})))
    for cell, end in zip(folder.study.cells, (-180.0, -150.0, -179.5), strict=True):
        finals = [end + k for k in range(4)]
        write_run(folder, cell, [[-200.0] * 4, finals], finals)
    material = collect_study(folder)
    _, esp, copies = (cell.summary for cell in material.results.cells)
    assert esp.gap.holm == pytest.approx(2 * 2 / 70)
    assert copies.gap.holm > 0.5
    assert (esp.gap.ahead, copies.gap.ahead) == ("level", "level")
    assert esp.normalised_area.mean == pytest.approx((-200 - 148.5) / 2 / 100 + 2)  # 0 is -200, 1 is -100
    assert answer(material) == [
        "navigation, 200k: ESP has the highest IQM, -148.50; after Holm's correction, not told apart from plain: ESP, "
        "copies.",
        "With 4 seeds the rank-sum test can tell nothing apart on navigation, 200k; take 5 or more.",
    ]
    table = TABLES["comparison"](material.results)
    row = dict(zip(table.headings, table.rows[1], strict=True))
    assert (row["over all pairs>"], row["p, corrected>"]) == ("1.00", "0.057")
    alone = material.results.model_copy(update={"cells": material.results.cells[:2]})
    assert summarised(alone).cells[1].summary.gap.ahead == "ahead", "2 / 70 is below 5 %"
    _, verdict, *steps = answer(replace(material, results=summarised(alone)))
    assert verdict == "ESP is better than plain: the difference is +30.00, p = 0.029 by the rank-sum test."
    assert not any("take" in text for text in steps)
    (folder.run_path(folder.study.cells[2]) / FINAL).unlink()
    assert answer(collect_study(folder))[0].endswith(", better than plain: ESP; not finished: copies.")


def test_only_panels_with_too_few_seeds_for_their_comparisons_are_named(tmp_path: Path) -> None:
    """Two comparisons of four seeds need 5, and one needs 4."""
    choice = {"overrides": TINY | {"evaluation.every_steps": 10}, "budget": 1, "tasks": ("navigation", "wildlife")}
    asked = benchmark(variants=("plain", "ESP", "local frames"), **choice)
    assert [name for name, _ in asked.candidates].count("wildlife") == 2, "its pictures have no local frames"
    folder = StudyFolder.create(tmp_path / "fresh", asked.judged(write_trials(tmp_path / "s", asked, {})))
    for cell in folder.study.cells:
        finals = [-180.0 + 30.0 * (cell.reference is not None) + k for k in range(4)]
        write_run(folder, cell, [[-200.0] * 4, finals], finals)
    *_, few = answer(collect_study(folder))
    assert few == "With 4 seeds the rank-sum test can tell nothing apart on navigation, 200k; take 5 or more."
    assert "better than plain: ESP" in answer(collect_study(folder))[1]
    material = collect_study(folder)
    plain, *others = material.results.cells
    of_ten = {"seeds": tuple(range(10)), "returns": {"greedy": tuple(-180.0 + k / 10 for k in range(10))}}
    cells = (plain.model_copy(update=of_ten), *others)
    several = replace(material, results=summarised(material.results.model_copy(update={"cells": cells})))
    assert not any("can tell nothing" in text for text in answer(several)), "4 beside 10 seeds can"


def test_another_learner_has_its_own_space_and_trials_as_long_as_what_judges() -> None:
    asked = benchmark(algorithms=("maddpg",), variants=("plain", "ESP", "sets"), budget=2)
    plain, esp = (asked.config("navigation", method, 1, trial=True) for method in ("plain", "ESP"))
    drawn = {name.removeprefix("maddpg."): x for name, x in draws("maddpg", 2)[1].items() if "maddpg." in name}
    assert len(drawn) == 9
    for config in (plain, esp):
        assert {name: config.algorithm_settings[name] for name in drawn} == drawn
    assert (plain.prior.kind, esp.prior.kind) == ("none", "esp")
    assert (plain.preset, plain.steps) == ("default", 60_000) == (esp.preset, asked.steps("navigation", trial=False))
    assert asked.config("navigation", "sets", 0, trial=True).network.name == "set"
    cell = asked.trials.cells[0]
    assert (cell.name, cell.panel) == ("navigation-60k-maddpg-plain-0", "navigation, MADDPG, 60k")
