"""Study folders: plain files, gone on with, extended, and never written over."""

import json
import shutil
import sys

import pytest

from esp_cli.files.opening import is_held
from esp_cli.files.writing import TEMPORARY_PREFIX
from esp_cli.reporting.collect import collect_study
from esp_cli.reporting.page import answer
from esp_cli.reporting.tables import TABLES
from esp_cli.studies.engine import LocalEngine
from esp_cli.studies.plan import STUDY_FORMAT
from esp_cli.studies.study import StudyFolder, read_evaluation
from esp_cli.training.folder_names import FINAL, LOG
from esp_envs.errors import UserError
from tests.studies.small_studies import small_study, write_run, write_study
from tests.training.runs import TINY

ENDS = {"MAPPO": [-120.0, -121.0, -122.0]}

EMPTY = {"format": "esp-study", "version": 1, "cells": []}


def test_a_study_is_read_as_it_was_written_and_going_on_changes_nothing(tmp_path):
    study = small_study()
    folder = StudyFolder.create(tmp_path / "a" / "study", study)
    before = (folder.path / "study.json").read_bytes()
    assert StudyFolder.open(folder.path).study == folder.study
    assert StudyFolder.create(folder.path, study).study == folder.study
    assert (folder.path / "study.json").read_bytes() == before


def test_a_study_grows_by_cells_and_keeps_the_others(tmp_path):
    first = StudyFolder.create(tmp_path / "s", small_study(command="esp a")).study
    more = StudyFolder.create(tmp_path / "s", small_study(tasks=("predator-prey",), command="esp b")).study
    assert more.command == "esp a\nesp b"
    assert [cell.config.task for cell in more.cells] == ["predator-prey"] * 2 + ["navigation"] * 2
    assert more.cells[2:] == first.cells
    assert StudyFolder.open(tmp_path / "s").study == more


def test_cells_that_stay_are_compared_with_the_reference_that_was_planned_last(tmp_path):
    first = small_study("ablate-modules", algorithms=("mappo",))
    none, loss = (cell for cell in first.cells if cell.variant in (first.cells[0].variant, "loss"))
    changed = [none.model_copy(update={"reference": loss.name}), loss.model_copy(update={"reference": None})]
    StudyFolder.create(tmp_path / "s", first)
    study = first.model_copy(update={"cells": (changed[1], changed[0])})
    merged = StudyFolder.create(tmp_path / "s", study).study
    assert {cell.reference for cell in merged.cells} == {None, loss.name}
    assert [cell.name for cell in merged.cells if cell.reference is None] == [loss.name]


def test_another_learner_in_a_panel_keeps_a_reference_of_its_own(tmp_path):
    first = StudyFolder.create(tmp_path / "s", small_study(algorithms=("mappo",), command="esp a")).study
    more = StudyFolder.create(tmp_path / "s", small_study(algorithms=("maddpg",), command="esp b")).study
    assert more.cells[2:] == first.cells
    assert [cell.reference for cell in more.cells] == [None, more.cells[0].name, None, first.cells[0].name]


def test_a_study_that_keeps_no_others_holds_what_was_planned_last(tmp_path):
    StudyFolder.create(tmp_path / "s", small_study(command="esp a"))
    study = small_study(tasks=("predator-prey",), command="esp b")
    assert StudyFolder.create(tmp_path / "s", study, keep=False).study == study
    assert StudyFolder.open(tmp_path / "s").study == study


