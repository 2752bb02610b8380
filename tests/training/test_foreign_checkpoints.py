"""Checkpoints of other runs and of other configurations are neither resumed nor removed."""

import shutil
from pathlib import Path

import pytest

from esp_cli.training import trainer
from esp_cli.training.checkpoint import load_checkpoint, save_checkpoint
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_envs.errors import UserError
from tests.training.runs import tiny_folder


def finished_folder(path: Path, steps: int = 300) -> Path:
    folder = tiny_folder(path, steps=steps, seeds=(7, 8), prior__kind="none")
    trainer.Trainer(parse_config(folder.config, path), folder).run(lambda news: True)
    return path


def test_a_checkpoint_of_another_run_is_neither_resumed_nor_removed(tmp_path: Path) -> None:
    other = RunFolder.open(finished_folder(tmp_path / "b"))
    folder = tiny_folder(tmp_path / "x", seeds=(7, 8), prior__kind="none")  # even of the same configuration
    copied = folder.path / "checkpoints" / other.checkpoints()[-1].name
    shutil.copy(other.checkpoints()[-1], copied)
    with pytest.raises(UserError, match=r"-final\.safetensors is a checkpoint of another run; move it out"):
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
    with pytest.raises(UserError, match=r"was written under another configuration than that in .*config\.json"):
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
