"""Opening of files where something else may be by now: a link, a pipe, or the lock of another process."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from esp_cli.files.formatting import attempting
from esp_envs.errors import UserError


@contextmanager
def holding(file: Path) -> Iterator[None]:
    """Hold the folder of a lock file, and write into the file who holds it.

    The kernel lets go when the process ends, however it ends. The file stays: removing it would let two processes hold
    two files of one name. A UserError says that another process, or this one, holds it already, or that something else
    than a regular file is there; where the file system cannot lock, it is an OSError.
    """
    with ExitStack() as undo:
        with attempting("lock", file):
            descriptor = open_own(file, os.O_RDWR)
            undo.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = _holder(os.pread(descriptor, 4096, 0))
                raise UserError(f"{file.parent} is in use by {holder}; wait for it, or stop it first") from None
            undo.callback(fcntl.flock, descriptor, fcntl.LOCK_UN)  # also for processes that are forked meanwhile
            owner = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
            # In this order, so that a process that is refused meanwhile finds a name and not an empty file.
            os.pwrite(descriptor, owner.encode(), 0)
            os.ftruncate(descriptor, len(owner.encode()))
        yield


def is_held(file: Path) -> bool:
    """Return whether a process holds a lock; only for a caller that alone starts the processes that take it."""
    try:
        descriptor = os.open(file, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:  # without locks nothing holds one, and `holding` says so
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


def _holder(content: bytes) -> str:
    try:
        owner = json.loads(content)
        return f"process {int(owner['pid'])} on {str(owner['host'])[:64]!r}"
    except (ValueError, TypeError, KeyError, RecursionError):
        return "another process"


def own_folder(path: Path) -> Path:
    """Return the path of a folder of our own, which need not exist yet; a link there is refused."""
    if path.is_symlink():
        raise _irregular(path)
    return path


def open_own(path: str | os.PathLike[str], flags: int) -> int:
    """Return a descriptor of a regular file of our own, made if missing; a link is refused, a pipe does not block."""
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO) or Path(path).is_symlink():
            raise _irregular(path) from None
        raise
    return _regular(descriptor, path)


def read_regular(path: str | os.PathLike[str], max_bytes: int) -> bytes | None:
    """Read a regular file as of `open_regular`; None where it is larger than `max_bytes`."""
    with open_regular(path) as file:
        content = file.read(max_bytes + 1)
    return content if len(content) <= max_bytes else None


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file, which a link may name, for reading; a pipe is refused and does not block."""
    return os.fdopen(_regular(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), path), "rb")


def _regular(descriptor: int, path: str | os.PathLike[str]) -> int:
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    raise _irregular(path)


def _irregular(path: str | os.PathLike[str]) -> OSError:
    return OSError(errno.EINVAL, "a link or no regular file is there; remove it", os.fspath(path))
