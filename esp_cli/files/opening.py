"""Opening of files in folders where something else may be by now: a link, a pipe, or the folder of another run.

A process that holds a folder reaches what is in it through a descriptor of that folder. So it never writes to, or
removes from, another folder that was moved to the same path meanwhile: where a held folder was moved, replaced or
deleted, every function raises a FolderLostError. An OSError says what else is wrong.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from esp_cli.files.formatting import attempting
from esp_envs.errors import UserError


class FolderLostError(UserError):
    """A held folder was moved, replaced or deleted; the text is one sentence for the user."""


class LockError(UserError):
    """Another process holds the folder, or it cannot be locked; the text is one sentence for the user."""


@dataclass(frozen=True)
class HeldFolder:
    """A folder that a process holds by the lock on a file in it, or on itself."""

    path: str  # absolute, at which it was taken
    lock: str  # name of the locked file; empty where the folder itself is locked
    folder_fd: int  # descriptor of the folder
    lock_fd: int  # descriptor of the locked file
    process: int  # that holds it; a fork of that process does not

    def covers(self, path: str) -> bool:
        """Return whether this process holds it, and an absolute path is it or in it."""
        return self.process == os.getpid() and os.path.commonpath((self.path, path)) == self.path

    def require(self) -> None:
        """Raise a FolderLostError unless its path leads to the held folder, and to the locked file in it."""
        folder = Path(self.path)
        pairs = ((folder, self.folder_fd), (folder / self.lock, self.lock_fd))
        try:
            same = all(os.path.samestat(path.stat(), os.fstat(descriptor)) for path, descriptor in pairs)
        except (FileNotFoundError, NotADirectoryError):
            same = False
        if not same:
            raise FolderLostError(
                f"{self.path} was moved, replaced or deleted while this process worked in it; nothing was written to "
                "what is there now; go on with the folder at its new path"
            )


_held: dict[int, HeldFolder] = {}  # by the descriptor of the lock


@contextmanager
def holding(file: Path, kind: type[UserError] = LockError) -> Iterator[None]:
    """Hold the folder of a lock file, and write into the file who holds it.

    The kernel lets go when the process ends, however it ends. The file stays: removing it would let two processes hold
    two files of one name. While the folder is held, whatever `esp_cli.files` writes or removes in it is written or
    removed in this very folder.

    Raises:
        kind: another process, or this one, holds it already, or something else than a regular file is there.
        OSError: the file system cannot lock.
    """
    with ExitStack() as undo:
        with attempting("lock", file, kind):
            descriptor = open_own(file, os.O_RDWR)
            undo.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = _holder(os.pread(descriptor, 4096, 0))
                raise kind(f"{file.parent} is in use by {holder}; wait for it, or stop it first") from None
            undo.callback(fcntl.flock, descriptor, fcntl.LOCK_UN)  # also for processes that are forked meanwhile
            owner = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
            # In this order, so that a process that is refused meanwhile finds a name and not an empty file.
            os.pwrite(descriptor, owner.encode(), 0)
            os.ftruncate(descriptor, len(owner.encode()))
            folder = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            undo.callback(os.close, folder)
        _held[descriptor] = HeldFolder(_absolute(file.parent), file.name, folder, descriptor, os.getpid())
        undo.callback(_held.pop, descriptor)
        require_held(file)
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


@contextmanager
def taking_turns(folder: Path) -> Iterator[None]:
    """Hold a folder of the user's, with no lock file in it, after waiting for other processes that are in this context.

    Where the file system cannot lock it waits for none. Writing goes into this very folder, as in `holding`.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        _held[descriptor] = HeldFolder(_absolute(folder), "", descriptor, descriptor, os.getpid())
        require_held(folder)
        yield
    finally:
        _held.pop(descriptor, None)
        os.close(descriptor)


def _holder(content: bytes) -> str:
    try:
        owner = json.loads(content)
        return f"process {int(owner['pid'])} on {str(owner['host'])[:64]!r}"
    except (ValueError, TypeError, KeyError, RecursionError):
        return "another process"


def _absolute(path: str | os.PathLike[str]) -> str:
    """Return a path from the root on, without "..", as `HeldFolder` compares it; links in it stay."""
    return os.path.normpath(Path(path).absolute())


def require_held(path: str | os.PathLike[str]) -> HeldFolder | None:
    """Check the held folders that a path is in, before something is written there, and return the innermost."""
    if not _held:
        return None
    absolute = _absolute(path)
    covering = sorted((held for held in list(_held.values()) if held.covers(absolute)), key=lambda held: len(held.path))
    for held in covering:
        held.require()
    return covering[-1] if covering else None


def open_folder(path: str | os.PathLike[str]) -> int:
    """Return a descriptor of a folder in which a file is written or removed; inside a held folder it leads there."""
    held, flags = require_held(path), os.O_DIRECTORY | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)
    if held is None:
        return os.open(path, flags)
    return os.open(os.path.relpath(path, held.path), flags, dir_fd=held.folder_fd)


def own_folder(path: Path) -> Path:
    """Return the path of a folder that the program keeps, which need not exist yet; a link there is refused."""
    require_held(path)
    if path.is_symlink():
        raise _irregular(path)
    return path


def open_own(path: str | os.PathLike[str], flags: int) -> int:
    """Return a descriptor of a regular file that the program keeps in a folder of its own; it is made if missing.

    A link is refused, and a pipe does not block.
    """
    require_held(path)
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
