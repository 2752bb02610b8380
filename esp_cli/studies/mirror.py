"""The driver's side of a run on another machine: its run folder follows the one of the worker.

At any moment the folder here is one that a run can go on from: metrics come before the checkpoint that stands for them,
a checkpoint comes as a whole, and older ones go only then.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from esp_cli.files.opening import open_own
from esp_cli.files.writing import remove_file, replace_file, replacing, sync_file
from esp_cli.studies.worker import CHUNK_BYTES, WHOLE_FILES, News
from esp_cli.training.checkpoint_names import FILE_NAME, checkpoints_in, place_of, step_of, superseded
from esp_cli.training.folder_names import FINAL, LOG, METRICS

Stamp = tuple[int, int]


class Mirror:
    """Keeps a run folder like that of a worker.

    Args:
        path: the run folder here.

    Attributes:
        log_offset: bytes of the worker's log that are here.
        metrics_id: of the worker's metrics file that is here.
        metrics_offset: bytes of it that are here.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.log_offset = 0
        self.metrics_id, self.metrics_offset = "", 0
        self._known: dict[str, Stamp] = {}

    @property
    def newest_step(self) -> int:
        """Step of the newest checkpoint that is here; -1 where there is none."""
        return max(map(step_of, checkpoints_in(self.path)), default=-1)

    def outgoing(self) -> Iterator[tuple[str, bytes]]:
        """Yield name and content of what a job needs to go on, in parts."""
        names = [name for name in (*WHOLE_FILES, METRICS) if (self.path / name).is_file()]
        for name in (*names, *(file.name for file in checkpoints_in(self.path))):
            with place_of(self.path, name).open("rb") as file:
                while part := file.read(CHUNK_BYTES):
                    yield name, part

    def take(self, news: News) -> None:
        """Write the news of log and metrics.

        Raises:
            OSError: the disk here is full, or the like.
        """
        _append(self.path / LOG, news["log"])
        self.log_offset += len(news["log"])
        if news["metrics_id"] != self.metrics_id or news["metrics_offset"] < self.metrics_offset:
            replace_file(self.path / METRICS, news["metrics"])
        else:
            _append(self.path / METRICS, news["metrics"])
        self.metrics_id = news["metrics_id"]
        self.metrics_offset = news["metrics_offset"] + len(news["metrics"])

    def say(self, text: str) -> None:
        """Write a line of the driver into the log."""
        _append(self.path / LOG, f"{text}\n".encode())

    def know(self, files: Mapping[str, Stamp]) -> None:
        """Take the files of a worker as those that are here."""
        self._known.update(files)

    def wanted(self, files: Mapping[str, Stamp]) -> list[str]:
        """Return the files to fetch, in order: the newest checkpoint, then what is written at the end."""
        newest = [name for name in files if FILE_NAME.fullmatch(name)][-1:]
        names = [*newest, *(name for name in WHOLE_FILES if name in files)]
        return [name for name in names if self._known.get(name) != files[name]]

    def fetch(self, name: str, stamp: Stamp, read: Callable[[int], bytes], remote: str) -> None:
        """Write a file of the worker, then remove the checkpoints that it supersedes.

        Args:
            name: of the file.
            stamp: its size and time.
            read: returns the part of it at an offset.
            remote: the run folder of the worker; a final evaluation names the one here in its place.

        Raises:
            OSError: the disk here is full, or the like.
        """
        if name == FINAL:
            replace_file(self.path / name, _renamed(b"".join(_parts(stamp[0], read)), remote, str(self.path)))
        else:
            place_of(self.path, name).parent.mkdir(exist_ok=True)
            if FILE_NAME.fullmatch(name):
                sync_file(self.path / METRICS)
            with replacing(place_of(self.path, name)) as write:
                for part in _parts(stamp[0], read):
                    write(part)
        self._known[name] = stamp
        if FILE_NAME.fullmatch(name):
            for file in superseded(checkpoints_in(self.path), step_of(Path(name))):
                remove_file(file)


class FileGoneError(Exception):
    """The worker removed a file before it was read; a newer one is there."""


def _parts(size: int, read: Callable[[int], bytes]) -> Iterator[bytes]:
    done = 0
    while done < size:
        part = read(done)
        if not part:
            raise FileGoneError
        done += len(part)
        yield part


def _renamed(document: bytes, remote: str, local: str) -> bytes:
    """Name the run folder here in a JSON document of the worker, so that it equals that of a job on this machine."""
    return document.replace(json.dumps(remote)[1:-1].encode(), json.dumps(local, ensure_ascii=False)[1:-1].encode())


def _append(path: Path, content: bytes) -> None:
    if content:
        with os.fdopen(open_own(path, os.O_WRONLY | os.O_APPEND), "ab") as file:
            file.write(content)