def test_a_run_is_refused_beside_one_for_which_other_settings_were_given(tmp_path):
    def planned(**choice):
        return StudyFolder.create(tmp_path / "s", small_study("ablate-prior", **choice))

    planned(variants=("plain",), overrides=TINY | {"mappo.gamma": 0.5, "navigation.wind": 0.1})
    known = TINY | {"mappo.gamma": 0.5, "task.wind": 0.1}
    for overrides, told in (
        (
            TINY | {"task.wind": 0.1},
            r"has mappo\.gamma 0\.5, and a table would compare .*-esp, which has 0\.\d+;",
        ),
        (known | {"mappo.gamma": 0.6}, r"has mappo\.gamma 0\.5, .* which has 0\.6; give both the same, or"),
        (known | {"mappo.gae_lambda": 0.5}, r"has mappo\.gae_lambda 0\.\d+, .* which has 0\.5;"),
    ):
        with pytest.raises(UserError, match=told):
            planned(variants=("ESP",), overrides=overrides)
    gae = small_study("ablate-prior", overrides=TINY).cells[0].config.algorithm_settings["gae_lambda"]
    same = known | {"mappo.gae_lambda": gae, "prior.consistency_coef": 0.25, "network.hidden": (8, 8)}
    assert planned(variants=("plain",), overrides=known | {"network.hidden": (8, 8)}, steps=((None, 300),))
    assert len(planned(variants=("ESP",), overrides=same, steps=((None, 300),)).study.cells) == 3, (
        "is idle, or the same"
    )
    folder = planned(tasks=("predator-prey",), overrides=TINY)
    assert len(folder.study.cells) == 5, "whose table compares them with no run of navigation"
    unknown = [cell.model_copy(update={"given": None}) for cell in folder.study.cells]
    STUDY_FORMAT.write(
        folder.path / "study.json",
        {**folder.study.model_dump(mode="json"), "cells": [c.model_dump(mode="json") for c in unknown]},
    )
    assert len(planned(variants=("ESP",), overrides=TINY).study.cells) == 6, "planned by an earlier version"


@pytest.mark.parametrize(
    ("kind", "choice"),
    [("table1", {"seeds": (0,)}), ("table1", {"overrides": {}}), ("table1", {"episodes": 5}), ("agents", {})],
)
def test_another_study_in_the_same_place_is_refused(tmp_path, kind, choice):
    StudyFolder.create(tmp_path / "s", small_study())
    with pytest.raises(ValueError, match=r"holds another study.*; go on with it by 'esp reproduce table1 --steps 200'"):
        StudyFolder.create(tmp_path / "s", small_study(kind, **choice))


def test_a_study_goes_on_where_a_number_of_the_paper_no_longer_compares(tmp_path):
    study = small_study()
    papers = [
        cell.model_copy(update={"paper": ("table1", "navigation", "500000", "mappo", "esp")}) for cell in study.cells
    ]
    StudyFolder.create(tmp_path / "s", study.model_copy(update={"cells": tuple(papers)}))
    assert StudyFolder.create(tmp_path / "s", study).study == study
    assert StudyFolder.open(tmp_path / "s").study == study


def test_something_foreign_is_never_written_into(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ValueError, match=r"not empty and no study \(it has 'thesis.tex'\)"):
        StudyFolder.create(tmp_path, small_study())
    with pytest.raises(ValueError, match="is a file"):
        StudyFolder.create(tmp_path / "thesis.tex", small_study())
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is not valid JSON"),
        (b'{"format": "other"}', "is foreign"),
        (b'{"format": "esp-study", "version": 99}', "newer esp"),
        (b'{"format": "esp-study", "version": 1}', "the setting 'kind' is missing"),
        (json.dumps(small_study().model_dump() | EMPTY).encode(), "it names no run; plan the study again"),
    ],
)
def test_a_damaged_study_is_told_in_one_sentence(tmp_path, content, sentence):
    (tmp_path / "study.json").write_bytes(content)
    with pytest.raises(ValueError, match=sentence):
        StudyFolder.open(tmp_path)


def test_one_process_holds_a_study(tmp_path):
    path = tmp_path / "s"
    with StudyFolder.held(path):
        StudyFolder.create(path, small_study())
        with pytest.raises(UserError, match="is in use by process"), StudyFolder.held(path):
            pass
        assert is_held(path / "study.lock")
    assert not is_held(path / "study.lock")
    assert not is_held(path / "no such file")


