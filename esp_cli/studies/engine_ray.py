"""The engine of a Ray cluster: each job in a worker on any node, its run folder mirrored in the driver's study folder.

No file system is shared. Each job has a thread here that finds or makes its worker, sends the run folder, and fetches
what the job writes. A worker is found by its name, so a driver that is started again goes on with the workers of the
one before it, and no job has two workers. A lost worker is replaced by one that goes on from the last checkpoint here.
"""

from __future__ import annotations

import hashlib
import os
import platform
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError

from esp_cli.files.documents import DocumentFormat
from esp_cli.files.failures import sentence
from esp_cli.studies.mirror import FileGoneError, Mirror
from esp_cli.studies.ray_cluster import NAMESPACE, ClusterError, connect, offers, refuse_what_no_node_has
from esp_cli.studies.versions import refuse_difference
from esp_cli.studies.worker import SILENCE_S, CellWorker, Lease, LeaseLostError, News
from esp_cli.training.build import spec_of
from esp_cli.training.config_file import parse_config
from esp_cli.training.memory import process_bytes
from esp_cli.training.run_folder import RunFolder

BEAT_S = 0.5
"""Seconds between two looks at a worker."""
END_S = 5.0
"""Seconds that a worker is given to remove its files; one without a node has none."""
START_S = 60.0
"""Seconds in which workers may fail to start, one after the other."""
MAX_LOSSES = 3
"""Workers that a job may lose without a new checkpoint."""
_FORWARDED = ("ESP_CHECKPOINT_SECONDS", "ESP_TRACEBACK")
_CLUSTER = "cluster.json"
CLUSTER_FORMAT = DocumentFormat("esp-cluster", 1, "the name of a study on a cluster", ClusterError)


class _StoppedError(Exception):
    """The job is to stop, and has no worker yet."""


class RayEngine:
    """Starts every job on a node of a Ray cluster.

    Args:
        folder: of the study; workers are named after an identity that is kept there.
        address: of the cluster; by default that of RAY_ADDRESS, or a cluster of this machine alone.
        gpus: share of a GPU that a run on "cuda" takes.
        silence_s: see `CellWorker`.

    Raises:
        ClusterError: no cluster answers, or a node cannot run esp.
        UserError: a node has other versions than this machine.
    """

    def __init__(
        self, folder: Path, address: str | None = None, gpus: float = 1.0, silence_s: float = SILENCE_S
    ) -> None:
        self.folder, self.gpus, self.silence_s = folder, gpus, silence_s
        self.owner = f"process {os.getpid()} on {platform.node()} ({secrets.token_hex(4)})"
        connect(address)
        self._offers = offers()  # of nodes that were ever there: a lost one may come back

    def __enter__(self) -> RayEngine:
        return self

    def __exit__(self, *_: object) -> None:
        ray.shutdown()

    def places(self, device: str) -> int:
        """Return how many jobs fit on the nodes that are there now, at least one."""
        have = ray.cluster_resources()
        return max(1, int(have.get("GPU", 0) / self.gpus) if device == "cuda" else int(have.get("CPU", 0)))

    def start(self, arguments: Sequence[str], log: Path) -> RayJob:
        """Start the application with these arguments on some node; what it prints is appended to the log."""
        run = RunFolder.open(log.parent)
        config = parse_config(run.config, run.path)
        gpus, memory = self.gpus if config.device == "cuda" else 0.0, process_bytes(config, spec_of(config))
        self._offers += [offer for offer in offers() if offer not in self._offers]
        refuse_what_no_node_has({"CPU": 1, "GPU": gpus, "memory": memory}, run.path.name, self._offers)
        key = f"{self._identity()}/{run.path.name}/{arguments[0]}"
        actor = ray.remote(CellWorker).options(
            name=f"esp-{hashlib.sha256(key.encode()).hexdigest()[:32]}",
            namespace=NAMESPACE,
            lifetime="detached",
            get_if_exists=True,
            max_restarts=0,
            num_cpus=1,
            num_gpus=gpus,
            memory=memory,
        )
        return RayJob(self.owner, lambda: actor.remote(silence_s=self.silence_s), arguments, run)

    def _identity(self) -> str:
        """Return the identity of the study, which a driver that is started again finds in its folder."""
        path = self.folder / _CLUSTER
        if not path.exists():
            CLUSTER_FORMAT.write(path, {"identity": secrets.token_hex(16)})
        return str(CLUSTER_FORMAT.read(path).get("identity"))


