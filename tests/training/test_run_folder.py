"""Run folders: made whole, never over something foreign, locked by one process, resumed from a good checkpoint."""

import json
import os
import re

import pytest
import torch

from esp_cli.files.writing import TEMPORARY_PREFIX
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_envs.errors import UserError
from tests.faults import Fault

CONFIG = {"task": "navigation", "seeds": [0, 1], "algorithm": {"learning_rate": 7e-4, "clip": None}}


def weights(step):
    return {"weight": torch.full((4,), float(step))}


@pytest.fixture
def folder(tmp_path):
    return RunFolder.create(tmp_path / "runs" / "a", CONFIG)


def write_checkpoints(folder, *steps):
    for step in steps:
        folder.write_checkpoint(step, weights(step), {"iteration": step // 100})


def names(folder):
    return [file.name for file in folder.checkpoints()]


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


def test_create_then_open_gives_the_configuration_back(folder):
    opened = RunFolder.open(folder.path)
    assert opened.config == folder.config == CONFIG
    assert opened.latest_checkpoint(pytest.fail) is None
    assert read_metrics(opened.metrics_path) == []
    assert {entry.name for entry in folder.path.iterdir()} == {
        "config.json",
        "metrics.jsonl",
        "checkpoints",
        "run.lock",
    }
    document = json.loads((folder.path / "config.json").read_text())
    assert document == {"format": "esp-run", "version": 1, "run_id": folder.identity, **CONFIG}
    assert opened.identity == folder.identity


def test_create_refuses_an_existing_run_and_leaves_it_alone(folder):
    write_checkpoints(folder, 100)
    with pytest.raises(UserError) as caught:
        RunFolder.create(folder.path, {"task": "other"})
    assert str(caught.value) == (
        f"{folder.path} exists: resume with esp train --resume {folder.path} or choose another --out"
    )
    assert RunFolder.open(folder.path).config == CONFIG
    assert names(folder) == ["step-000000000100.safetensors"]


FOREIGN = ("thesis.tex", "policy.safetensors", "initial-policy.safetensors", "metrics.jsonl", "checkpoints/best")


@pytest.mark.parametrize("name", [*FOREIGN, "config.json"])
def test_create_never_touches_a_foreign_folder(tmp_path, name):
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text('{"model_type": "llama"}')
    with pytest.raises(UserError, match=r"not empty and no run folder|exists: resume|is foreign"):
        RunFolder.create(tmp_path, CONFIG)
    assert [entry for entry in tmp_path.rglob("*") if entry.is_file()] == [file]
    assert file.read_text() == '{"model_type": "llama"}'


def test_create_takes_an_empty_or_half_made_folder(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "metrics.jsonl").touch()
    (tmp_path / "run.lock").write_text("{}")
    (tmp_path / "initial-policy.safetensors").touch()
    (tmp_path / f"{TEMPORARY_PREFIX}config.json-12").write_text("{")
    assert RunFolder.create(tmp_path, CONFIG).config == CONFIG
    assert not list(tmp_path.glob(f"{TEMPORARY_PREFIX}*"))
    assert not (tmp_path / "initial-policy.safetensors").exists()


def test_create_on_a_file_or_without_permission_is_one_sentence(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="is a file; choose another --out"):
        RunFolder.create(tmp_path / "file", CONFIG)
    with pytest.raises(UserError, match=r"cannot make the run folder .*: Not a directory"):
        RunFolder.create(tmp_path / "file" / "run", CONFIG)


def test_a_run_whose_identity_is_no_text_is_one_sentence(tmp_path):
    (tmp_path / "config.json").write_text('{"format": "esp-run", "version": 1, "run_id": 3}')
    with pytest.raises(UserError, match=f"^{re.escape(str(tmp_path))}.* is damaged: its run_id is not a text"):
        RunFolder.open(tmp_path)


# Checkpoints


def test_the_newest_two_checkpoints_and_the_final_one_are_kept(folder):
    write_checkpoints(folder, 100, 200, 300)
    assert names(folder) == ["step-000000000200.safetensors", "step-000000000300.safetensors"]
    folder.write_checkpoint(400, weights(400), {}, final=True)
    assert names(folder)[-1] == "step-000000000400-final.safetensors"
    write_checkpoints(folder, 500, 600, 700)
    assert names(folder) == [
        "step-000000000400-final.safetensors",
        "step-000000000600.safetensors",
        "step-000000000700.safetensors",
    ]


def test_only_the_final_checkpoint_stays_beside_the_trained_policy(folder):
    write_checkpoints(folder, 100, 200)
    folder.write_policy(weights(200), {})
    assert len(names(folder)) == 2, "without a final one they are all that there is to go on from"
    folder.write_checkpoint(300, weights(300), {}, final=True)
    folder.write_policy(weights(300), {})
    assert names(folder) == ["step-000000000300-final.safetensors"]
    assert folder.latest_checkpoint(pytest.fail)[1]["step"] == 300


@pytest.mark.parametrize("place", ["replaced", "unlink"])
def test_checkpoints_that_a_kill_left_beside_the_trained_policy_go_at_the_next_start(folder, monkeypatch, place):
    write_checkpoints(folder, 100, 200)
    folder.write_checkpoint(300, weights(300), {}, final=True)
    Fault(place, 1, "EIO").plan(monkeypatch)
    with pytest.raises(OSError, match="Input/output error"):
        folder.write_policy(weights(300), {})
    assert len(names(folder)) == 3
    with folder.lock():
        pass
    assert names(folder) == ["step-000000000300-final.safetensors"]


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "renamed"])
def test_a_damaged_newest_checkpoint_is_passed_over_with_a_note(folder, damage):
    write_checkpoints(folder, 100, 200)
    newest = folder.checkpoint_path(200)
    if damage == "flip":
        flip_a_bit(newest)
    elif damage == "renamed":
        folder.checkpoint_path(200).rename(folder.checkpoint_path(300))
        newest = folder.checkpoint_path(300)
    else:
        newest.write_bytes(newest.read_bytes()[: 50 if damage == "cut" else 0])
    notes = []
    tensors, meta = folder.latest_checkpoint(notes.append)
    assert re.search(rf"{newest.name} .*; going back to step 100$", "".join(notes))
    assert meta["step"] == 100
    assert tensors["weight"].tolist() == [100.0] * 4


