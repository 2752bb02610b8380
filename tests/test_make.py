"""The Makefile's recipes run in a path with spaces and umlauts, and as a user without rights."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOBODY = 65534
FAKE = '#!/bin/sh\necho "$(basename "$0") $*" >> "$(dirname "$0")/../../said.txt"\n'


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of the Makefile whose environment notes what is called, in a folder that anybody may write to."""
    path = tmp_path / "ein Ordner mit Ümlauten"
    shutil.copytree(ROOT / ".ci", path / ".ci")
    for name in ("esp_cli", "environments", "tests"):
        (path / name).mkdir()
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copyfile(ROOT / name, path / name)
    for name in ("python", "esp", "ruff", "mypy"):
        tool = path / ".venv" / "bin" / name
        tool.parent.mkdir(parents=True, exist_ok=True)
        tool.write_text(FAKE)
        tool.chmod(0o755)
    for stamp in (".installed", ".installed-test", ".installed-dev"):
        (path / ".venv" / stamp).touch()
    return path


def make(checkout: Path, *targets: str, user: int | None = None) -> str:
    result = subprocess.run(
        ["make", *targets], cwd=checkout, capture_output=True, text=True, check=False, timeout=60, user=user
    )
    assert result.returncode == 0, result.stderr
    said = checkout / "said.txt"
    return said.read_text() if said.exists() else ""


def test_every_target_works_in_a_path_with_spaces_and_umlauts(checkout: Path) -> None:
    (checkout / "runs" / "demo").mkdir(parents=True)
    said = make(checkout, "demo", "test", "check", "docs", "site", "torture", "clean", "help")
    assert "esp demo --out runs/demo" in said
    assert "python -m pytest" in said
    assert "ruff check ." in said
    assert "python -m mkdocs build" in said
    assert "python -m tests.torture --minutes 10 --seed" in said
    assert not (checkout / "runs" / "demo").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_user_without_rights_can_do_the_same(checkout: Path) -> None:
    for folder in (checkout, *checkout.parents):
        if folder.is_relative_to("/tmp") and folder != Path("/tmp"):
            folder.chmod(0o777)
    for entry in (checkout, *checkout.rglob("*")):
        os.chown(entry, NOBODY, NOBODY)
    assert "esp demo" in make(checkout, "demo", user=NOBODY)