class RayJob:
    """A job on some node, followed by a thread here.

    Args:
        owner: name of this driver.
        find: returns the worker of the job, which is made if there is none.
        arguments: of the command line, with the paths of this machine.
        folder: of the run, on this machine.
    """

    def __init__(self, owner: str, find: Callable[[], Any], arguments: Sequence[str], folder: RunFolder) -> None:
        self._owner, self._find, self._arguments, self._folder = owner, find, tuple(arguments), folder
        self._stopping, self._killed = threading.Event(), threading.Event()
        self._actor: Any = None
        self._code: int | None = None
        self._words = ""
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def poll(self) -> int | None:
        """Return the exit code, or None while the job runs."""
        return None if self._thread.is_alive() else self._code

    def ask_to_stop(self) -> None:
        """Ask the job to end after its iteration, with a checkpoint."""
        self._stopping.set()

    def kill(self) -> None:
        """End the job at once and wait until it is gone."""
        self._killed.set()
        self._stopping.set()
        self._thread.join()

    def last_words(self) -> str:
        """Return why the job failed: its last error message, or its last line."""
        return self._words

    def _work(self) -> None:
        try:
            with self._folder.lock():
                self._code = self._run()
        except _StoppedError:
            self._code, self._words = 130, "stopped"
        except OSError as error:
            self._code, self._words = 1, sentence(error)
        except (ValueError, RayError) as error:
            self._code, self._words = 2, str(error).strip().splitlines()[-1]
        finally:
            if self._code is None:
                self._code, self._words = 1, "its thread ended by a bug; see the traceback"
            self._release()

    def _run(self) -> int:
        """Run the job to its end, on as many workers as it takes."""
        losses, before = 0, -1
        while True:
            lease, mirror = self._leased(), Mirror(self._folder.path)
            losses, before = 0 if mirror.newest_step > before else losses, mirror.newest_step
            try:
                return self._follow(mirror, lease)
            except LeaseLostError:  # another driver goes on with it; wait for that one
                self._actor = None
            except RayActorError:
                self._actor = None
                losses += 1
                mirror.say(f"lost the worker on {lease['node']}; going on from step {max(0, mirror.newest_step)}")
                if losses == MAX_LOSSES:
                    self._words = f"it lost {losses} workers one after the other without a new checkpoint"
                    return 1
            if self._stopping.is_set():
                raise _StoppedError

    def _leased(self) -> Lease:
        """Lease the worker of the job; wait for a free node, or for another driver that holds it."""
        failing_since: float | None = None
        while True:
            try:
                self._actor = self._find()
                lease: Lease = self._ask(self._actor.attach.remote(self._owner), waiting=True)
            except RayActorError:  # its name is still that of the worker that was lost
                failing_since = failing_since or time.monotonic()
                if time.monotonic() - failing_since > START_S:
                    raise
            else:
                if not lease["holder"]:
                    refuse_difference(lease["node"], lease["versions"])
                    return lease
                failing_since = None
            self._actor = None
            if self._stopping.wait(BEAT_S):
                raise _StoppedError

    def _follow(self, mirror: Mirror, lease: Lease) -> int:
        """Start the job on its worker, unless it runs already, and fetch what it writes until it ends."""
        actor, owner, told = self._actor, self._owner, False
        if lease["begun"]:
            mirror.log_offset = lease["log_offset"]
        else:
            for name, part in mirror.outgoing():
                self._ask(actor.put.remote(owner, name, part))
            environment = {name: os.environ[name] for name in _FORWARDED if name in os.environ}
            arguments = _moved(self._arguments, self._folder.path, lease)
            mirror.know(self._ask(actor.begin.remote(owner, arguments, environment)))
        while True:
            reference = actor.look.remote(owner, mirror.log_offset, mirror.metrics_id, mirror.metrics_offset)
            news: News = self._ask(reference)
            mirror.take(news)
            complete = self._fetch(mirror, news, lease["folder"])
            if complete and news["code"] is not None:
                self._words = f"{news['words']} (on the node {lease['node']})"
                if news["code"] < 0:  # the process could not say it itself
                    mirror.say(self._words)
                return news["code"]
            if self._stopping.is_set() and not told:
                self._ask(actor.stop.remote(owner))
                told = True
            (time.sleep if told else self._stopping.wait)(BEAT_S)

    def _fetch(self, mirror: Mirror, news: News, remote: str) -> bool:
        """Fetch the files that are new; return False where one was superseded on the way."""
        actor = self._actor
        try:
            for name in mirror.wanted(news["files"]):
                read = partial(lambda name, offset: self._ask(actor.read.remote(self._owner, name, offset)), name)
                mirror.fetch(name, news["files"][name], read, remote)
        except FileGoneError:
            return False
        return True

    def _ask(self, reference: Any, waiting: bool = False) -> Any:
        """Return the answer of a worker; give up when the job is killed, or stopped while it waits for a node."""
        while not ray.wait([reference], timeout=0.2)[0]:
            if self._killed.is_set() or (waiting and self._stopping.is_set()):
                raise _StoppedError
        if self._killed.is_set():
            raise _StoppedError
        return ray.get(reference)

    def _release(self) -> None:
        """End the worker, if this driver has it."""
        actor, self._actor = self._actor, None
        if actor is None:
            return
        try:
            ready, _ = ray.wait([actor.end.remote(self._owner)], timeout=END_S)
            ray.get(ready)
            ray.kill(actor)
        except (RayError, LeaseLostError):  # it is gone, or another driver's
            pass


def _moved(arguments: Sequence[str], here: Path, lease: Lease) -> list[str]:
    """Return arguments with the run folder here replaced by that of the worker."""
    local = str(here)
    inside = [text == local or text.startswith(f"{local}{os.sep}") for text in arguments]
    return [lease["folder"] + t[len(local) :] if i else t for t, i in zip(arguments, inside, strict=True)]