def test_checkpoints_that_another_process_has_just_removed_are_not_damaged(folder, monkeypatch):
    write_checkpoints(folder, 100, 200)
    listed = folder.checkpoints()
    monkeypatch.setattr(RunFolder, "checkpoints", lambda self: listed)
    listed[-1].unlink()
    assert folder.latest_checkpoint(pytest.fail)[1]["step"] == 100
    listed[0].unlink()
    assert folder.latest_checkpoint(pytest.fail) is None


def test_a_damaged_future_does_not_push_out_good_checkpoints(folder):
    write_checkpoints(folder, 100, 300)
    flip_a_bit(folder.checkpoint_path(300))
    write_checkpoints(folder, 200)
    assert names(folder) == ["step-000000000100.safetensors", "step-000000000200.safetensors"]


# Processes


def test_one_process_cannot_hold_a_folder_twice_but_again(folder):
    with folder.lock():
        with (
            pytest.raises(UserError, match=f"is in use by process {os.getpid()} on '.+'; wait for it"),
            folder.lock(),
        ):
            pytest.fail("held twice")
        (folder.path / "config.json").unlink()  # as if another process were still making the folder
        with pytest.raises(UserError, match="is in use by"):
            RunFolder.create(folder.path, CONFIG)
    with folder.lock():
        pass


@pytest.mark.parametrize("content", [b"", b"\xff", b"[1]", b'{"pid": "x"}', b'{"pid": 3}', b"[" * 5000])
def test_a_damaged_lock_file_still_locks(folder, content):
    with folder.lock():
        (folder.path / "run.lock").write_bytes(content)
        with pytest.raises(UserError, match="is in use by another process"), folder.lock():
            pytest.fail("held twice")


def test_locking_removes_what_a_killed_process_left_half_written(folder):
    rest = folder.path / "checkpoints" / f"{TEMPORARY_PREFIX}step-000000000100.safetensors-ab"
    rest.write_bytes(b"half")
    with folder.lock():
        assert not rest.exists()


def test_planted_links_in_a_run_folder_lead_nowhere(folder, tmp_path):
    mine = tmp_path / "mine.txt"
    mine.write_text("mine\n")
    for name in ("policy.safetensors", "checkpoints/step-000000000100.safetensors"):
        (folder.path / name).symlink_to(mine)
    write_checkpoints(folder, 100)
    folder.write_policy(weights(1), {"task": "navigation"})
    folder.lock_path.unlink()
    folder.lock_path.symlink_to(mine)
    with pytest.raises(UserError, match="no regular file is there; remove it"), folder.lock():
        pass
    assert mine.read_text() == "mine\n"


def test_a_full_disk_is_no_mistake_of_the_user(folder, full_disk):
    with full_disk(), pytest.raises(OSError, match="File too large") as caught:
        write_checkpoints(folder, 100)
    assert caught.value.filename == str(folder.checkpoint_path(100))
    assert folder.checkpoints() == []
    write_checkpoints(folder, 100)
    assert names(folder) == ["step-000000000100.safetensors"]


def test_a_link_at_the_checkpoints_is_refused_before_anything_is_removed(folder, tmp_path):
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / f"{TEMPORARY_PREFIX}mine").touch()
    (folder.path / "checkpoints").rmdir()
    (folder.path / "checkpoints").symlink_to(tmp_path / "outside")
    with pytest.raises(UserError, match="checkpoints is a link, which is not followed"), folder.lock():
        pass
    assert len(list((tmp_path / "outside").iterdir())) == 1
