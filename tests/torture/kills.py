"""Kills at random moments and at named places; afterwards a run, or a study, equals one that nobody disturbed.

Every process is a fork of this one, which has imported everything, so that a kill costs no import; signals are real.
"""

from __future__ import annotations

import gc
import hashlib
import itertools
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from esp_cli import app
from esp_cli.files import faults
from esp_cli.studies.catalogue import plan
from esp_cli.studies.engine_local import follow_parent
from esp_cli.studies.scheduler import Scheduler
from esp_cli.studies.study import StudyFolder
from esp_cli.training import trainer
from esp_cli.training.checkpoint import load_checkpoint
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from tests.studies.small_studies import request

SIGNALS = ("KILL", "KILL", "TERM", "INT")
ERRORS = ("ENOSPC", "EROFS", "EIO", "EDQUOT")
PATIENCE_S = 120.0
STUDY_SHARE = 0.05
MAX_INTERRUPTIONS = 5


Job = Callable[[Path], None]


@dataclass(frozen=True)
class Reference:
    """The end of a run that nobody disturbed, and how long it took."""

    state: str
    seconds: float


class Kills:
    """Cases of one run or study each, interrupted several times; see `Part`."""

    def __init__(self, scratch: Path, seed: int) -> None:
        self.scratch, self.seed = scratch / "kills", seed
        self.scratch.mkdir()
        self.configs = all_configs()
        gc.collect()
        gc.freeze()  # forks do not clean up what is this process's
        self._references: dict[str, Reference] = {}
        self._kills = 0

    def count(self) -> int:
        """Return the interruptions since the last call."""
        done, self._kills = self._kills, 0
        return done

    def run(self, number: int) -> str | None:
        """Interrupt a run or a study again and again, let it end, and compare it with one that was not disturbed."""
        rng = random.Random(f"{self.seed} {number}")
        if rng.random() < STUDY_SHARE:
            return self._repeat(rng, "study", study_job, study_state)
        name = list(self.configs)[number % len(self.configs)]
        config = self.configs[name]
        return self._repeat(rng, name, lambda path: run_job(path, config), run_state)

    def _repeat(self, rng: random.Random, name: str, job: Job, state: Callable[[Path], str]) -> str | None:
        if name not in self._references:
            path, begun = self.scratch / "reference", time.monotonic()
            code = wait(fork(lambda: job(path), path))
            if code != 0:
                return f"{name}: undisturbed, it ends with exit code {code}: {said(path)}"
            self._references[name] = Reference(state(path), time.monotonic() - begun)
            shutil.rmtree(path)
        reference, path = self._references[name], self.scratch / "run"
        history, newest = [], -1
        for _ in range(rng.randint(1, MAX_INTERRUPTIONS)):
            how, code = interrupt(rng, job, path, reference.seconds)
            self._kills += 1
            history.append(f"{how} -> {code}")
            step = newest_step(path)
            wrong_code = how.partition(":")[2].partition(":")[2] in ERRORS and code not in (0, 1)
            if wrong_code or "Traceback" in said(path) or (name != "study" and step < newest):
                return self._lost(f"{name}: after {history}: {said(path)[-1500:]} (step {step}, was {newest})", path)
            newest = step
        for _ in range(2):  # the second time, nothing is left to do
            code = wait(fork(lambda: job(path), path))
            if code != 0:
                return self._lost(f"{name}: after {history} it ends with exit code {code}: {said(path)[-1500:]}", path)
            if state(path) != reference.state:
                return self._lost(f"{name}: after {history} it ends otherwise than undisturbed", path)
        shutil.rmtree(path)
        return None

    def _lost(self, text: str, path: Path) -> str:
        kept = Path.cwd() / f"torture-kill-{time.time_ns()}"
        shutil.move(path, kept)
        return f"{text} (kept as {kept.name})"


def all_configs() -> dict[str, RunConfig]:
    """Return tiny runs of every learner, network, task, engine and kind of action that go together."""
    found = {}
    choices = itertools.product(
        ("mappo", "maddpg", "qmix"),
        ("mlp", "gru"),
        ("navigation", "predator-prey", "formation", "wildlife"),
        ("discrete", "continuous", None),
        ("mujoco", "mujoco-3d", "pymunk", None),
    )
    for algorithm, network, task, actions, physics in choices:
        settings: dict[str, object] = {"network.name": network, "network.hidden": [8], "evaluation.episodes": 2}
        settings |= {"evaluation.every_steps": 20, "task.horizon": 5, f"{algorithm}.num_envs": 2}
        if algorithm == "mappo":
            settings |= {"mappo.num_steps": 5, "mappo.num_epochs": 1, "mappo.num_minibatches": 1}
        else:
            settings |= {f"{algorithm}.warmup_episodes": 2, f"{algorithm}.replay_episodes": 64}
            settings |= {f"{algorithm}.batch_episodes": 2}
        settings |= {} if actions is None else {"task.actions": actions}
        settings |= {} if physics is None else {"task.physics": physics}
        try:
            config = resolve_config(task, algorithm, steps=60, seeds=(0, 1), overrides=settings)
            trainer.build_learner(config)
        except ValueError:
            continue  # they do not go together
        if config not in found.values():
            found[f"{algorithm} {network} {task} {actions} {physics}"] = config
    return found


def run_job(path: Path, config: RunConfig) -> None:
    """Train a run, or go on with it, as `esp train` does."""
    trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
    if not (path / "config.json").exists():
        RunFolder.create(path, config.model_dump(mode="json"))
    app.app(["train", "--resume", str(path)])


