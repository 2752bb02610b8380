"""The answer of a report: sentences that are made from the numbers."""

import shutil
from pathlib import Path

import pytest

from esp_cli.reporting.collect import collect_study
from esp_cli.reporting.page import answer
from esp_cli.studies.study import StudyFolder
from tests.studies.small_studies import small_study, write_run


def answered(
    path: Path, plain: list[list[float | None]], ours: list[list[float | None]], seeds: tuple[int, ...] = (0, 1, 2)
) -> list[str]:
    """The answer on a study of two runs with these evaluations at 0 and 100 and the last as the final evaluation."""
    folder = StudyFolder.create(path, small_study(seeds=seeds))
    for cell, rows in zip(folder.study.cells, (plain, ours), strict=True):
        write_run(folder, cell, rows, rows[-1])
    return answer(collect_study(folder))


@pytest.mark.parametrize(
    ("ours", "verdict"),
    [
        ([-121.0, -121.0, -118.0], "MAPPO-ESP is better than MAPPO: the difference is +40.00, 95 % interval [39"),
        ([-161.0, -158.0, -164.0], "MAPPO-ESP is not told apart from MAPPO: the difference is -1.00"),
        ([-182.0, -180.0, -178.0], "MAPPO-ESP is worse than MAPPO: the difference is -20.00"),
    ],
)
def test_the_verdict_follows_the_interval_of_the_difference(tmp_path: Path, ours: list, verdict: str) -> None:
    first, second, third = answered(tmp_path / "s", [[-200.0] * 3, [-161.0, -160.0, -159.0]], [[-150.0] * 3, ours])
    assert first.endswith(", where 0 is the random policy and 1 the best hand-written one).")
    assert first.startswith("navigation, 200: MAPPO-ESP has ")
    assert "and MAPPO has -160.00 ± 0.58 (greedy return, 3 seeds; normalised" in first
    assert second.startswith(verdict)
    assert third == "The mean over seeds first has -160.00 after 0 steps of MAPPO-ESP, 100 of MAPPO."


def test_a_learner_that_stays_below_is_compared_at_what_both_have(tmp_path: Path) -> None:
    *_, third = answered(tmp_path / "s", [[-200.0] * 3, [-100.0] * 3], [[-190.0] * 3, [-150.0] * 3])
    assert third == "The mean over seeds first has -150.00 after 100 steps of MAPPO-ESP, 100 of MAPPO."


def test_a_stopped_seed_leaves_no_verdict(tmp_path: Path) -> None:
    first, second, *_ = answered(tmp_path / "s", [[-200.0] * 3, [-160.0] * 3], [[-150.0] * 3, [-120.0, None, -119.0]])
    assert "(greedy return, 2 and 3 seeds; normalised" in first
    assert second == (
        "There is no interval of the difference: a seed of MAPPO-ESP stopped, and the others are no fair sample."
    )


def test_runs_with_a_stopped_seed_are_named_and_not_counted(tmp_path: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study("ablate-modules", algorithms=("mappo",)))
    for cell, ends in zip(
        folder.study.cells, ([-160.0] * 3, [-150.0, -151.0, -149.0], [-1.0, None, -1.0], [None] * 3), strict=True
    ):
        write_run(folder, cell, [[-200.0] * 3, [-150.0] * 3], ends)
    first, _, last = answer(collect_study(folder))
    assert first.startswith("Of 1 run beside their reference: better 1, not told apart 0, worse 0")
    names = [cell.variant for cell in folder.study.cells]
    panel = folder.study.cells[0].panel
    assert last == f"Not compared, since a seed stopped: {names[2]}, {panel}; {names[3]}, {panel}."


def test_the_steps_at_a_threshold_that_was_asked_for_are_told(tmp_path: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study())
    for cell, end in zip(folder.study.cells, (-160.0, -120.0), strict=True):
        write_run(folder, cell, [[-200.0] * 3, [end] * 3], [end] * 3)
    *_, told = answer(collect_study(folder, thresholds=[-125.0]), [-125.0])
    assert told == "The mean over seeds first has -125: MAPPO never, MAPPO-ESP after 100 steps."
    (folder.path / "runs" / folder.study.cells[0].name / "policy.safetensors").unlink()
    *_, told = answer(collect_study(folder, thresholds=[-125.0]), [-125.0])
    assert told.endswith(": MAPPO not up to 100 steps, MAPPO-ESP after 100 steps.")
    shutil.rmtree(folder.path / "runs" / folder.study.cells[1].name)
    *_, told = answer(collect_study(folder, thresholds=[-125.0]), [-125.0])
    assert told.endswith(": MAPPO not up to 100 steps, MAPPO-ESP not run.")


