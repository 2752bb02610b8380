"""A small part of the assault in every test run, and the assault's own negative controls."""

import random

import pytest

from esp_cli.bodies import emitting, reading
from esp_cli.files import writing
from esp_cli.loop import shapes
from esp_cli.symmetry import Transform
from esp_cli.training import trainer
from tests.bodies.models import biped
from tests.forks import fork, wait
from tests.torture.files import KINDS, Files
from tests.torture.hosts import Hosts
from tests.torture.kills import Kills
from tests.torture.lines import Lines
from tests.torture.models import Models
from tests.torture.record import Record
from tests.torture.studies import forked_study, kill_members, real_study, study_state


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return Files(tmp_path_factory.mktemp("files"), 1)


def test_spoilt_files_of_every_kind_are_the_right_content_or_one_sentence(files, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert [files.run(number) for number in range(2 * len(KINDS))] == [None] * 2 * len(KINDS)
    assert files.count() == 200 * len(KINDS)


def test_a_loader_that_lets_damage_through_is_found(files, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    right = type("Right", (), {"__ne__": lambda self, other: False})()
    monkeypatch.setattr("esp_cli.training.checkpoint.digest", lambda tensors, description: right)
    monkeypatch.setattr("esp_cli.training.checkpoint._check_tensors", lambda tensors: None)
    assert any(files.run(number) for number in range(0, 20 * len(KINDS), len(KINDS)))


def test_wrong_command_lines_end_in_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setattr("esp_cli.commands.train._train", None)  # put back after the test
    lines = Lines(tmp_path, 1)
    assert [lines.run(number) for number in range(10)] == [None] * 10


@pytest.fixture
def models(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Models(tmp_path, 1)


def test_models_of_strangers_read_write_and_run_nothing_that_was_not_named(models):
    assert [models.run(number) for number in range(4)] == [None] * 4
    assert models.count() == 20


def test_a_name_that_reaches_the_code_unescaped_is_found(models, monkeypatch):
    monkeypatch.setattr(emitting.pprint, "pformat", lambda value, **_: "'" + str(value) + "'")
    assert any(models.run(number) for number in range(20))


def test_a_file_outside_that_is_opened_is_found(models, monkeypatch):
    path = models.folder / "robot.xml"
    path.write_text(biped().replace("</worldbody>", '</worldbody><include file="../outside/secret.xml"/>'))
    assert models._try(path, random.Random(1)) is None
    monkeypatch.setattr(reading, "_files", lambda main, name, folders, allowed: [])
    assert "outside was opened" in models._try(path, random.Random(1))


def test_data_of_foreign_loops_has_the_right_copies_or_one_sentence(tmp_path, monkeypatch):
    hosts = Hosts(tmp_path, 1)
    assert [hosts.run(number) for number in range(3)] == [None] * 3
    monkeypatch.setattr(shapes, "check_tensor", lambda name, x: None)
    assert any(hosts.run(number) for number in range(3))


@pytest.mark.parametrize(("move", "wrong"), [("obs", 0.0), ("state", 0.0), ("obs", 1.0), ("state", 1.0)])
def test_data_that_is_copied_wrongly_is_found(tmp_path, monkeypatch, move, wrong):
    monkeypatch.setattr(Transform, move, lambda self, x: x + wrong)
    hosts = Hosts(tmp_path, 1)
    assert any(hosts.run(number) for number in range(3))


@pytest.fixture(scope="module")
def kills(tmp_path_factory):
    return Kills(tmp_path_factory.mktemp("kills"), 1)


@pytest.mark.slow
def test_runs_that_were_killed_end_as_runs_that_were_not(kills, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert [kills.run(number) for number in range(4)] == [None] * 4
    assert kills.count() > 0


@pytest.mark.slow
def test_a_study_of_real_processes_loses_nothing_when_any_or_all_of_them_are_killed(tmp_path):
    whole, path = tmp_path / "whole" / "study", tmp_path / "killed" / "study"
    for folder in (whole, path):
        folder.parent.mkdir()
    assert wait(fork(lambda: forked_study(whole), whole)) == 0
    checkpoint = "runs/*/checkpoints/step-*"
    assert kill_members(real_study, path, "job", "KILL", lambda members: any(path.glob(checkpoint))) == 1
    assert kill_members(real_study, path, "parent", "KILL", lambda members: len(members) > 1) == -9
    assert kill_members(real_study, path, "all", "KILL", lambda members: len(members) > 1) == -9
    assert wait(fork(lambda: forked_study(path), path)) == 0
    assert study_state(path) == study_state(whole)


@pytest.mark.slow
def test_a_run_folder_that_forgets_a_checkpoint_is_found(kills, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainer, "truncate_metrics", lambda path, last_step: 0)
    assert any(kills.run(number) for number in range(100, 110))


def test_a_record_goes_on_where_it_ended(tmp_path):
    class Part:
        def __init__(self):
            self.seen = []

        def run(self, number):
            self.seen.append(number)
            return "bad" if number == 1 else None

        def count(self):
            return 10

    first, second = Part(), Part()
    Record.open(tmp_path / "r.json", 3).run("x", first, float("inf"), 30)
    record = Record.open(tmp_path / "r.json", 3)
    record.run("x", second, float("inf"), 50)
    assert (first.seen, second.seen) == ([0, 1, 2], [3, 4])
    assert record.counts == {"x": 50}
    assert [finding.number for finding in record.findings] == [1]
    assert writing.TEMPORARY_PREFIX not in "".join(entry.name for entry in tmp_path.iterdir())
    with pytest.raises(SystemExit, match="is the record of seed 3"):
        Record.open(tmp_path / "r.json", 4)
