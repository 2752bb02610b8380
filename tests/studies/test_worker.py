"""What a node and the driver do for a job, without a cluster: leases, and run folders that follow each other."""

from __future__ import annotations

import errno
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from esp_cli.files.locking import acquire, release
from esp_cli.studies import worker as worker_module
from esp_cli.studies.mirror import FileGoneError, Mirror
from esp_cli.studies.versions import refuse_difference, versions
from esp_cli.studies.worker import CellWorker, LeaseLostError
from esp_cli.training.metrics import read_metrics
from tests.faults import Fault
from tests.training.runs import tiny_folder

WRITES_AND_WAITS = (
    "import pathlib, sys, time; run = pathlib.Path(sys.argv[2]); print('hello', flush=True);"
    "(run / 'metrics.jsonl').write_text('{\"step\": 50}\\n');"
    "[time.sleep(0.02) for _ in iter(lambda: (run / 'policy.safetensors').exists(), True)]"
)


@pytest.fixture
def worker(tmp_path):
    made = CellWorker(600.0, 60.0, str(tmp_path), (sys.executable, "-S", "-c", WRITES_AND_WAITS))
    yield made
    leave(made)


def leave(worker):
    """Clear a worker and let its lease last for ever; a lease that runs out ends the process of the tests."""
    worker._heard = math.inf
    worker._clear()


@pytest.fixture
def folder(tmp_path):
    return tiny_folder(tmp_path / "mine")


def wait_for(condition):
    deadline = time.monotonic() + 240
    while not condition():
        assert time.monotonic() < deadline, "it did not come true"
        time.sleep(0.01)


def checkpoint_news(step: int, content: bytes = b"weights"):
    name = f"step-{step:012d}.safetensors"
    return name, (len(content), 1), lambda offset: content[offset : offset + 3]


def news(**changes):
    return {
        "code": None,
        "words": "",
        "log": b"",
        "metrics_id": "7",
        "metrics_offset": 0,
        "metrics": b"",
        "files": {},
    } | changes


def test_a_worker_has_one_driver_until_that_one_is_silent(worker):
    assert worker.attach("first")["holder"] == ""
    assert worker.attach("second")["holder"] == "first"
    worker.put("first", "metrics.jsonl", b"")
    with pytest.raises(LeaseLostError):
        worker.put("second", "metrics.jsonl", b"")
    worker._heard -= 100.0  # seconds of silence
    assert worker.attach("second")["holder"] == ""
    with pytest.raises(LeaseLostError, match="second has taken over"):
        worker.stop("first")


def test_who_takes_a_worker_over_before_its_job_begins_sends_all_files_anew(worker):
    lease = worker.attach("first")
    worker.put("first", "step-000000000100.safetensors", b"wei")
    worker._heard -= 100.0  # seconds of silence
    assert not worker.attach("second")["begun"]
    worker.put("second", "step-000000000100.safetensors", b"wei")
    worker.put("second", "step-000000000100.safetensors", b"ghts")
    assert (Path(lease["folder"]) / "checkpoints" / "step-000000000100.safetensors").read_bytes() == b"weights"