def test_runs_that_differ_alike_with_every_seed_need_no_more_seeds(tmp_path: Path) -> None:
    _, second, *_ = answered(tmp_path / "s", [[-200.0] * 3, [-160.0] * 3], [[-150.0] * 3, [-120.0] * 3])
    assert second == "MAPPO-ESP and MAPPO differ by +40.00 with every seed."


def test_of_several_runs_the_better_and_the_worse_are_counted(tmp_path: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study("ablate-modules", algorithms=("mappo",)))
    for k, (cell, end) in enumerate(zip(folder.study.cells, (-160.0, -150.0, -160.0, -170.0), strict=True)):
        write_run(folder, cell, [[-200.0] * 3, [end, end, end]], [end, end - k, end + k])
    first, second = answer(collect_study(folder))
    assert first == (
        "Of 3 runs beside their reference: better 1, not told apart 1, worse 1 (95 % intervals of the difference)."
    )
    assert second.startswith("The largest difference is +10.00 [")
    assert second.endswith("(both; navigation, MAPPO, 200).")
    assert "] (loss; navigation, MAPPO, 200), the smallest -10.00 [" in second


def test_of_several_runs_of_two_seeds_nothing_is_counted(tmp_path: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study("ablate-modules", algorithms=("mappo",), seeds=(0, 1)))
    for k, cell in enumerate(folder.study.cells):
        write_run(folder, cell, [[-200.0] * 2, [-150.0] * 2], [-150.0, -140.0 + k])
    few, extremes = answer(collect_study(folder))
    assert few == "Fewer than three seeds tell nothing for sure."
    assert extremes.startswith("The largest difference is +1.50 [0.00, 3.00] (both; ")


def test_a_difference_of_two_seeds_is_told_with_its_interval(tmp_path: Path) -> None:
    _, second, *_ = answered(tmp_path / "s", [[-200.0] * 2, [-160.0] * 2], [[-150.0] * 2, [-120.0, -118.0]], (0, 1))
    assert second == (
        "MAPPO-ESP and MAPPO differ by +41.00, 95 % interval [40.00, 42.00]. "
        "Fewer than three seeds tell nothing for sure."
    )
    _, second, *_ = answered(tmp_path / "t", [[-200.0] * 2, [-160.0] * 2], [[-150.0] * 2, [-120.0] * 2], (0, 1))
    assert second == "MAPPO-ESP and MAPPO differ by +40.00. Fewer than three seeds tell nothing for sure."


def test_runs_that_differ_alike_with_every_seed_are_counted_among_several(tmp_path: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study("ablate-modules", algorithms=("mappo",)))
    for cell, ends in zip(
        folder.study.cells, ([-160.0] * 3, [-160.0] * 3, [-159.0] * 3, [-150.0, -151.0, -149.0]), strict=True
    ):
        write_run(folder, cell, [[-200.0] * 3, ends], ends)
    assert answer(collect_study(folder))[0] == (
        "Of 3 runs beside their reference: better 1, not told apart 0, worse 0, by the same with every seed 2 "
        "(95 % intervals of the difference)."
    )


def test_runs_without_a_finished_reference_say_so_and_how_many_there_are(tmp_path: Path) -> None:
    folder = StudyFolder.create(tmp_path / "s", small_study("ablate-modules", algorithms=("mappo",)))
    for cell in folder.study.cells[1:]:
        write_run(folder, cell, [[-200.0] * 3, [-150.0] * 3], [-150.0] * 3)
    assert answer(collect_study(folder))[2:] == [
        "The table has 1 more.",
        "Nothing is compared: the reference of no run has a return here.",
    ]
    write_run(folder, folder.study.cells[0], [[-200.0] * 3, [-150.0] * 3], [-150.0] * 3)
    assert not any("1 more" in line for line in answer(collect_study(folder)))
