"""Opening of files in folders where something else may be by now: a link, a pipe, or the folder of another run.

A process that holds a folder (see `esp_cli.files.locking`) reaches what is in it through a descriptor of that folder.
So it never writes to, or removes from, another folder that was moved to the same path meanwhile.
"""

from __future__ import annotations

import errno
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from esp_envs.errors import UserError


class FolderLostError(UserError):
    """A held folder was moved, replaced or deleted; the text is one sentence for the user."""


@dataclass(frozen=True)
class HeldFolder:
    """A folder that a process holds by the lock on a file in it.

    Attributes:
        path: absolute path at which it was taken.
        lock: name of the locked file.
        folder_fd: descriptor of the folder.
        lock_fd: descriptor of the locked file.
        process: that holds it; a fork of that process does not.
    """

    path: str
    lock: str
    folder_fd: int
    lock_fd: int
    process: int

    def covers(self, path: str) -> bool:
        """Return whether this process holds it, and an absolute path is it or in it."""
        return self.process == os.getpid() and os.path.commonpath((self.path, path)) == self.path

    def require(self) -> None:
        """Check that the folder at the path is the held one, and that its lock file is the locked one.

        Raises:
            FolderLostError: another one is there, or none.
        """
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


held_folders: dict[int, HeldFolder] = {}
"""What this process holds, by the descriptor of the lock; `esp_cli.files.locking` keeps it."""


def absolute_path(path: str | os.PathLike[str]) -> str:
    """Return a path from the root on, without "..", as `HeldFolder` compares it; links in it stay."""
    return os.path.normpath(Path(path).absolute())


def require_held(path: str | os.PathLike[str]) -> HeldFolder | None:
    """Check the held folders that a path is in, before something is written there.

    Returns:
        The innermost of them; None where the path is in none.

    Raises:
        FolderLostError: one of them was moved, replaced or deleted.
    """
    if not held_folders:
        return None
    absolute = absolute_path(path)
    covering = [held for held in list(held_folders.values()) if held.covers(absolute)]
    covering.sort(key=lambda held: len(held.path))
    for held in covering:
        held.require()
    return covering[-1] if covering else None


def open_folder(path: str | os.PathLike[str]) -> int:
    """Return a descriptor of a folder in which a file is written or removed; inside a held folder it leads there.

    Raises:
        FolderLostError: a held folder was moved, replaced or deleted.
        OSError: the folder is missing or no folder.
    """
    held, flags = require_held(path), os.O_DIRECTORY | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)
    if held is None:
        return os.open(path, flags)
    return os.open(os.path.relpath(path, held.path), flags, dir_fd=held.folder_fd)


def own_folder(path: Path) -> Path:
    """Return the path of a folder that the program keeps, which need not exist yet; a link there is not followed.

    Raises:
        FolderLostError: it is in a held folder that was moved, replaced or deleted.
        OSError: a link is there.
    """
    require_held(path)
    if path.is_symlink():
        raise _irregular(path)
    return path


def open_own(path: str | os.PathLike[str], flags: int) -> int:
    """Open a file that the program keeps in a folder of its own, such as a lock or a log; make it if missing.

    Args:
        path: its place.
        flags: of `os.open`, such as `os.O_RDWR`.

    Returns:
        A descriptor of a regular file; a link is not followed, a pipe does not block.

    Raises:
        FolderLostError: it is in a held folder that was moved, replaced or deleted.
        OSError: a link or something else than a regular file is there, or it cannot be opened.
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
    """Read a regular file, which a link may name; None where it is larger than `max_bytes`.

    Raises:
        OSError: it is missing, unreadable or no regular file.
    """
    with open_regular(path) as file:
        content = file.read(max_bytes + 1)
    return content if len(content) <= max_bytes else None


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a regular file, which a link may name, for reading; a pipe does not block.

    Raises:
        OSError: it is missing, unreadable or no regular file.
    """
    return os.fdopen(_regular(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), path), "rb")


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
