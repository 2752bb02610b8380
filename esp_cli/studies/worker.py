"""What a node of a cluster does: it runs one job in a folder of its own, and tells the driver of new files.

A worker is leased by one driver, whose calls renew the lease. When no call comes for a while the worker ends itself.
Before that, another driver may take the lease over and go on with the job. The worker never calls the driver; all that
it is given and all that it returns are numbers, texts and bytes.
"""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

from esp_cli.files.locking import acquire, is_held
from esp_cli.studies.engine_local import APPLICATION, LocalEngine, LocalJob
from esp_cli.studies.versions import versions
from esp_cli.training.checkpoint_names import FILE_NAME, checkpoints_in, place_of
from esp_cli.training.folder_names import CHECKPOINTS, CONFIG, FINAL, LOCK, LOG, METRICS, POLICY
from esp_envs.errors import UserError

CHUNK_BYTES = 8 * 2**20
"""Of one part of a large file."""
LEASE_S = 60.0
"""Seconds without a call after which a worker ends itself."""
SILENCE_S = 10.0
"""Seconds without a call after which another driver may take the lease over."""
WHOLE_FILES = (CONFIG, POLICY, FINAL)
"""Files of a run folder that are written once, beside its checkpoints."""
_PREFIX, _LOCK = "esp-cell-", "worker.lock"


class LeaseLostError(UserError):
    """Another driver has taken a worker over."""


class Lease(TypedDict):
    """The answer to a driver that asks for a worker."""

    holder: str  # the driver that holds it, where that is another one
    begun: bool  # whether the job has been started
    node: str
    folder: str  # the run folder on the node
    versions: Mapping[str, str]
    log_offset: int  # bytes of the log that a driver has


class News(TypedDict):
    """What happened since a driver looked last."""

    code: int | None  # of the ended job
    words: str  # why it failed
    log: bytes
    metrics_id: str  # changes when the file is replaced
    metrics_offset: int
    metrics: bytes
    files: Mapping[str, tuple[int, int]]  # size and time of each file that is written as a whole


