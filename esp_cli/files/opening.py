"""Opening of files where another user may have put a link, a pipe or a device."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def open_own(path: str | os.PathLike[str], flags: int) -> int:
    """Open a file that the program keeps in a folder of its own, such as a lock or a log; make it if missing.

    Args:
        path: its place.
        flags: of `os.open`, such as `os.O_RDWR`.

    Returns:
        A descriptor of a regular file; a link is not followed, a pipe does not block.

    Raises:
        OSError: a link or something else than a regular file is there, or it cannot be opened.
    """
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.ENXIO) or Path(path).is_symlink():
            raise _irregular(path) from None
        raise
    return _regular(descriptor, path)


def read_regular(path: str | os.PathLike[str], max_bytes: int) -> bytes | None:
    """Read a regular file, which a link may name; None where it is larger than `max_bytes`.

    Raises:
        OSError: it is missing, unreadable or no regular file.
    """
    descriptor = _regular(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), path)
    with os.fdopen(descriptor, "rb") as file:
        content = file.read(max_bytes + 1)
    return content if len(content) <= max_bytes else None


def _regular(descriptor: int, path: str | os.PathLike[str]) -> int:
    """Return the descriptor of a regular file; close that of anything else."""
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    raise _irregular(path)


def _irregular(path: str | os.PathLike[str]) -> OSError:
    return OSError(errno.EINVAL, "a link or no regular file is there; remove it", os.fspath(path))