def test_no_lock_is_made_in_a_folder_of_something_else(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(UserError, match="is not empty and no study"), StudyFolder.held(tmp_path):
        pass
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_run_may_be_compared_with_another_one_than_before_and_with_no_other_settings(tmp_path):
    study = small_study()
    StudyFolder.create(tmp_path / "s", study)
    first, *others = study.cells
    again = study.model_copy(update={"cells": (first, *(c.model_copy(update={"reference": None}) for c in others))})
    StudyFolder.create(tmp_path / "s", again)
    assert [cell.reference for cell in StudyFolder.open(tmp_path / "s").study.cells] == [None] * len(study.cells)
    config = first.config.model_copy(update={"steps": 10**6})
    changed = study.model_copy(update={"cells": (first.model_copy(update={"config": config}), *others)})
    with pytest.raises(UserError, match=f"{first.name} has other seeds or settings"):
        StudyFolder.create(tmp_path / "s", changed)


def test_links_in_a_run_that_is_taken_over_stay_behind(tmp_path):
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key").write_text("mine")
    theirs, ours = (StudyFolder.create(tmp_path / name, small_study()) for name in "ab")
    cell = theirs.study.cells[0]
    run = theirs.prepare(cell).path
    (run / "leak").symlink_to(tmp_path / "secret")
    (run / "checkpoints" / "leak").symlink_to(tmp_path / "secret" / "key")
    ours.adopt(ours.study.cells[0], run)
    copied = {path.name for path in ours.run_path(ours.study.cells[0]).rglob("*")}
    assert "config.json" in copied
    assert "leak" not in copied
    assert "key" not in copied


def test_finished_is_trained_and_evaluated(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), ENDS)
    plain, esp = folder.study.cells
    assert (folder.is_finished(plain), folder.is_finished(esp)) == (True, False)
    (folder.run_path(plain) / FINAL).write_text('{"task": ')  # half of one, as after a power cut
    assert folder.is_trained(plain)
    assert not folder.is_finished(plain)
    assert read_evaluation(folder.run_path(esp)) is None


def test_a_run_whose_seeds_all_stopped_has_ended_and_is_reported(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), {})
    plain, esp = folder.study.cells
    write_run(folder, plain, [[-200.0] * 3, [-150.0] * 3], [-150.0] * 3)
    write_run(folder, esp, [[-200.0] * 3, [-180.0, None, -190.0]], [-1.0] * 3)
    (folder.run_path(esp) / "policy.safetensors").unlink()
    assert not folder.is_finished(esp), "one seed goes on"
    with (folder.run_path(esp) / "metrics.jsonl").open("a") as metrics:
        metrics.write('{"step": 150, "eval/return_greedy": [null, null, null]}\n')
    assert folder.is_finished(esp)
    (folder.run_path(esp) / FINAL).unlink()
    assert folder.is_finished(esp), "there is no policy to evaluate"
    material = collect_study(folder, thresholds=[-170.0])
    assert material.results.cells[1].status == "finished"
    *_, left_out, reached = answer(material, [-170.0])
    assert left_out == "Not compared, since a seed stopped: MAPPO-ESP, navigation, 200."
    assert reached.endswith("MAPPO after 100 steps, MAPPO-ESP at no step that is known, since a seed stopped.")
    assert [row[3] for row in TABLES["steps"](material.results).rows] == ["100", "-"]
    other = StudyFolder.create(tmp_path / "t", small_study())
    assert other.find_twin(esp, [folder]) == folder.run_path(esp), "another study need not try it again"
    folder.prepare(esp).write_checkpoint(200, {}, {"task_version": 2})
    assert other.find_twin(esp, [folder]) is None, "which has other rules"
    with pytest.raises(UserError, match=r"-esp holds a run of navigation version 2, but this is version 1"):
        StudyFolder.create(folder.path, small_study())


