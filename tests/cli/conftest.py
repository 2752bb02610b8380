"""One tiny run that the tests of the commands share, and copies of it to break."""

import shutil
from pathlib import Path

import pytest

from tests.cli.running import train_tiny


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the seeds 3 and 7 that no test may change."""
    return train_tiny(tmp_path_factory.mktemp("runs") / "finished", "--seed-list", "3,7")


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be changed."""
    return Path(shutil.copytree(finished, tmp_path / "copied"))
