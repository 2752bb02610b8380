"""Opening and holding: the program's own files are regular ones, never what somebody planted in their place."""

import os
import signal
from pathlib import Path

import pytest

from esp_cli.files.opening import holding, is_held, open_own, read_regular
from esp_envs.errors import UserError

FLAGS = pytest.mark.parametrize("flags", [os.O_RDWR, os.O_WRONLY | os.O_APPEND])


def plant(kind, path):
    """Put something else than a regular file at a path."""
    mine = path.with_name("mine")
    mine.write_text("mine")
    if kind == "link":
        path.symlink_to(mine)
    elif kind == "dangling link":
        path.symlink_to("missing")
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()


@FLAGS
def test_a_missing_file_is_made_and_an_old_one_opened(tmp_path, flags):
    path = tmp_path / "run.lock"
    for _ in range(2):
        descriptor = open_own(path, flags)
        os.write(descriptor, b"x")
        os.close(descriptor)
    assert set(path.read_bytes()) == {ord("x")}


@FLAGS
@pytest.mark.parametrize("kind", ["link", "dangling link", "pipe", "folder"])
def test_anything_else_than_a_regular_file_is_refused_without_waiting(tmp_path, flags, kind):
    plant(kind, tmp_path / "run.lock")
    with pytest.raises(OSError, match=r"no regular file is there|Is a directory"):
        open_own(tmp_path / "run.lock", flags)
    assert (tmp_path / "mine").read_text() == "mine"
    assert not (tmp_path / "missing").exists()


def test_reading_follows_a_link_and_refuses_what_could_block(tmp_path):
    plant("link", tmp_path / "a.json")
    assert read_regular(tmp_path / "a.json", 100) == b"mine"
    plant("pipe", tmp_path / "b.json")
    with pytest.raises(OSError, match="no regular file"):
        read_regular(tmp_path / "b.json", 100)
    with pytest.raises(OSError, match="no regular file"):
        read_regular("/dev/zero", 100)
    with pytest.raises(IsADirectoryError):
        read_regular(tmp_path, 100)


def test_reading_stops_at_a_bound(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_regular(tmp_path / "a", 5) == b"12345"
    assert read_regular(tmp_path / "a", 4) is None


def test_a_lock_is_let_go_of_though_a_forked_process_lives_on(tmp_path: Path) -> None:
    file, child = tmp_path / "lock", 0
    try:
        with holding(file):
            child = os.fork()
            if not child:
                signal.pause()
            assert is_held(file)
            with pytest.raises(UserError, match=f"in use by process {os.getpid()}"), holding(file):
                pytest.fail("held twice")
        assert not is_held(file)
        with holding(file):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
