"""The engine of a Ray cluster whose machines share a file system: each job is a task that Ray places on a node.

A job works on its run folder as on one machine, so what is done stands in the study folder at any moment. Ray starts
the task of a lost node again on another one, where the run goes on from its last checkpoint.
"""

from __future__ import annotations

import hashlib
import os
import platform
import secrets
import socket
import time
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, TaskCancelledError

import esp_envs
from esp_cli.defaults import __version__
from esp_cli.files.documents import DocumentFormat
from esp_cli.files.formatting import sentence
from esp_cli.files.opening import is_held
from esp_cli.studies.engine import LocalEngine
from esp_cli.training.build import process_bytes, spec_of
from esp_cli.training.folder_names import LOCK
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_envs.errors import UserError
from esp_envs.installed import available_cores

MAX_RETRIES = 3  # times that Ray starts a job again whose node or worker is lost
POLL_S = 0.5  # seconds between two looks at the process of a job
CONNECT_S = 10.0  # seconds in which a cluster has to answer
_OBJECT_STORE_BYTES = 256 * 2**20
_LIBRARIES = ("torch", "numpy", "mujoco", "pymunk")
_RAY_ENVIRONMENT = {"RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Of Ray, unless the user sets it."""
_JOB_ENVIRONMENT = ("ESP_CHECKPOINT_SECONDS", "ESP_TRACEBACK")  # handed on from the driver to the jobs


CLUSTER_FORMAT = DocumentFormat("esp-cluster", 1, "what a driver tells the nodes of a cluster")


class RayEngine:
    """Starts every job on a node of a Ray cluster; all nodes share the file system of the study's folder."""

    def __init__(self, folder: Path, address: str | None = None, gpus: float = 1.0) -> None:
        _connect(address)
        self.folder, self.gpus, self._identity = folder, gpus, secrets.token_hex(16)
        self._nodes: list[Mapping[str, float]] = []  # what nodes offer that were ever there: a lost one may come back

    def __enter__(self) -> RayEngine:
        return self

    def __exit__(self, *_: object) -> None:
        ray.shutdown()

    def places(self, device: str) -> int:
        """Return how many jobs fit on the nodes that are there now, at least one."""
        have = ray.cluster_resources()
        return max(1, int(have.get("GPU", 0) / self.gpus) if device == "cuda" else int(have.get("CPU", 0)))

    def start(self, arguments: Sequence[str], log: Path) -> RayJob:
        run = RunFolder.open(log.parent)
        config = parse_config(run.config, run.path)
        gpus, memory = self.gpus if config.device == "cuda" else 0.0, process_bytes(config, spec_of(config))
        self._nodes += [node["Resources"] for node in ray.nodes() if node["Alive"]]
        refuse_what_no_node_has({"CPU": 1, "GPU": gpus, "memory": memory}, run.path.name, self._nodes)
        told = {
            "identity": self._identity,
            "working_folder": str(Path.cwd()),
            "versions": dict(versions()),
            "environment": {name: os.environ[name] for name in _JOB_ENVIRONMENT if name in os.environ},
        }
        file = self.folder.absolute() / "cluster.json"
        CLUSTER_FORMAT.write(file, told)
        task = ray.remote(run_job).options(num_cpus=1, num_gpus=gpus, memory=memory, max_retries=MAX_RETRIES)
        return RayJob(task.remote(tuple(arguments), log.absolute(), file, self._identity), log.parent)


class RayJob:
    """A job on some node, by the reference to its exit code and to why it failed, and the folder of its run."""

    def __init__(self, result: Any, folder: Path) -> None:
        self._result, self._folder = result, folder
        self._code: int | None = None
        self._words = ""

    def poll(self) -> int | None:
        if self._code is None and ray.wait([self._result], timeout=0)[0]:
            try:
                self._code, self._words = ray.get(self._result)
            except TaskCancelledError:
                self._code, self._words = 130, "stopped"
            except RayError as error:
                self._code, self._words = 1, str(error).strip().splitlines()[-1]
            list(self._folder.iterdir())  # a network file system shows new files once their folder is read
        return self._code

    def ask_to_stop(self) -> None:
        ray.cancel(self._result)

    def kill(self) -> None:
        """End the task at once; its process, which is told of that, ends after its iteration."""
        ray.cancel(self._result, force=True)

    def last_words(self) -> str:
        return self._words


def run_job(arguments: Sequence[str], log: Path, cluster: Path, identity: str) -> tuple[int, str]:
    """Run the application on this node to its end (Ray's cancel stops it); return its exit code, and why it failed."""
    node = platform.node()
    try:
        told = CLUSTER_FORMAT.read(cluster) if cluster.is_file() else {}
        if told.get("identity") != identity:
            raise UserError(
                f"the node {node} does not see {cluster.parent} of this machine; put the study on a file system that "
                "all nodes share"
            )
        refuse_difference(node, versions(), told["versions"])
        while is_held(log.parent / LOCK):  # by the process of a lost worker, which ends with a checkpoint
            time.sleep(POLL_S)
        os.environ.update(told["environment"])
        folder = Path(told["working_folder"])
        job = LocalEngine(folder=folder if folder.is_dir() else None).start(arguments, log)
    except OSError as error:
        return 1, f"{sentence(error)} (on the node {node})"
    except UserError as error:
        return 2, str(error)
    code: int | None = None
    while code is None:
        try:
            while (code := job.poll()) is None:
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            job.ask_to_stop()
    return code, f"{job.last_words()} (on the node {node})" if code else ""


def refuse_what_no_node_has(needed: Mapping[str, float], name: str, nodes: Sequence[Mapping[str, float]]) -> None:
    """Refuse a run that would wait for ever: no node offers what it needs of "CPU", "GPU", and "memory" in bytes."""
    if any(all(node.get(kind, 0.0) >= amount for kind, amount in needed.items()) for node in nodes):
        return
    asked = ", ".join(["a core", *(["a GPU"] if needed["GPU"] else []), f"{needed['memory'] / 1e9:.1f} GB of memory"])
    # a run of fewer seeds needs less memory, and nothing else
    fewer = any(all(node.get(kind, 0.0) >= needed[kind] for kind in ("CPU", "GPU")) for node in nodes)
    advice = "add one, or use fewer seeds" if fewer else "add one"
    raise UserError(f"no node of the cluster offers what {name} needs ({asked}); {advice}")


@cache
def versions() -> Mapping[str, str]:
    """Return what decides whether two machines compute the same: versions by name, with a digest of esp's source."""
    digest = hashlib.sha256()
    for root in (Path(__file__).parents[1], Path(esp_envs.__path__[0])):
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    found = {"esp": f"{__version__} ({digest.hexdigest()[:10]})", "Python": platform.python_version()}
    return found | {name: version(name) for name in _LIBRARIES}


def refuse_difference(node: str, theirs: Mapping[str, str], ours: Mapping[str, str]) -> None:
    """Refuse a node whose versions, by name, are not those of the driver; the message names all that differ."""
    unlike = [name for name in ours if theirs.get(name) != ours[name]]
    if unlike:
        there = ", ".join(f"{name} {theirs.get(name, 'missing')}" for name in unlike)
        here = ", ".join(ours[name] for name in unlike)
        raise UserError(f"the node {node} has {there}, but the driver has {here}; install the same versions on both")


def _connect(address: str | None) -> None:
    """Connect to a cluster, or start one of this machine alone that no other machine reaches."""
    for name, text in _RAY_ENVIRONMENT.items():
        os.environ.setdefault(name, text)
    ray._private.worker._worker_logs_enabled = False  # Ray prints the loss of a node to standard output
    choice: dict[str, Any] = {"address": address, "log_to_driver": False, "logging_level": "ERROR"}
    if address is None and not os.environ.get("RAY_ADDRESS"):
        choice |= {"address": "local", "num_cpus": available_cores(), "include_dashboard": False}
        choice |= {"object_store_memory": _OBJECT_STORE_BYTES, "_node_ip_address": "127.0.0.1"}
        os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))  # of this cluster alone, in no file
        # else Ray replaces 127.0.0.1 by an address that other machines reach
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        ray._private.ray_constants.ENABLE_RAY_CLUSTER = False
    ray._raylet.Config.initialize("")  # reads RAY_AUTH_MODE again, which may have been set since the import
    try:
        _knock(address or os.environ.get("RAY_ADDRESS", ""))
        ray.init(**choice)
    except (OSError, RuntimeError, ValueError, RayError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"cannot use the Ray cluster at {address or 'RAY_ADDRESS'} ({reason}); check --address, "
            "RAY_AUTH_MODE, and that the nodes have the same versions of Ray and Python"
        ) from None


def _knock(address: str) -> None:
    """Refuse an address where nothing answers, for which Ray would wait for minutes, and one of Ray's client."""
    if address.startswith("ray://"):
        raise UserError("the driver has to be a machine of the cluster; Ray's client is not supported")
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
