"""A process that trains into a folder which is moved, replaced or deleted ends, and touches nothing of another run."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from esp_cli import app
from esp_cli.files.opening import FolderLostError, HeldFolder, holding
from esp_cli.files.writing import remove_file, replace_file
from esp_cli.training import trainer
from esp_cli.training.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from tests.forks import fork, said, wait
from tests.training.runs import tiny_folder

ENDLESS = 10**9


def content_of(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def finished_folder(path: Path, steps: int = 300) -> Path:
    """A finished run of another prior, with a checkpoint before its last one."""
    folder = tiny_folder(path, steps=steps, seeds=(7, 8), prior__kind="none")
    trainer.Trainer(parse_config(folder.config, path), folder).run(lambda news: True)
    return path


def move_away(path: Path, other: Path) -> None:
    path.rename(path.with_name("old"))


def replace_by_another(path: Path, other: Path) -> None:
    path.rename(path.with_name("old"))
    other.rename(path)


def delete(path: Path, other: Path) -> None:
    shutil.rmtree(path)


def delete_and_begin_anew(path: Path, other: Path) -> None:
    path.rename(path.with_name("going"))  # at once, as a file manager does
    shutil.rmtree(path.with_name("going"))
    finished_folder(path)


def exchange_the_lock(path: Path, other: Path) -> None:
    (path / "run.lock").unlink()


@pytest.mark.parametrize("change", [move_away, replace_by_another, delete, delete_and_begin_anew, exchange_the_lock])
def test_a_run_whose_folder_is_lost_in_mid_run_ends_with_a_sentence(
    tmp_path: Path, change: Callable[[Path, Path], None]
) -> None:
    path, other = tmp_path / "x", finished_folder(tmp_path / "b")
    folder = tiny_folder(path, steps=ENDLESS)

    def job() -> None:
        trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
        app.app(["train", "--resume", str(path)])

    pid = fork(job, path)
    while len(folder.checkpoints()) < 2:
        time.sleep(0.005)
    for attempt in range(100):  # the process writes into the folder while it is deleted
        try:
            change(path, other)
            break
        except OSError:
            if attempt == 99:
                raise
    before = content_of(path) if path.exists() else None
    assert wait(pid) == 2, said(path)
    assert said(path).splitlines()[-1].startswith(f"error: {path} was moved, replaced or deleted while this process")
    assert "Traceback" not in said(path)
    if change is exchange_the_lock:
        return
    assert (content_of(path) if path.exists() else None) == before, "nothing is written or removed there"
    if change in (move_away, replace_by_another):  # its own run goes on, at its new path
        held = RunFolder.open(path.with_name("old"))
        assert held.latest_checkpoint(pytest.fail) is not None


def test_what_is_written_in_a_held_folder_goes_into_it_though_another_takes_its_path_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder is exchanged after the check, before the file is renamed or removed: nobody else's file is touched."""
    mine, other = tmp_path / "x", tmp_path / "b"
    for folder in (mine, other):
        (folder / "checkpoints").mkdir(parents=True)
        (folder / "checkpoints" / "a").write_bytes(folder.name.encode())
    with holding(mine / "run.lock"):
        monkeypatch.setattr(HeldFolder, "require", lambda self: None)  # as if it came before the exchange
        replace_by_another(mine, other)
        replace_file(mine / "checkpoints" / "a", b"new")
        assert (mine / "checkpoints" / "a").read_bytes() == b"b"
        assert (tmp_path / "old" / "checkpoints" / "a").read_bytes() == b"new"
        remove_file(mine / "checkpoints" / "a")
        assert content_of(mine) == {"checkpoints/a": b"b"}
        monkeypatch.undo()
        for write in (lambda file: replace_file(file, b"x"), remove_file):
            with pytest.raises(FolderLostError, match="was moved, replaced or deleted"):
                write(mine / "checkpoints" / "a")
    replace_file(mine / "checkpoints" / "a", b"x")  # not held any more


def test_a_checkpoint_of_another_run_is_neither_resumed_nor_removed(tmp_path: Path) -> None:
    other = RunFolder.open(finished_folder(tmp_path / "b"))
    folder = tiny_folder(tmp_path / "x", seeds=(7, 8), prior__kind="none")  # even of the same configuration
    copied = folder.path / "checkpoints" / other.checkpoints()[-1].name
    shutil.copy(other.checkpoints()[-1], copied)
    with pytest.raises(CheckpointError, match=r"-final\.safetensors is a checkpoint of another run; move it out"):
        folder.latest_checkpoint(pytest.fail)
    tensors, _ = other.latest_checkpoint(pytest.fail)
    for step in (50, 100, 150, 200, 250):
        folder.write_checkpoint(step, tensors, {"iteration": step // 50})
    assert copied in folder.checkpoints()
    copied.unlink()
    assert folder.latest_checkpoint(pytest.fail)[1] == {"iteration": 5, "step": 250}


def test_a_checkpoint_of_another_configuration_is_not_resumed(tmp_path: Path) -> None:
    folder = RunFolder.open(finished_folder(tmp_path / "x"))
    changed = RunFolder(folder.path, {**folder.config, "steps": 600}, folder.identity)
    with pytest.raises(CheckpointError, match=r"was written under another configuration than that in .*config\.json"):
        changed.latest_checkpoint(pytest.fail)


def test_a_folder_and_checkpoints_without_identity_are_resumed(tmp_path: Path) -> None:
    """As esp 0.1 wrote them; what this version adds to them carries no identity either, and is resumed too."""
    folder = RunFolder.open(finished_folder(tmp_path / "x"))
    config = folder.path / "config.json"
    config.write_text(config.read_text().replace(f'"run_id": "{folder.identity}",', ""))
    for file in folder.checkpoints():
        tensors, meta = load_checkpoint(file)
        save_checkpoint(file, tensors, {k: v for k, v in meta.items() if k not in ("run_id", "config_sha256")})
    old = RunFolder.open(folder.path)
    assert old.identity is None
    tensors, meta = old.latest_checkpoint(pytest.fail)
    old.write_checkpoint(meta.pop("step") + 50, tensors, meta)
    assert old.latest_checkpoint(pytest.fail)[1]["step"] == 350
