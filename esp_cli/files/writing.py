"""Writing of whole files: a reader sees the old content or the new one, after a kill or a power cut too.

A path that the user names may be a link, which is followed, or a device, which is written through. A name that the
program chose inside a folder is its own: whatever link stands there is replaced and never followed. Errors are those of
`esp_cli.files.opening`, and name the file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
from pathlib import Path

TEMPORARY_PREFIX = ".esp-tmp-"  # of half-written files; what a killed process left under such a name may be removed


def write_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file that the user named; missing folders are made, and a file that cannot be written is as it was.

    A link is followed and its target replaced as a whole. A device, a pipe or a socket is written through.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:  # new, or a link whose target is missing
        mode = stat.S_IFREG
    if stat.S_ISREG(mode):
        replace_file(os.path.realpath(path), content)
        return
    with path.open("wb", buffering=0) as file:
        write_all(file.fileno(), content)


def refuse_unwritable(path: str | os.PathLike[str]) -> None:
    """Refuse a path that `write_file` could not write, as known before the work whose result is to stand there."""
    path = Path(path)
    special = path.exists() and not path.is_file()  # a pipe behind a link has no real path
    real = Path(os.path.realpath(path))
    place = path if special else next(folder for folder in real.parents if folder.exists())
    wrong = errno.EACCES if not os.access(place, os.W_OK) else 0 if special or place.is_dir() else errno.ENOTDIR
    if path.is_dir():
        wrong = errno.EISDIR
    if wrong:
        raise OSError(wrong, os.strerror(wrong), os.fspath(path))


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Replace a file as a whole by this content.

    The bytes go to a temporary file in the same folder, which is flushed to the disk and renamed over ``path``; then
    the folder's own entry is flushed. A link there is replaced, not followed. After an exception the file is as before.
    """
    path = Path(path)
    temporary = path.with_name(f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}")
    try:
        # not tempfile.mkstemp, which would make every file readable by its owner alone whatever the umask says
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            with contextlib.suppress(OSError):  # a new file, or one of somebody else
                if stat.S_ISREG((before := path.lstat()).st_mode):
                    os.fchmod(descriptor, before.st_mode & 0o777)
            write_all(descriptor, content)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        temporary.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):  # it names the file itself, not the temporary one beside it
            raise OSError(error.errno, error.strerror, os.fspath(path)) from None
        raise
    with contextlib.suppress(OSError):  # some network file systems cannot flush a folder, where the rename stands
        entries = os.open(path.parent, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(entries)
        finally:
            os.close(entries)


def write_all(descriptor: int, content: bytes) -> None:
    """Write every byte; a disk about to be full takes a part only, and the rest then says so."""
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(descriptor, rest) :]
