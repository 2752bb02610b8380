"""Failures in one sentence: of the file system, which the user can correct or not, and of values."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator

from esp_envs.errors import UserError

_CORRECTABLE = {
    *(errno.ENOENT, errno.EEXIST, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOTDIR, errno.ENOTEMPTY),
    *(errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.ENXIO, errno.EXDEV),
}
_ADVICE = {
    errno.ENOSPC: "free some space and run the command again",
    errno.EDQUOT: "free some space and run the command again",
    errno.EFBIG: "raise the limit on the size of a file (ulimit -f) and run the command again",
    errno.EROFS: "make the file system writable, or choose another path",
}


def is_correctable(error: OSError) -> bool:
    """Return whether the user can correct the command line: a wrong path, a missing permission."""
    return error.errno in _CORRECTABLE


def sentence(error: OSError) -> str:
    """Return one sentence: what is wrong, with which path, what to do."""
    reason = (error.strerror or str(error) or type(error).__name__).lower()
    place = f": {os.fsdecode(error.filename)}" if isinstance(error.filename, str | bytes) and error.filename else ""
    default = "check the path and its permissions" if is_correctable(error) else "check the disk and the machine"
    return f"{reason}{place}; {_ADVICE.get(error.errno or 0, default)}"


def own_words(message: str) -> str:
    """Return a message of ours without what pydantic writes before it."""
    return message.replace("Value error, ", "")


@contextlib.contextmanager
def attempting(verb: str, path: str | os.PathLike[str], kind: type[UserError]) -> Iterator[None]:
    """Turn a failure to do something ("write", "make the run folder") with a path into one sentence.

    Raises:
        kind: the user can correct it.
        OSError: the machine failed (a full or read-only disk); it names the path.
    """
    try:
        yield
    except OSError as error:
        if is_correctable(error):
            raise kind(f"cannot {verb} {os.fspath(path)}: {error.strerror or error}") from None
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None