def study_job(path: Path) -> None:
    """Run a small study, or go on with it, two runs at once."""
    trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
    folder = StudyFolder.create(
        path, plan("table1", request(tasks=("navigation",), seeds=(0, 1), steps=((None, 200),)))
    )
    with folder.lock():
        scheduler = Scheduler(folder, folder.study.cells, 2, ForkEngine())
        scheduler.run(lambda snapshot: True, 0.02)
    failed = [run.message for run in scheduler.runs if run.status != "finished"]
    if failed:
        raise ValueError(f"runs failed: {'; '.join(failed)}")


class ForkEngine:
    """Starts the jobs of a study as forks of its process."""

    def start(self, arguments: Sequence[str], log: Path) -> ForkJob:
        """Start one; it is told to stop when its parent ends."""

        os.environ["ESP_PARENT_PROCESS"] = str(os.getpid())

        def job() -> None:
            os.closerange(3, 256)  # the lock of the study is not theirs
            follow_parent()
            faults.planned = None
            app.app(list(arguments))

        return ForkJob(fork(job, log.parent, log), log)


class ForkJob:
    """A fork that runs one command line; see `LocalJob`."""

    def __init__(self, pid: int, log: Path) -> None:
        self.pid, self.log, self._code = pid, log, None

    def poll(self) -> int | None:
        """Return the exit code, or None while it runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def ask_to_stop(self) -> None:
        """Ask it to end after its iteration."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it at once."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)
            self._code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def last_words(self) -> str:
        """Return the end of its log."""
        return self.log.read_text(errors="replace")[-300:]


def interrupt(rng: random.Random, job: Job, path: Path, seconds: float) -> tuple[str, int]:
    """Start a job and disturb it in one of several ways; return which, and the exit code."""
    kind = rng.choice(("moment", "moment", "place", "place", "place", "error", "limit", "two", "all", "clock"))
    name = rng.choice(SIGNALS)
    if kind in ("place", "error"):
        action = name if kind == "place" else rng.choice(ERRORS)
        fault = faults.Fault(rng.choice(faults.PLACES), rng.choice((1, 1, 2, 3, 5, 8, 13)), action)
        text = f"{fault.place}:{fault.left}:{fault.action}"
        return text, wait(fork(lambda: _with(job, path, fault=fault), path))
    if kind == "limit":
        size = rng.choice((0, 1000, 10_000, 50_000))
        return f"files of at most {size} bytes", wait(fork(lambda: _with(job, path, file_bytes=size), path))
    back = kind == "clock"
    first = fork(lambda: _with(job, path, clock_back=back), path)
    if kind == "two":
        second = fork(lambda: job(path), path, path.with_name("second.txt"))
        wait(second)
    time.sleep(rng.uniform(0, seconds * 1.2))
    try:
        (os.killpg if kind == "all" else os.kill)(first, getattr(signal, f"SIG{name}"))
    except ProcessLookupError:
        return f"{kind}, too late", wait(first)
    return f"{kind} {name}", wait(first)


def _with(
    job: Job,
    path: Path,
    fault: faults.Fault | None = None,
    file_bytes: int = -1,
    clock_back: bool = False,
) -> None:
    faults.planned = fault
    if file_bytes >= 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, resource.RLIM_INFINITY))
    if clock_back:
        real = time.time
        time.time = lambda: real() - 86_400 * (1 + real() % 7)
    job(path)


def fork(job: Callable[[], None], path: Path, log: Path | None = None) -> int:
    """Run a job in a fork that leads a group of its own; what it says goes to a file beside the path."""
    log = log or path.with_name("said.txt")
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setsid()
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            job()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except (ValueError, OSError) as failure:
            code = app.report(failure) or 1
        except KeyboardInterrupt:
            code = app.EXIT_INTERRUPTED
        sys.stdout.flush()
    except BaseException:  # a bug; the parent looks for the word Traceback
        os.write(2, traceback.format_exc().encode())
    finally:
        os._exit(code)


def wait(pid: int) -> int:
    """Return the exit code of a fork, negative for a signal; end it if it does not end by itself."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return -999


def said(path: Path) -> str:
    """Return what the last process beside a path said."""
    file = path.with_name("said.txt")
    return file.read_text(errors="replace") if file.exists() else ""


def newest_step(path: Path) -> int:
    """Return the step of the newest checkpoint of a run, -1 where there is none."""
    names = [file.name for file in (path / "checkpoints").glob("step-*.safetensors")]
    return max((int(name[5:17]) for name in names), default=-1)


def run_state(path: Path) -> str:
    """Return a digest of what a run leaves: policy, last checkpoint, and metrics without times."""
    digest = hashlib.sha256((path / "policy.safetensors").read_bytes())
    files = sorted((path / "checkpoints").iterdir())
    digest.update(str([file.name for file in files]).encode())
    for file in files:
        tensors, meta = load_checkpoint(file)
        for name in sorted(tensors):
            digest.update(name.encode() + tensors[name].numpy().tobytes())
        digest.update(str(sorted((key, value) for key, value in meta.items() if key != "elapsed_s")).encode())
    for row in read_metrics(path / "metrics.jsonl"):
        digest.update(repr([(key, value) for key, value in row.items() if not key.startswith("time/")]).encode())
    digest.update(str(sorted(entry.name for entry in path.iterdir() if entry.name not in ("log.txt",))).encode())
    return digest.hexdigest()


def study_state(path: Path) -> str:
    """Return a digest of what a study leaves: its runs and their final evaluations."""
    folder = StudyFolder.open(path)
    digest = hashlib.sha256((path / "study.json").read_bytes())
    for cell in folder.study.cells:
        digest.update(run_state(folder.run_path(cell)).encode())
        text = folder.evaluation_path(cell).read_text().replace(str(path), "")
        digest.update(text.encode())
    return digest.hexdigest()
