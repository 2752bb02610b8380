"""Real disks that are full or read-only: small file systems in memory, mounted where only one process sees them."""

import ctypes
import functools
import os
import shutil
import tempfile
from pathlib import Path

from tests.forks import Job, fork, wait

WHY_NOT = "file systems cannot be mounted here: that takes root and Linux"
_NEW_NAMESPACE = 0x20000
_READ_ONLY, _REMOUNT, _BIND, _PRIVATE = 1, 32, 4096, 16384 | 1 << 18
_DETACH = 2


@functools.cache
def can_mount() -> bool:
    """Return whether this process may mount file systems."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "disk"
        path.mkdir()
        return wait(fork(lambda: _mount_here(path), path)) == 0


def start_on_full_disk(job: Job, path: Path, spare_bytes: int) -> int:
    """Start a job in a fork where `path` is a disk that has room for so many more bytes; return its number.

    What the disk holds at the end is then in `path`.
    """

    def on_disk() -> None:
        before, after = path.with_name("before-disk"), path.with_name("after-disk")
        shutil.copytree(path, before, symlinks=True)
        _mount_here(path)
        shutil.copytree(before, path, symlinks=True, dirs_exist_ok=True)
        state = os.statvfs(path)
        size = (state.f_blocks - state.f_bfree) * state.f_frsize + spare_bytes
        _mount("tmpfs", path, _REMOUNT, f"size={max(size, 1)}")  # rounded up to a page
        try:
            job(path)
        finally:
            shutil.copytree(path, after, symlinks=True)
            ctypes.CDLL(None).umount2(os.fsencode(path), _DETACH)
            shutil.rmtree(before)
            shutil.rmtree(path)
            after.rename(path)

    path.mkdir(exist_ok=True)
    return fork(on_disk, path)


def start_on_read_only_disk(job: Job, path: Path) -> int:
    """Start a job in a fork where `path` is mounted read-only; return its number."""

    def on_disk() -> None:
        _own_namespace()
        _mount(path, path, _BIND)
        _mount(path, path, _BIND | _REMOUNT | _READ_ONLY)
        job(path)

    path.mkdir(exist_ok=True)
    return fork(on_disk, path)


def _mount_here(path: Path) -> None:
    """Mount an empty file system in memory, for this process and its children alone."""
    _own_namespace()
    _mount("tmpfs", path, 0, "size=1g")


def _own_namespace() -> None:
    _check(ctypes.CDLL(None, use_errno=True).unshare(_NEW_NAMESPACE))
    _mount("none", Path("/"), _PRIVATE)


def _mount(source: str | Path, target: Path, flags: int, options: str | None = None) -> None:
    kind = b"tmpfs" if source == "tmpfs" else None
    data = None if options is None else options.encode()
    mount = ctypes.CDLL(None, use_errno=True).mount
    _check(mount(os.fsencode(source), os.fsencode(target), kind, ctypes.c_ulong(flags), data))


def _check(code: int) -> None:
    if code:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
