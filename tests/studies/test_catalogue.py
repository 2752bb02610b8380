"""The studies as lists of runs: what the paper's figures and tables hold, and what a user may change."""

from dataclasses import replace

import pytest

from esp_cli.checking import measured
from esp_cli.prior.config import PriorConfig
from esp_cli.studies.catalogue import Request, plan, without_effect
from esp_cli.studies.kinds import KINDS
from esp_cli.studies.paper import horizons, reported, tasks
from esp_cli.studies.study import StudyFolder
from esp_cli.symmetry import parse
from esp_envs import registry, task_class
from tests.studies.small_studies import request, small_study

LEARNERS = tuple((algorithm, prior) for algorithm in ("maddpg", "qmix", "mappo") for prior in ("none", "esp"))
PRINTED = """
    table1 predator-prey 500000    56.81±11.26   80.71±9.12    38.93±8.96    59.95±4.86    28.35±6.76    45.22±5.45
    table1 predator-prey 3000000   85.43±8.14    87.06±4.87    48.78±7.75    57.75±6.81    32.54±8.21    59.54±4.32
    table1 navigation 500000     -145.23±3.71  -132.22±1.27  -154.24±3.16  -140.12±2.25  -132.65±2.89  -122.25±1.62
    table1 navigation 3000000    -122.63±6.04  -112.21±2.75  -124.67±3.05  -113.84±1.43  -126.97±2.12  -110.22±2.12
    table1 formation 200000       -45.63±13.96  -41.13±11.17   48.53±20.12   51.23±14.71  122.56±15.12  163.18±14.14
    table1 formation 1000000      -42.13±10.71  -44.13±12.31   49.44±18.71   59.47±14.35  140.64±18.45  170.85±10.2
    agents 2 500000              -101.42±3.24   -94.12±2.15  -106.65±3.68   -98.75±1.89   -99.12±3.25   -92.68±2.65
    agents 2 3000000              -95.72±1.25   -90.92±2.54   -95.95±2.42   -89.32±2.31   -94.67±1.87   -87.54±2.56
    agents 4 500000              -187.57±4.12  -179.93±5.24  -192.57±4.23  -186.32±3.14  -189.42±4.52  -183.87±3.24
    agents 4 3000000             -183.43±4.68  -178.62±5.12  -191.57±4.24  -185.92±3.65  -187.73±2.45  -182.81±2.98
""".strip()
"""Table 1 of the paper, then that of its supplement: MADDPG, with ESP, QMIX, with ESP, MAPPO, with ESP."""
READ_OFF = {
    ("coefficient, read off figure 5c", "navigation", "500000", "maddpg"): {
        "0": -145, "0.01": -138, "0.05": -135, "0.1": -134, "0.5": -132, "1": -137,
    },
    ("coefficient, read off figure 5c", "navigation", "3000000", "maddpg"): {
        "0": -122, "0.01": -116, "0.05": -115, "0.1": -115, "0.5": -115, "1": -116,
    },
    ("networks, read off figure 6b", "wildlife"): {"mpn": 2.1, "empn": 2.25, "mpn-esp": 2.4},
}  # fmt: skip


def panels(study):
    return list(dict.fromkeys(cell.panel for cell in study.cells))


def test_table_1_has_the_papers_rows_and_columns():
    study = plan("table1", Request())
    assert panels(study) == ["predator-prey, 500k", "navigation, 500k", "formation, 200k"]
    variants = list(dict.fromkeys(cell.variant for cell in study.cells))
    assert variants == ["MADDPG", "MADDPG-ESP", "QMIX", "QMIX-ESP", "MAPPO", "MAPPO-ESP"]
    assert {cell.config.seeds for cell in study.cells} == {tuple(range(10))}
    for cell in study.cells:
        esp = cell.variant.endswith("-ESP")
        assert cell.config.prior.kind == ("esp" if esp else "none")
        assert cell.reference == (cell.name.replace("-esp", "-plain") if esp else None)
        assert reported(cell.paper) is not None
    assert len({cell.name for cell in study.cells}) == 18


def test_what_the_paper_does_not_have_is_none():
    assert reported(("table1", "navigation", "123", "mappo", "esp")) is None
    assert reported(None) is None
    assert tasks() == ("predator-prey", "navigation", "formation")
    assert (horizons("navigation"), horizons("formation")) == ((500_000, 3_000_000), (200_000, 1_000_000))
    assert horizons("chess") == ()


@pytest.mark.parametrize("row", PRINTED.splitlines(), ids=lambda row: " ".join(row.split()[:3]))
def test_a_row_of_the_papers_tables_is_as_printed(row: str):
    table, task, steps, *numbers = row.split()
    found = [reported((table, task, steps, *learner)) for learner in LEARNERS]
    assert found == [tuple(map(float, number.split("±"))) for number in numbers]


