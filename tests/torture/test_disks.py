"""Real full and read-only disks: training ends with one sentence and exit code 1, and goes on where there is room."""

import pytest

from esp_cli.training.build import build_learner
from tests.forks import fork, said, wait
from tests.torture.disks import WHY_NOT, can_mount, start_on_full_disk, start_on_read_only_disk
from tests.torture.runs import newest_step, run_job, run_state
from tests.training.runs import tiny_config

pytestmark = pytest.mark.skipif(not can_mount(), reason=WHY_NOT)
ROOM_BYTES = 10**7


@pytest.fixture
def job():
    config = tiny_config(steps=200)
    build_learner(config)  # imports what it needs, once for all forks
    return lambda path: run_job(path, config)


@pytest.mark.parametrize("spare_bytes", [0, 8_000, 60_000])
def test_training_on_a_full_disk_ends_in_one_sentence_and_goes_on_where_there_is_room(job, tmp_path, spare_bytes):
    path, whole = tmp_path / "run", tmp_path / "whole"
    assert wait(start_on_full_disk(job, path, spare_bytes)) == 1
    assert "error: no space left on device" in said(path)
    assert wait(fork(lambda: job(path), path)) == 0
    assert wait(fork(lambda: job(whole), whole)) == 0
    assert run_state(path) == run_state(whole)


def test_a_disk_with_room_disturbs_nothing(job, tmp_path):
    path, whole = tmp_path / "run", tmp_path / "whole"
    assert wait(start_on_full_disk(job, path, ROOM_BYTES)) == 0
    assert wait(fork(lambda: job(whole), whole)) == 0
    assert run_state(path) == run_state(whole)


def test_training_on_a_read_only_disk_ends_in_one_sentence_and_changes_nothing(job, tmp_path):
    path = tmp_path / "run"
    assert wait(start_on_full_disk(job, path, 30_000)) == 1
    before = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    assert wait(start_on_read_only_disk(job, path)) == 1
    assert "error: read-only file system" in said(path)
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == before
    assert newest_step(path) < 200
