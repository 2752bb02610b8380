"""Writing: whole or not at all; a user's link is followed, a device written through, a planted link replaced."""

import os
import signal
import socket
import stat
import threading
from pathlib import Path

import pytest

from esp_cli.files.writing import TEMPORARY_PREFIX, replace_file, write_file
from tests.faults import Fault

WRITERS = pytest.mark.parametrize("write", [write_file, replace_file])


@WRITERS
def test_a_file_holds_the_content_and_nothing_is_left_beside_it(tmp_path, write):
    write(tmp_path / "a", b"old")
    write(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


@WRITERS
@pytest.mark.parametrize("content", [b"", b"x", bytes(3_000_000)])
def test_any_length_is_written_whole(tmp_path, write, content):
    write(tmp_path / "a", content)
    assert (tmp_path / "a").read_bytes() == content


@WRITERS
def test_written_files_follow_the_umask(tmp_path, write):
    old = os.umask(0o027)
    try:
        write(tmp_path / "a", b"x")
    finally:
        os.umask(old)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


@WRITERS
def test_a_file_that_is_written_again_keeps_its_permissions(tmp_path, write):
    path = tmp_path / "a"
    path.write_bytes(b"old")
    path.chmod(0o600)
    write(path, b"new")
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o600)


@WRITERS
def test_the_longest_names_are_taken(tmp_path, write):
    path = tmp_path / ("ü" * 127)
    write(path, b"x")
    assert path.read_bytes() == b"x"


@WRITERS
@pytest.mark.parametrize("place", ["write", "fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch, write, place):
    (tmp_path / "a").write_bytes(b"old")
    Fault(place, 1, "ENOSPC").plan(monkeypatch)
    with pytest.raises(OSError, match="No space left on device"):
        write(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]
    write(tmp_path / "a", b"new")  # the fault strikes once
    assert (tmp_path / "a").read_bytes() == b"new"


def test_a_link_is_followed_and_kept(tmp_path):
    target = tmp_path / "elsewhere" / "target"
    target.parent.mkdir()
    target.write_bytes(b"old")
    (tmp_path / "link").symlink_to("elsewhere/target")
    write_file(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert target.read_bytes() == b"new"
    assert not target.is_symlink()


def test_a_link_to_a_missing_file_makes_that_file(tmp_path):
    (tmp_path / "link").symlink_to("target")
    write_file(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_bytes() == b"new"


def test_a_link_at_a_name_of_the_program_is_replaced_and_never_followed(tmp_path):
    (tmp_path / "mine").write_bytes(b"mine")
    (tmp_path / "policy").symlink_to("mine")
    replace_file(tmp_path / "policy", b"new")
    assert (tmp_path / "mine").read_bytes() == b"mine"
    assert not (tmp_path / "policy").is_symlink()
    assert (tmp_path / "policy").read_bytes() == b"new"


def test_a_file_in_the_place_of_a_link_takes_no_permissions_from_its_target(tmp_path):
    (tmp_path / "mine").write_bytes(b"mine")
    (tmp_path / "mine").chmod(0o777)
    (tmp_path / "policy").symlink_to("mine")
    replace_file(tmp_path / "policy", b"new")
    assert (tmp_path / "policy").stat().st_mode & 0o111 == 0


def test_the_null_device_takes_everything_and_stays():
    write_file("/dev/null", bytes(100_000))
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_full_device_is_told():
    with pytest.raises(OSError, match="No space left on device"):
        write_file("/dev/full", b"x")


def test_a_pipe_is_written_through_and_stays(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write_file(pipe, b"x" * 200_000)
    reader.join(10)
    assert read == [b"x" * 200_000]
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_socket_is_refused_and_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
        with pytest.raises(OSError, match="No such device or address"):
            write_file("socket", b"x")
    assert stat.S_ISSOCK(Path("socket").stat().st_mode)


@WRITERS
def test_a_folder_is_refused_and_stays(tmp_path, write):
    (tmp_path / "a").mkdir()
    with pytest.raises(IsADirectoryError):
        write(tmp_path / "a", b"x")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a"]


def test_a_loop_of_links_and_a_name_too_long_are_told(tmp_path):
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(OSError, match="Too many levels of symbolic links"):
        write_file(tmp_path / "a", b"x")
    with pytest.raises(OSError, match="File name too long"):
        write_file(tmp_path / ("a" * 300), b"x")
    assert {entry.name for entry in tmp_path.iterdir()} == {"a", "b"}


def test_missing_folders_are_made_for_a_file_that_the_user_names(tmp_path):
    write_file(tmp_path / "new" / "deep" / "a", b"x")
    assert (tmp_path / "new" / "deep" / "a").read_bytes() == b"x"


def test_a_process_killed_at_a_place_leaves_the_old_or_the_new_file(tmp_path):
    for place, seen in (("write", b"old"), ("fsync", b"old"), ("replace", b"old"), ("replaced", b"new")):
        replace_file(tmp_path / "a", b"old")
        child = os.fork()
        if child == 0:
            Fault(place, 1, "KILL").plan()
            replace_file(tmp_path / "a", b"new")
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -9
        assert (tmp_path / "a").read_bytes() == seen
    left = {entry.name for entry in tmp_path.iterdir()} - {"a"}
    assert len(left) == 3  # negative control: the kills came while a file was half-written
    assert all(name.startswith(TEMPORARY_PREFIX) for name in left)


def test_a_signal_that_is_only_noted_in_the_middle_of_a_write_leaves_every_byte_once(tmp_path, monkeypatch):
    noted = []
    before = signal.signal(signal.SIGTERM, lambda number, _: noted.append(number))
    try:
        Fault("write", 1, "TERM").plan(monkeypatch)
        replace_file(tmp_path / "a", b"whole\n")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert noted == [signal.SIGTERM]
    assert (tmp_path / "a").read_bytes() == b"whole\n"