@pytest.mark.parametrize("place", READ_OFF, ids=" ".join)
def test_what_is_read_off_a_figure_of_the_paper_has_no_error(place: tuple[str, ...]):
    means = READ_OFF[place]
    assert {key: reported((*place, key)) for key in means} == {key: (mean, None) for key, mean in means.items()}


def test_every_cell_of_a_table_has_the_papers_number():
    request = Request(steps=((None, 500_000), (None, 3_000_000)))
    for name, count in (("table1", 3 * 2 * 6), ("agents", 4 * 2 * 6)):  # four agents with four landmarks and with three
        numbers = [reported(cell.paper) for cell in plan(name, request).cells]
        assert (len(numbers), numbers.count(None)) == (count, 0)


def test_500k_and_3m_name_the_papers_rows_and_a_task_of_its_own_is_taken_as_it_is():
    both = plan("table1", Request(steps=((None, 500_000), (None, 3_000_000))))
    assert panels(both)[4:] == ["formation, 200k", "formation, 1M"]
    own = plan("table1", Request(steps=((None, 500_000), ("formation", 500_000))))
    assert panels(own) == ["predator-prey, 500k", "navigation, 500k", "formation, 500k"]
    other = plan("table1", Request(tasks=("formation",), steps=((None, 123_456),)))
    assert panels(other) == ["formation, 123456"]
    assert all(reported(cell.paper) is None for cell in other.cells)


def test_qmix_drives_with_discrete_actions_and_still_compares_with_the_paper():
    cells = {cell.variant: cell for cell in plan("table1", Request(tasks=("formation",))).cells}
    actions = {name: cell.config.task_settings["actions"] for name, cell in cells.items()}
    assert actions == {name: "discrete" if "QMIX" in name else "continuous" for name in cells}
    assert reported(cells["QMIX-ESP"].paper) == (51.23, 14.71)


def test_another_reward_does_not_stand_beside_the_papers_number():
    study = small_study(overrides={"task.convention": "pettingzoo"}, steps=((None, 500_000),))
    assert [cell.paper for cell in study.cells] == [None, None]
    assert all(cell.paper for cell in small_study(steps=((None, 500_000),)).cells)


def test_teams_of_two_three_and_four():
    study = plan("agents", Request(algorithms=("mappo",)))
    shapes = [(c.config.task_settings["num_agents"], c.config.task_settings["num_landmarks"]) for c in study.cells]
    assert shapes == [(2, None)] * 2 + [(3, None)] * 2 + [(4, None)] * 2 + [(4, 3)] * 2
    assert [reported(cell.paper)[0] for cell in study.cells[::2]] == [-99.12, -132.65, -189.42, -189.42]


def test_transforms_vary_number_and_type_with_augmentation_alone():
    study = plan("ablate-transforms", Request())
    priors = [cell.config.prior for cell in study.cells]
    assert [prior.kind for prior in priors] == ["none"] + ["augment"] * 6
    assert [len(parse.parse_elements(prior.transforms, 3)) for prior in priors[1:]] == [1, 2, 3, 2, 3, 7]
    assert [prior.copies for prior in priors[1:]] == ["draw", *["all"] * 3, *["draw"] * 2], "one element: no matter"
    assert {cell.reference for cell in study.cells[1:]} == {study.cells[0].name}
    assert panels(study) == ["navigation, MADDPG, 500k"]


def test_the_coefficient_is_that_of_the_loss_alone_at_two_horizons_and_0_is_the_plain_learner():
    study = plan("ablate-coefficient", Request())
    assert panels(study) == ["navigation, MADDPG, 500k", "navigation, MADDPG, 3M"]
    first = [cell.config.prior for cell in study.cells[:6]]
    assert [prior.coefficient for prior in first] == [0, 0.01, 0.05, 0.1, 0.5, 1]
    assert first[0] == PriorConfig(kind="none")
    assert {(prior.kind, prior.transforms) for prior in first[1:]} == {("consistency", "rot90")}
    assert not any(prior.augments for prior in first)
    assert [reported(cell.paper)[0] for cell in study.cells[:3]] == [-145, -138, -135]


def test_modules_are_none_loss_augmentation_and_both():
    study = plan("ablate-modules", Request(algorithms=("maddpg", "mappo")))
    kinds = [cell.config.prior.kind for cell in study.cells]
    assert kinds == ["none", "consistency", "augment", "esp"] * 2
    assert {c.config.prior.transforms for c in study.cells if c.config.prior.kind != "none"} == {"rot90"}
    assert {c.config.prior.coefficient for c in study.cells} == {0.0, 0.5}


def test_prior_is_each_learner_without_the_prior_and_with_it():
    study = plan("ablate-prior", Request(steps=((None, 20_000),), overrides={"prior.transforms": "c4"}))
    assert [cell.variant for cell in study.cells] == ["MAPPO", "MAPPO-ESP"]
    assert [cell.config.prior.kind for cell in study.cells] == ["none", "esp"]
    assert study.cells[1].reference == study.cells[0].name