def test_a_run_of_another_configuration_is_not_gone_on_with(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), ENDS)
    cell = folder.study.cells[0]
    file = folder.run_path(cell) / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"steps": 7}))
    assert not folder.is_finished(cell)
    with pytest.raises(ValueError, match="holds a run of another configuration"):
        folder.prepare(cell)
    with pytest.raises(UserError, match=r"does not fit its study: its config\.json is that of another run, or damaged"):
        collect_study(folder)


@pytest.mark.parametrize(
    "other",
    [
        {"episodes": 1},
        {"seeds": [0, 1, 3]},
        {"step": 100},
        {"task": "formation"},
        {"task_settings": {"wind": 0.5}},
        {"greedy": {"mean": None, "sem": None, "ci95": None, "per_seed": [-1.0]}},
    ],
)
def test_an_evaluation_of_something_else_is_made_anew(tmp_path, other):
    folder = write_study(tmp_path / "s", small_study(), ENDS)
    cell = folder.study.cells[0]
    file = folder.run_path(cell) / FINAL
    final = json.loads(file.read_text())
    for settings in (cell.config.task_settings, {"wind": 0.0, "gust_std": 0.0}):  # gust_std was a setting once
        file.write_text(json.dumps(final | {"task_settings": settings}))
        assert folder.is_finished(cell), "an earlier version told fewer settings, or more"
    file.write_text(json.dumps(final | other))
    assert not folder.is_finished(cell)
    assert StudyFolder.create(tmp_path / "t", small_study()).find_twin(cell, [folder]) is None
    assert collect_study(folder).results.cells[0].status == "unfinished"
    assert folder.next_command(cell)[0] == "eval"


def test_a_finished_run_of_the_same_configuration_is_taken_over_from_another_study(tmp_path):
    other = write_study(tmp_path / "other", small_study(), ENDS)
    folder = StudyFolder.create(tmp_path / "s", small_study())
    plain, esp = folder.study.cells
    twin = folder.find_twin(plain, [other])
    assert twin == other.run_path(plain)
    assert folder.find_twin(esp, [other]) is None, "not finished there"
    folder.adopt(plain, twin)
    assert folder.is_finished(plain)
    assert read_evaluation(folder.run_path(plain)) == read_evaluation(twin)
    assert (folder.run_path(plain) / LOG).read_text().endswith(f"taken over from {twin}\n")
    assert folder.find_twin(plain, [other]) is None, "it is there now"
    assert sorted(path.name for path in folder.run_path(plain).parent.iterdir()) == [plain.name]


def test_a_run_that_cannot_be_copied_is_one_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    other = write_study(tmp_path / "other", small_study(), ENDS)
    folder = StudyFolder.create(tmp_path / "s", small_study())

    def copytree(source, part, ignore):
        part.mkdir(parents=True)
        raise shutil.Error([(str(source), str(part), "[Errno 28] No space left on device")])

    monkeypatch.setattr(shutil, "copytree", copytree)
    with pytest.raises(UserError, match=r"cannot be copied to .*: \[Errno 28\] No space left on device"):
        folder.adopt_finished(folder.study.cells, [other])
    assert not any((folder.path / "runs").iterdir())


def test_a_run_of_another_version_of_the_task_is_no_twin_and_its_study_does_not_go_on(tmp_path):
    other = write_study(tmp_path / "other", small_study(), ENDS)
    plain = other.study.cells[0]
    file = other.run_path(plain) / FINAL
    found = json.loads(file.read_text())
    file.write_text(json.dumps(found | {"task_version": found["task_version"] + 1}))
    folder = StudyFolder.create(tmp_path / "s", small_study())
    assert other.is_finished(plain)
    assert folder.find_twin(folder.study.cells[0], [other]) is None
    with pytest.raises(UserError, match="holds a run of navigation version 2, but this is version 1"):
        StudyFolder.create(other.path, small_study())


