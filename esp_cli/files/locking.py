"""Locks that one process holds: the kernel lets go of them when the process ends, however it ends."""

from __future__ import annotations

import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from esp_cli.files.failures import attempting
from esp_cli.files.opening import HeldFolder, absolute_path, held_folders, open_own, require_held
from esp_envs.errors import UserError


class LockError(UserError):
    """Another process holds the lock, or it cannot be taken; the text is one sentence for the user."""


def acquire(file: Path) -> int:
    """Hold the folder of a lock file, and write into the file who holds it.

    The file stays when the folder is let go: removing it would let two processes hold two files of one name. While the
    folder is held, whatever `esp_cli.files` writes or removes in it is written or removed in this very folder.

    Returns:
        The descriptor of the file; `release` of it lets go of the folder.

    Raises:
        LockError: another process, or this one, holds it already, or something else than a regular file is there.
        FolderLostError: the folder was moved, replaced or deleted meanwhile.
        OSError: the file system cannot lock.
    """
    with attempting("lock", file, LockError):
        descriptor = open_own(file, os.O_RDWR)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            owner = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n"
            # In this order, so that a process that is refused meanwhile finds a name and not an empty file.
            os.pwrite(descriptor, owner.encode(), 0)
            os.ftruncate(descriptor, len(owner.encode()))
            folder = os.open(file.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except BlockingIOError:
            holder = _holder(os.pread(descriptor, 4096, 0))
            os.close(descriptor)
            raise LockError(f"{file.parent} is in use by {holder}; wait for it, or stop it first") from None
        except OSError:
            os.close(descriptor)
            raise
    held_folders[descriptor] = HeldFolder(absolute_path(file.parent), file.name, folder, descriptor, os.getpid())
    try:
        require_held(file)
    except BaseException:
        release(descriptor)
        raise
    return descriptor


@contextmanager
def taking_turns(folder: Path) -> Iterator[None]:
    """Wait until no other process is in this context with a folder, and let none enter; without locks wait for none.

    Raises:
        LockError: the folder was moved, replaced or deleted while this process waited.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if not (folder.exists() and os.path.samestat(folder.stat(), os.fstat(descriptor))):
            raise LockError(f"{folder} was moved, replaced or deleted meanwhile; run the command again")
        yield
    finally:
        os.close(descriptor)


def release(descriptor: int) -> None:
    """Let go of a folder that `acquire` holds, also for processes that were forked meanwhile."""
    os.close(held_folders.pop(descriptor).folder_fd)
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    os.close(descriptor)


def is_held(file: Path) -> bool:
    """Return whether a process holds a lock; only for a caller that alone starts the processes that take it."""
    try:
        descriptor = os.open(file, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # without locks nothing holds one, and `acquire` says so
        return False
    finally:
        os.close(descriptor)
    return False


def _holder(content: bytes) -> str:
    """Name the process that a lock file names."""
    try:
        owner = json.loads(content)
        return f"process {int(owner['pid'])} on {str(owner['host'])[:64]!r}"
    except (ValueError, TypeError, KeyError, RecursionError):
        return "another process"