def test_a_setting_names_a_task_of_the_caller_whose_module_is_in_a_package(monkeypatch):
    monkeypatch.setattr(registry.TASKS, "_registered", {})
    own = registry.register(task_class("navigation"))
    assert own == "esp_envs.mpe.navigation:Navigation"
    request = Request(tasks=("navigation", own), steps=((None, 20_000),), overrides={f"{own}.num_agents": 2})
    agents = [cell.config.task_settings["num_agents"] for cell in plan("ablate-prior", request).cells]
    assert agents == [3, 3, 2, 2]


def test_a_setting_reaches_the_runs_that_it_concerns():
    study = plan(
        "table1",
        Request(
            tasks=("navigation", "predator-prey"),
            overrides={
                "mappo.gamma": 0.9,
                "predator-prey.prey": "fleeing",
                "prior.transforms": "c4",
                "network.hidden": [8],
            },
        ),
    )
    for cell in study.cells:
        config = cell.config
        assert config.algorithm_settings["gamma"] == (0.9 if config.algorithm == "mappo" else 0.99)
        assert config.task_settings.get("prey") == ("fleeing" if config.task == "predator-prey" else None)
        assert config.network.hidden == (8,)
        assert config.prior.transforms == ("c4" if config.prior.kind == "esp" else PriorConfig().transforms)


def test_a_setting_is_without_effect_where_every_run_that_it_concerns_leaves_it_unused():
    asked = {"mappo.truncation": 5, "prior.replay": "stored", "prior.consistency_coef": 0}
    chosen = request(algorithms=("mappo", "qmix"), tasks=("navigation",), overrides=asked)
    assert without_effect("table1", chosen) == ["mappo.truncation"]
    assert without_effect("table1", replace(chosen, algorithms=("mappo",))) == list(asked)[:2]


@pytest.mark.parametrize(
    ("kind", "choice", "sentence"),
    [
        ("table1", {"overrides": {"prior.kind": "augment"}}, "prior.kind is what this study varies by itself"),
        ("ablate-transforms", {"overrides": {"prior.copies": "all"}}, "prior.copies is what this study varies"),
        ("ablate-transforms", {"overrides": {"prior.kind": "none"}}, "prior.kind is what this study varies"),
        ("ablate-coefficient", {"overrides": {"prior.kind": "none"}}, "prior.kind is what this study varies"),
        ("ablate-breaking", {"overrides": {"navigation.wind": 0.3}}, "navigation.wind is what this study varies"),
        ("table1", {"overrides": {"qmix.gamma": 0.9}}, "--set qmix.gamma concerns no run of this study"),
        ("table1", {"overrides": {"formation.physics": "pymunk"}}, "concerns no run"),
        ("table1", {"tasks": ("navigation",) * 2}, "'navigation' is named twice; name it once"),
        ("table1", {"algorithms": ("mappo",) * 2}, "'mappo' is named twice; name it once"),
        ("table1", {"steps": (("formation", 100),)}, "--steps formation=100 concerns no run"),
        (
            "table1",
            {"steps": (("navigation", 100),), "tasks": ("navigation", "predator-prey")},
            "nothing about predator",
        ),
        ("agents", {"tasks": ("formation",)}, "on navigation alone"),
    ],
)
def test_what_cannot_be_planned_is_told_in_one_sentence(kind, choice, sentence):
    with pytest.raises(ValueError, match=sentence):
        plan(kind, request(**({"tasks": ("navigation",), "overrides": {}} | choice)))


def test_every_study_has_a_title_and_cells_of_its_own_names(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(measured, "_breaking", lambda *_: (("rot90", 0.5),))
    for kind in KINDS:
        study = plan(kind, Request())
        assert study.title
        names = {cell.name for cell in study.cells}
        assert len(names) == len(study.cells)
        assert {cell.reference for cell in study.cells} <= {None, *names}


def test_two_numbers_of_steps_that_are_one_row_of_a_task_are_run_once():
    study = plan("table1", request(tasks=("formation",), steps=((None, 500_000), (None, 200_000)), seeds=(0,)))
    names = [cell.name for cell in study.cells]
    assert len(set(names)) == len(names)
    assert {cell.config.steps for cell in study.cells} == {200_000}


def test_a_seed_stands_in_a_run_once():
    with pytest.raises(ValueError, match="twice"):
        plan("table1", request(tasks=("navigation",), seeds=(0, 0)))


def test_a_class_with_letters_beyond_ascii_has_a_study(monkeypatch, tmp_path):
    monkeypatch.setattr(registry.TASKS, "_registered", {})
    own = registry.register(type("Fläche", (task_class("navigation"),), {"__module__": "feld"}))
    study = plan("ablate-prior", Request(tasks=(own,), steps=((None, 20_000),)))
    assert StudyFolder.create(tmp_path / "s", study).study.cells[0].name.startswith("feld-fl-che-")