@pytest.mark.parametrize("choice", [{"seeds": (0, 1)}, {"steps": ((None, 300),)}, {"episodes": 8}])
def test_a_run_of_other_seeds_or_steps_or_evaluated_otherwise_is_no_twin(tmp_path, choice):
    other = write_study(tmp_path / "other", small_study(), ENDS)
    folder = StudyFolder.create(tmp_path / "s", small_study(**choice))
    assert folder.find_twin(folder.study.cells[0], [other]) is None


def test_ablations_share_their_runs_with_each_other_and_with_table_1():
    """The plain learner, which c = 0 is too, and the loss alone and augmentation alone with a quarter turn."""
    configs = {
        kind: {cell.variant: cell.config for cell in small_study(kind).cells}
        for kind in ("table1", "ablate-modules", "ablate-transforms", "ablate-coefficient")
    }
    plain = configs["table1"]["MAPPO"]
    modules = configs["ablate-modules"]
    assert plain == modules["none"] == configs["ablate-transforms"]["none"] == configs["ablate-coefficient"]["c = 0"]
    assert modules["augmentation"] == configs["ablate-transforms"]["rot90"]
    assert modules["loss"] == configs["ablate-coefficient"]["c = 0.5"]
    assert len({config.model_dump_json() for config in modules.values()}) == 4


def test_a_run_of_version_0_1_0_whose_network_has_the_fields_of_all_is_gone_on_with(tmp_path):
    folder = write_study(tmp_path / "s", small_study(), ENDS)
    cell = folder.study.cells[0]
    file = folder.run_path(cell) / "config.json"
    stored = json.loads(file.read_text())
    file.write_text(json.dumps(stored | {"network": stored["network"] | {"group": "c4"}}))
    assert folder.prepare(cell).path == folder.run_path(cell)


@pytest.mark.parametrize("name", ["../../x", "/tmp/x", "a/b", "..", ".x", "", "a\nb", "x" * 300, "twice"])
def test_a_study_whose_run_would_lie_outside_its_folder_or_is_named_twice_is_refused(tmp_path, name):
    folder = StudyFolder.create(tmp_path / "s", small_study())
    text = (folder.path / "study.json").read_text()
    content = json.loads(text)
    content["cells"][0]["name"] = content["cells"][1]["name"] if name == "twice" else name
    (folder.path / "study.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="is not the name of one run"):
        StudyFolder.open(folder.path)
    (folder.path / "study.json").write_text(text)
    StudyFolder.open(folder.path)  # negative control


def test_planted_links_at_the_lock_and_the_log_are_not_written_to(tmp_path):
    folder = StudyFolder.create(tmp_path / "s", small_study())
    mine = tmp_path / "mine.txt"
    mine.write_text("mine")
    (folder.path / "study.lock").symlink_to(mine)
    with pytest.raises(UserError, match="no regular file is there; remove it"), StudyFolder.held(folder.path):
        pass
    log = tmp_path / "log.txt"
    log.symlink_to(mine)
    with pytest.raises(OSError, match="no regular file is there; remove it"):
        LocalEngine([sys.executable, "-c", "pass"]).start(["x"], log)
    assert mine.read_text() == "mine"


def test_a_study_killed_while_its_first_document_is_written_goes_on(tmp_path):
    (tmp_path / f"{TEMPORARY_PREFIX}0").write_text("half")
    with StudyFolder.held(tmp_path):
        assert [path.name for path in tmp_path.iterdir()] == ["study.lock"]
    (tmp_path / "fresh").mkdir()
    (tmp_path / "fresh" / f"{TEMPORARY_PREFIX}0").write_text("half")
    (tmp_path / "study.json").write_text("{}")
    with StudyFolder.held(tmp_path):
        StudyFolder.create(tmp_path / "fresh", small_study())
        assert [path.name for path in (tmp_path / "fresh").iterdir()] == ["study.json"]


def test_runs_are_not_written_through_a_link(tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "runs").symlink_to(tmp_path / "outside")
    with pytest.raises(UserError, match="runs is a link, which is not followed"), StudyFolder.held(tmp_path / "s"):
        pass