class CellWorker:
    """Runs one job; an actor of the cluster.

    Args:
        lease_s: seconds without a call after which it ends itself.
        silence_s: seconds without a call after which another driver may take it over.
        root: folder for its files, by default that of temporary files.
        program: see `LocalEngine`.
    """

    def __init__(
        self,
        lease_s: float = LEASE_S,
        silence_s: float = SILENCE_S,
        root: str | None = None,
        program: Sequence[str] = APPLICATION,
    ) -> None:
        self._engine = LocalEngine(program)
        _remove_abandoned(Path(root or tempfile.gettempdir()))
        self._base = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=root))
        self._lock = acquire(self._base / _LOCK)
        self._run = self._base / "run"
        (self._run / CHECKPOINTS).mkdir(parents=True)
        self._owner, self._heard, self._silence_s = "", time.monotonic(), silence_s
        self._job: LocalJob | None = None
        self._log_offset = 0
        self._reading: tuple[str, int] | None = None
        threading.Thread(target=self._watch, args=(lease_s,), daemon=True).start()

    def attach(self, owner: str) -> Lease:
        """Lease the worker to a driver, if no other driver holds it.

        Args:
            owner: name of the driver.
        """
        held = self._owner not in ("", owner) and time.monotonic() - self._heard < self._silence_s
        if not held:
            self._owner, self._heard = owner, time.monotonic()
            if self._job is None:  # what a lost driver had sent so far
                shutil.rmtree(self._run)
                (self._run / CHECKPOINTS).mkdir(parents=True)
        return {
            "holder": self._owner if held else "",
            "begun": self._job is not None,
            "node": platform.node(),
            "folder": str(self._run),
            "versions": dict(versions()),
            "log_offset": self._log_offset,
        }

    def put(self, owner: str, name: str, content: bytes) -> None:
        """Append a part to a file of the run folder."""
        self._beat(owner)
        with self._path(name).open("ab") as file:
            file.write(content)

    def begin(
        self, owner: str, arguments: Sequence[str], environment: Mapping[str, str]
    ) -> Mapping[str, tuple[int, int]]:
        """Start the job; return size and time of the files that it begins with."""
        self._beat(owner)
        os.environ.update(environment)
        files = self._files()
        self._job = self._engine.start(arguments, self._run / LOG)
        return files

    def look(self, owner: str, log_offset: int, metrics_id: str, metrics_offset: int) -> News:
        """Return what is new.

        Args:
            owner: name of the driver.
            log_offset: bytes of the log that the driver has.
            metrics_id: of the metrics file that the driver has.
            metrics_offset: bytes of it that the driver has.
        """
        self._beat(owner)
        assert self._job is not None
        self._log_offset = log_offset
        code = self._job.poll()  # first: of an ended job, all that follows is final
        files = self._files()  # before the metrics, which are written before the checkpoint that stands for them
        metrics_id, metrics_offset, metrics = _grown(self._run / METRICS, metrics_id, metrics_offset)
        return {
            "code": code,
            "words": self._job.last_words() if code else "",
            "log": _grown(self._run / LOG, "", log_offset)[2],
            "metrics_id": metrics_id,
            "metrics_offset": metrics_offset,
            "metrics": metrics,
            "files": files,
        }

    def read(self, owner: str, name: str, offset: int) -> bytes:
        """Return the next part of a file; empty at its end, or where the file has gone before its first part.

        The file stays readable from the first part to the next file's, even if the job removes it.
        """
        self._beat(owner)
        if self._reading is None or self._reading[0] != name or offset == 0:
            if self._reading is not None:
                os.close(self._reading[1])
                self._reading = None
            try:
                self._reading = name, os.open(self._path(name), os.O_RDONLY)
            except FileNotFoundError:
                return b""
        return os.pread(self._reading[1], CHUNK_BYTES, offset)

    def stop(self, owner: str) -> None:
        """Ask the job to end after its iteration, with a checkpoint."""
        self._beat(owner)
        if self._job is not None:
            self._job.ask_to_stop()

    def end(self, owner: str) -> None:
        """End the job at once and remove its files."""
        self._beat(owner)
        self._clear()

    def _beat(self, owner: str) -> None:
        if owner != self._owner:
            raise LeaseLostError(f"{self._owner} has taken over the worker on {platform.node()}")
        self._heard = time.monotonic()

    def _watch(self, lease_s: float) -> None:
        """End this process when the lease runs out."""
        while time.monotonic() - self._heard < lease_s:
            time.sleep(min(1.0, lease_s / 4))
        self._clear()
        os._exit(0)

    def _clear(self) -> None:
        if self._job is not None:
            self._job.kill()
        shutil.rmtree(self._base, ignore_errors=True)

    def _path(self, name: str) -> Path:
        if name not in (*WHOLE_FILES, METRICS) and not FILE_NAME.fullmatch(name):
            raise UserError(f"a run folder has no file '{name}'")
        return place_of(self._run, name)

    def _files(self) -> dict[str, tuple[int, int]]:
        """Return size and time of each whole file that is there."""
        found = {}
        for name in (*(file.name for file in checkpoints_in(self._run)), *WHOLE_FILES):
            try:
                status = self._path(name).stat()
            except FileNotFoundError:
                continue
            found[name] = (status.st_size, status.st_mtime_ns)
        return found


def _grown(path: Path, known_id: str, offset: int) -> tuple[str, int, bytes]:
    """Return identity, offset and bytes of what a file has more than a driver knows; all of it where it is another."""
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            now = str(status.st_ino)
            if known_id and (now != known_id or status.st_size < offset):
                offset = 0
            file.seek(offset)
            return now, offset, file.read()
    except FileNotFoundError:
        return known_id, offset, b""


def _remove_abandoned(root: Path) -> None:
    """Remove the folders that killed workers of this user left."""
    for folder in root.glob(f"{_PREFIX}*"):
        try:
            status = (folder / _LOCK).stat()
        except OSError:
            continue
        old = time.time() - status.st_mtime > LEASE_S  # a newer one may be about to be locked
        if old and status.st_uid == os.getuid() and not is_held(folder / _LOCK) and not is_held(folder / "run" / LOCK):
            shutil.rmtree(folder, ignore_errors=True)