@pytest.mark.slow
def test_a_worker_that_nobody_calls_ends_itself_and_its_job(tmp_path):
    program = (sys.executable, "-S", "-c", "import time; time.sleep(60)")
    code = (
        "import time; from esp_cli.studies.worker import CellWorker\n"
        f"worker = CellWorker(5.0, 1.0, {str(tmp_path)!r}, {program!r})\n"
        "worker.attach('me'); worker.begin('me', [], {}); print(worker._job.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        job = int(process.stdout.readline())
        assert process.wait(120) == 0
    with pytest.raises(ProcessLookupError):
        os.kill(job, 0)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_follows_the_one_of_the_worker(worker, folder):
    mirror = Mirror(folder.path)
    lease = worker.attach("me")
    for name, part in mirror.outgoing():
        worker.put("me", name, part)
    files = worker.begin("me", ["train", lease["folder"]], {})
    assert mirror.wanted(files) == ["config.json"]
    mirror.know(files)
    assert mirror.wanted(files) == []

    def look():
        found = worker.look("me", mirror.log_offset, mirror.metrics_id, mirror.metrics_offset)
        mirror.take(found)
        for name in mirror.wanted(found["files"]):
            mirror.fetch(name, found["files"][name], lambda offset, name=name: worker.read("me", name, offset), "-")
        return found

    wait_for(lambda: look()["metrics"])
    worker.put("me", "step-000000000100.safetensors", b"weights")
    worker.put("me", "policy.safetensors", b"policy")
    wait_for(lambda: look()["code"] == 0)
    assert read_metrics(folder.metrics_path) == [{"step": 50}]
    assert folder.checkpoint_path(100).read_bytes() == b"weights"
    assert folder.policy_path.read_bytes() == b"policy"
    assert "hello" in (folder.path / "log.txt").read_text()
    # who takes over is told what the first has, and the log is not written twice
    worker._heard -= 100.0  # seconds of silence
    assert worker.attach("other")["log_offset"] == mirror.log_offset > 0


def test_a_worker_takes_files_of_a_run_folder_only(worker):
    worker.attach("me")
    for name in ("../mine", "/etc/passwd", "run.lock", "checkpoints/step-000000000100.safetensors"):
        with pytest.raises(ValueError, match="has no file"):
            worker.put("me", name, b"")


def test_a_file_stays_readable_while_the_job_removes_it(worker, monkeypatch):
    monkeypatch.setattr(worker_module, "CHUNK_BYTES", 3)
    worker.attach("me")
    name = "step-000000000100.safetensors"
    worker.put("me", name, b"weights")
    first = worker.read("me", name, 0)
    worker._path(name).unlink()
    assert first + worker.read("me", name, 3) + worker.read("me", name, 6) == b"weights"
    assert worker.read("me", name, 0) == b""


def test_folders_that_killed_workers_left_are_removed_and_those_in_use_stay(tmp_path):
    old = time.time() - 1000
    for name in ("esp-cell-dead", "esp-cell-alive", "esp-cell-young"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "worker.lock").touch()
    held = acquire(tmp_path / "esp-cell-alive" / "worker.lock")
    for name in ("esp-cell-dead", "esp-cell-alive"):
        os.utime(tmp_path / name / "worker.lock", (old, old))
    made = CellWorker(30.0, 1.0, str(tmp_path))
    try:
        names = {path.name for path in tmp_path.iterdir()}
        assert "esp-cell-dead" not in names
        assert {"esp-cell-alive", "esp-cell-young"} < names
    finally:
        leave(made)
        release(held)


def test_metrics_that_a_resumed_job_rewrote_replace_those_here(folder):
    mirror = Mirror(folder.path)
    mirror.take(news(metrics=b'{"step": 50}\n{"step": 100}\n'))
    mirror.take(news(metrics_offset=mirror.metrics_offset, metrics=b'{"step": 150}\n'))
    assert [row["step"] for row in read_metrics(folder.metrics_path)] == [50, 100, 150]
    mirror.take(news(metrics_id="8", metrics=b'{"step": 50}\n'))
    mirror.take(news(metrics_id="8", metrics_offset=mirror.metrics_offset, metrics=b'{"step": 100}\n'))
    assert [row["step"] for row in read_metrics(folder.metrics_path)] == [50, 100]


def test_the_newest_two_checkpoints_stay(folder):
    mirror = Mirror(folder.path)
    for step in (100, 200, 300):
        name, stamp, read = checkpoint_news(step)
        assert mirror.wanted({"step-000000000050.safetensors": (1, 1), name: stamp}) == [name]
        mirror.fetch(name, stamp, read, "-")
        assert mirror.wanted({name: stamp}) == []
    assert folder.checkpoints() == [folder.checkpoint_path(200), folder.checkpoint_path(300)]
    assert mirror.newest_step == 300


@pytest.mark.parametrize("fault", ["gone", "full"])
def test_a_checkpoint_comes_as_a_whole_or_not_at_all(folder, monkeypatch, fault):
    mirror = Mirror(folder.path)
    mirror.fetch(*checkpoint_news(100), "-")
    name, stamp, read = checkpoint_news(200)
    if fault == "gone":
        with pytest.raises(FileGoneError):
            mirror.fetch(name, stamp, lambda offset: read(offset) if offset < 3 else b"", "-")
    else:
        Fault("write", 1, "ENOSPC").plan(monkeypatch)
        with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
            mirror.fetch(name, stamp, read, "-")
    assert [file.name for file in (folder.path / "checkpoints").iterdir()] == [folder.checkpoint_path(100).name]
    assert mirror.wanted({name: stamp}) == [name]


def test_an_evaluation_names_the_run_folder_here(folder):
    content = json.dumps({"source": "/tmp/esp-cell-x/run", "step": 3}).encode()
    stamp = (len(content), 1)
    Mirror(folder.path).fetch("final-evaluation.json", stamp, lambda o: content[o : o + 9], "/tmp/esp-cell-x/run")
    assert json.loads((folder.path / "final-evaluation.json").read_text()) == {"source": str(folder.path), "step": 3}


def test_a_node_of_another_version_is_refused_in_one_sentence():
    refuse_difference("n1", versions())
    other = {**versions(), "torch": "1.0", "numpy": "1.0"}
    with pytest.raises(ValueError, match=r"the node n1 has torch 1.0, numpy 1.0, but this machine has .*; install"):
        refuse_difference("n1", other)
    with pytest.raises(ValueError, match="has esp missing"):
        refuse_difference("n1", {name: text for name, text in versions().items() if name != "esp"})
