"""Runs side by side, against metrics written by hand and numbers worked out by hand."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from esp_cli.files.formatting import said_once
from esp_cli.reporting.collect import RunCurve, collect_runs, read_curve
from esp_cli.reporting.study_figures import draw_curves
from esp_cli.reporting.tables import TABLES
from esp_cli.training.run_folder import RunFolder
from esp_envs.errors import UserError
from tests.training.runs import tiny_config, tiny_folder

NAN = math.nan
SEEDS = (0, 1, 2)
STEPS = (0, 100, 200, 300)
PLAIN = [[-9.0, -8.0, -10.0], [-6.0, -7.0, -8.0], [-4.0, -6.0, -5.0], [-3.0, -5.0, -4.0]]
ESP = [[-9.0, -8.0, -10.0], [-5.0, -4.0, -6.0], [-3.0, -1.0, -5.0], [-1.0, -2.0, -3.0]]


def curve(values, label="run", steps=STEPS, seeds=SEEDS, **choice) -> RunCurve:
    numbers = np.array(values, dtype=float)
    return RunCurve(label, tiny_config(seeds=seeds, **choice), np.array(steps), numbers, 12.5, Path(label))


def gathered(curves, at=(), thresholds=()):
    return collect_runs(curves, "esp report", "greedy", at, thresholds)


def compare(curves, at, thresholds) -> dict[str, dict[int, dict]]:
    """The cells of the document that `esp report RUN... --json` writes, by label and step."""
    named = [c if c.label != "run" else replace(c, label=f"run {k}") for k, c in enumerate(curves)]
    found: dict[str, dict[int, dict]] = {}
    for cell in gathered(named, at, thresholds).results.document(statistics=True)["cells"]:
        found.setdefault(cell["variant"], {})[cell["at"]] = cell
    json.dumps(found, allow_nan=False)
    return found


def written(folder: Path, rows: list[dict], **choice) -> RunFolder:
    run = tiny_folder(folder, **choice)
    run.metrics_path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def test_a_curve_is_read_from_the_rows_that_evaluate(tmp_path):
    rows = [
        {"step": 0, "eval/return_greedy": [-9.0, -8.0], "eval/return_stochastic": [-20.0, -21.0]},
        {"step": 50, "train/return": [-1.0, -1.0], "time/elapsed_s": 1.5},
        {
            "step": 100,
            "eval/return_greedy": [-7.0, None],
            "eval/return_stochastic": [-19.0, -18.0],
            "time/elapsed_s": 3.0,
        },
        {"step": 150, "train/return": [-1.0, -1.0], "time/elapsed_s": None},
    ]
    run = written(tmp_path / "cn", rows)
    read = read_curve(run.path, None, "greedy")
    assert (read.label, read.steps.tolist(), read.seconds) == ("cn", [0, 100], 3.0)
    np.testing.assert_array_equal(read.values, [[-9.0, -8.0], [-7.0, NAN]])
    named = read_curve(run.path, "plain", "stochastic")
    assert named.label == "plain"
    assert named.values.tolist() == [[-20.0, -21.0], [-19.0, -18.0]]


def test_the_nearest_evaluation_counts_and_none_where_the_run_did_not_get_there():
    one = curve([[-9.0], [-7.0], [-5.0]], steps=(0, 800, 1600), seeds=(0,))
    assert one.config.evaluation.every_steps == 100
    ends = [one.until(step).values[-1].item() for step in (0, 399, 401, 1100, 1600)]
    assert ends == [-9.0, -9.0, -7.0, -7.0, -5.0]
    assert one.until(1601) is None, "it did not get there"
    further = replace(one, trained=1700).until(1650)
    assert further is not None
    assert further.last_step == 1600


def test_runs_are_compared_where_all_were_evaluated():
    often = curve([[-9.0], [-8.0], [-7.0], [-6.0]], "often", (0, 6400, 12800, 22400), seeds=(0,))
    seldom = curve([[-9.0], [-4.0]], "seldom", (0, 64000), seeds=(0,))
    with pytest.raises(UserError, match=r"no like steps: often at 0, 6\.4k, 12\.8k, 22\.4k; seldom at 0, 64k; train"):
        gathered([often, seldom])
    with pytest.raises(UserError, match=r"not evaluated at like steps near 20k: .*; give an --at near which all"):
        gathered([often, seldom], at=[20_000])
    with pytest.raises(UserError, match=r"not evaluated at like steps near 4k: often at 0, 6\.4k, "):
        gathered([often], at=[4000])
    near = replace(seldom, steps=np.array([0, 6500]), trained=40_000)
    found = compare([often, near], [], [])
    # the last step at which both have an evaluation within a tenth: 6.5k of one, 6.4k of the other
    assert [list(cells) for cells in found.values()] == [[6500], [6500]]
    assert [found[name][6500]["returns"]["greedy"] for name in found] == [[-8.0], [-4.0]]
    with pytest.raises(UserError, match=r"none of these runs got to step 70k: often at .*; give an earlier --at"):
        gathered([often, seldom], at=[70_000])


def test_a_run_that_was_evaluated_more_often_is_not_there_sooner_for_that():
    rising = [[-9.0 + k] for k in range(9)]
    fine = curve(rising, "fine", tuple(range(0, 401, 50)), seeds=(0,))
    coarse = curve(rising[::2], "coarse", tuple(range(0, 401, 100)), seeds=(0,))
    found = compare([fine, coarse], [], [-6.0])
    # the fine curve has -6 at 150, which the coarse one can show at 200 alone
    assert [found[name][400]["steps_to"][0]["of_mean"] for name in found] == [200, 200]
    assert [found[name][400]["evaluations"] for name in found] == [5, 5]
    assert found["fine"][400]["area_under_curve"] == found["coarse"][400]["area_under_curve"]


def test_each_run_says_how_many_episodes_are_behind_its_returns():
    few, many = curve(PLAIN, "plain"), curve(ESP, "ESP")
    evaluation = many.config.evaluation.model_copy(update={"episodes": 40})
    many = replace(many, config=many.config.model_copy(update={"evaluation": evaluation}))
    found = compare([many, few], [], [])
    assert [found[label][300]["episodes"] for label in ("ESP", "plain")] == [40, 2]


def test_returns_differences_thresholds_and_areas_by_hand():
    found = compare([curve(PLAIN, "plain"), curve(ESP, "ESP")], [100, 210], [-5.0, -2.0, 0.0])
    plain, esp = found["plain"], found["ESP"]
    assert (plain[100]["task_version"], plain[100]["seeds"], plain[100]["seconds"]) == (1, [0, 1, 2], 12.5)
    assert "gap" not in plain[100]["summary"], "the reference has no difference from itself"
    # -6 -7 -8: mean -7, deviations 1 0 -1, variance 1, s.e.m. 1 / sqrt(3)
    at = plain[100]["summary"]["returns"]
    assert (at["mean"], at["sem"]) == (-7.0, pytest.approx(1 / math.sqrt(3), abs=1e-4))
    assert at["per_seed"] == plain[100]["returns"]["greedy"] == [-6.0, -7.0, -8.0]
    assert -8.0 <= at["ci95"][0] < -7.0 < at["ci95"][1] <= -6.0
    assert plain[210]["summary"]["returns"]["mean"] == -5.0
    # -5 -4 -6 less -6 -7 -8, seed by seed: 1 3 2
    gap = esp[100]["summary"]["gap"]
    assert (gap["difference"]["value"], gap["paired"]) == (2.0, True)
    assert gap["difference"]["ci95"] == [pytest.approx(1.0, abs=0.34), pytest.approx(3.0, abs=0.34)]
    assert gap["probability"]["value"] == 1.0
    # at 200: -3 -1 -5 against -4 -6 -5: a win, a win, a tie
    assert esp[210]["summary"]["gap"]["probability"]["value"] == pytest.approx(5 / 6)
    assert esp[210]["summary"]["gap"]["difference"]["value"] == 2.0
    # means of plain: -9 -7 -5 -4; of ESP: -9 -5 -3 -2
    passed = [(p["threshold"], p["of_mean"], p["per_seed"]) for p in plain[210]["steps_to"]]
    assert passed == [(-5.0, 200, [200, 300, 200]), (-2.0, None, [None] * 3), (0.0, None, [None] * 3)]
    passed = [(p["threshold"], p["of_mean"], p["per_seed"]) for p in esp[210]["steps_to"]]
    assert passed[:2] == [(-5.0, 100, [100, 100, 200]), (-2.0, 300, [300, 200, None])]
    # seed 0 up to the last step compared: trapezoids (-9 - 6) / 2 and (-6 - 4) / 2, over two intervals
    assert plain[210]["area_under_curve"][0] == pytest.approx(-6.25)


def test_runs_of_other_seeds_are_not_paired():
    other = curve([[x + 1 for x in row] for row in PLAIN], seeds=(3, 4, 5))
    gap = compare([curve(PLAIN), other], [100], [])["run 1"][100]["summary"]["gap"]
    assert (gap["paired"], gap["difference"]["value"]) == (False, 1.0)
    # pairs of -5 -6 -7 against -6 -7 -8: 6 wins and 2 ties of 9
    assert gap["probability"]["value"] == pytest.approx(7 / 9)


def test_a_stopped_seed_is_left_out_and_shown():
    stopped = [row.copy() for row in ESP]
    stopped[2][1] = stopped[3][1] = NAN
    second = compare([curve(PLAIN), curve(stopped)], [100, 300], [-3.0])["run 1"]
    at = second[300]["summary"]["returns"]
    # -1 and -3: mean -2, s.e.m. |(-1) - (-3)| / 2
    assert (at["mean"], at["sem"], at["per_seed"]) == (-2.0, pytest.approx(1.0), [-1.0, None, -3.0])
    assert "gap" not in second[300]["summary"], "other seeds than the reference's"
    assert second[100]["summary"]["gap"]["difference"]["value"] == 2.0, "before it stopped"
    assert second[300]["steps_to"] == [{"threshold": -3.0, "of_mean": None, "per_seed": [200, None, 300]}]
    assert second[300]["area_under_curve"][1] is None


def test_a_run_whose_seeds_all_stopped_has_no_numbers():
    broken = [PLAIN[0], [NAN] * 3]
    cell = compare([curve(broken, steps=(0, 100))], [100], [])["run 0"][100]
    assert cell["summary"]["returns"] == {"mean": None, "sem": None, "ci95": None, "per_seed": [None, None, None]}


def test_one_seed_leaves_no_error_to_state_and_one_evaluation_no_area():
    cell = compare([curve([[-9.0]], steps=(0,), seeds=(4,))], [], [])["run 0"][0]
    assert cell["summary"]["returns"] == {"mean": -9.0, "sem": None, "ci95": None, "per_seed": [-9.0]}
    assert "area_under_curve" not in cell


@pytest.mark.parametrize(
    "choice", [{"task": "predator-prey"}, {"task__num_agents": 2}, {"task__convention": "pettingzoo"}]
)
def test_other_tasks_settings_or_conventions_do_not_compare(choice):
    with pytest.raises(ValueError, match="different tasks or task settings"):
        compare([curve(PLAIN), curve(ESP, **choice)], [], [])


def test_other_learners_do_compare():
    found = compare([curve(PLAIN), curve(ESP, prior__kind="none", network__name="gru", mappo__num_envs=3)], [], [])
    assert [cells[300]["config"]["network.name"] for cells in found.values()] == ["mlp", "gru"]


def test_a_run_of_a_gpu_is_compared_where_there_is_none():
    there = curve(PLAIN, "gpu")
    there = replace(there, config=there.config.model_copy(update={"device": "cuda"}))
    assert compare([there, curve(ESP)], [100], [])["run 1"][100]["summary"]["gap"]["difference"]["value"] == 2.0


def test_the_picture_shows_the_curves(tmp_path):
    curves = [curve(PLAIN, "plain"), curve(ESP, "ESP")]
    picture = draw_curves(gathered(curves, [100, 200]), tmp_path / "curves.png")
    with Image.open(picture) as image:
        assert image.format == "PNG"
    text = picture.with_suffix(".svg").read_text()
    assert all(part in text for part in ("plain", "ESP", "greedy return (esp: team sum", "navigation"))
    assert text.count("<!-- plain") == 1, "one curve, whatever the number of steps"


def test_what_all_conventions_begin_with_is_said_once():
    assert said_once(["esp: sum, mud 0.9", "esp: sum, wind 0.3"]) == "esp: sum; mud 0.9; wind 0.3"
    assert said_once(["esp: sum, mud 0.9", "esp: mean"]) == "esp: sum, mud 0.9; mean"
    assert said_once(["esp: sum", "esp: sum, mud 0.9", "esp: sum, wind 0.3"]) == "esp: sum; mud 0.9; wind 0.3"
    for unlike in (["sum, mud 0.9"], ["sum", "mean, mud 0.9"], ["sum, mud 0.9", "mean, mud 0.9"]):
        assert said_once(unlike) == "; ".join(unlike)


def test_every_table_compares_at_the_last_step_that_all_runs_reached_and_says_where_each_stands():
    material = gathered([curve(PLAIN, "plain"), curve(ESP[:3], "ESP", steps=STEPS[:3])])
    table = TABLES["comparison"](material.results)
    rows = [dict(zip(table.headings, row, strict=True)) for row in table.rows]
    assert [row["panel"] for row in rows] == ["navigation, 200"] * 2
    assert [row["trained to>"] for row in rows] == ["300", "200"]
    # plain at 200, not at 300: -4 -6 -5
    assert [row["return>"] for row in rows] == ["-5.00 ± 0.58", "-3.00 ± 1.15"]
    assert rows[1]["minus reference>"].startswith("+2.00 [")
    # mean height over the same 200 steps: means -9 -7 -5 and -9 -5 -3
    areas = dict(row[1::4] for row in TABLES["statistics"](material.results).rows)
    assert {name: text.split(" ± ")[0] for name, text in areas.items()} == {"plain": "-7.00", "ESP": "-5.50"}


def test_each_step_asked_for_is_a_panel_and_a_run_that_did_not_get_there_says_where_it_is():
    material = gathered([curve(PLAIN, "plain"), curve(ESP[:2], "ESP", steps=STEPS[:2])], at=[100, 300])
    assert TABLES["returns"](material.results).rows == (
        ("plain", "-7.00 ± 0.58", "-4.00 ± 0.58"),
        ("ESP", "-5.00 ± 0.58", "at 100"),
    )
    assert [cell.status for cell in material.results.cells] == ["finished"] * 3 + ["unfinished"]


def test_a_run_has_the_name_of_its_folder_from_inside_it_too(tmp_path, monkeypatch):
    monkeypatch.chdir(written(tmp_path / "cn", [{"step": 0, "eval/return_greedy": [1.0, 2.0]}]).path)
    (tmp_path / "link").symlink_to(tmp_path / "cn")
    labels = [read_curve(Path(path), None, "greedy").label for path in (".", "../cn", "../link")]
    assert labels == ["cn", "cn", "link"]


def test_a_threshold_that_was_passed_counts_in_a_run_that_ended_before_the_comparison():
    short, whole = curve(PLAIN[:3], "short", STEPS[:3]), curve(ESP, "whole")
    found = compare([short, whole], [300], [-5.0])
    assert [cells[300]["steps_to"][0]["of_mean"] for cells in found.values()] == [200, 100]


def test_a_run_reaches_what_it_ended_with_however_that_is_rounded():
    ends = curve([[-9.0], [-187.80964]], "one", (0, 100), (0,))
    (cell,) = gathered([ends]).results.cells
    assert cell.steps_to[0].of_mean == 0
    rising = curve([[-200.0], [-187.80964]], "one", (0, 100), (0,))
    (cell,) = gathered([rising]).results.cells
    assert (cell.steps_to[0].threshold, cell.steps_to[0].of_mean) == (-187.80964, 100)


def test_a_verdict_does_not_depend_on_the_scale_of_the_rewards():
    for scale in (1e-5, 1.0, 1e5):
        rows = [scale * np.array([[0.0] * 3, [k + 0.1, k + 0.2, k * 1.3]]) for k in (1, 2)]
        cells = gathered([curve(row, f"run {k}", (0, 100)) for k, row in enumerate(rows)]).results.cells
        assert cells[1].summary.gap.ahead == "ahead"
        assert cells[1].returns["greedy"] == pytest.approx(tuple(rows[1][-1]), rel=1e-8, abs=0)
        assert cells[1].steps_to[0].threshold == pytest.approx(1.2 * scale, rel=1e-8)


def test_no_verdict_between_runs_that_are_below_a_policy_that_sees_nothing():
    def verdict(shift):
        seeds = tuple(range(10))
        rows = [shift + np.array([[-9.0] * 10, k * (100 + np.arange(10.0) ** 2)]) for k in (0, 1)]
        cells = gathered([curve(x, f"run {k}", (0, 100), seeds) for k, x in enumerate(rows)]).results.cells
        assert 0 > cells[1].anchors["blind"] > -500
        return cells[1].summary.gap.ahead

    assert (verdict(0.0), verdict(-5000.0)) == ("ahead", "blind")
