"""Trackers get what the metrics file holds, write into the run folder alone, and stop no run whatever they do."""

import contextlib
import json
import os
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from esp_cli.training import trackers
from esp_cli.training.checkpoint import POLICY_FORMAT, load_checkpoint
from esp_cli.training.metrics import read_metrics
from esp_cli.training.trackers import Row, TrackedRun, scalars
from tests.cli.running import STEPS, TINY_OPTIONS, esp, refused, train_tiny

ROOT = Path(__file__).parents[2]
NAME = "eval/return_greedy"


def test_a_metric_is_a_mean_which_a_seed_without_a_number_leaves_out_and_one_number_per_seed() -> None:
    row = {"a": [1.0, 3.0], "b": 0.5, "c": [None, 1.0], "d": None}
    means = [("a", None, 2.0), ("a", 3, 1.0), ("a", 7, 3.0), ("b", None, 0.5)]
    assert list(scalars(row, (3, 7))) == [*means, ("c", 7, 1.0)]
    assert list(scalars({"a": [1.0]}, (3,))) == [("a", None, 1.0)], "one seed is its own mean"


class Failing:
    way = "open"
    rows = closed = 0

    def __init__(self, run: TrackedRun) -> None:
        self._fail("open")

    def write(self, step: int, values: Row) -> None:
        type(self).rows += 1
        if step:
            self._fail("write")

    def close(self) -> None:
        type(self).closed += 1
        self._fail("close")

    def _fail(self, way: str) -> None:
        if self.way == way:
            raise RuntimeError("the server\nis on fire")


@pytest.mark.parametrize("way", ["open", "write", "close"])
def test_a_tracker_that_fails_is_one_line_and_the_run_goes_on(finished, tmp_path, monkeypatch, way):
    monkeypatch.setitem(trackers.TRACKERS, "wandb", Failing)
    monkeypatch.setattr(trackers, "find_spec", lambda name: True)
    monkeypatch.setattr(Failing, "way", way)
    monkeypatch.setattr(Failing, "rows", 0)
    monkeypatch.setattr(Failing, "closed", 0)
    words = ["--network", "mlp", *TINY_OPTIONS, *STEPS, "--seed-list", "3,7", "--track", "wandb"]
    told = esp("train", *words, "--out", tmp_path / "run")
    sentence = f"tracking with wandb ended: it cannot {way} (the server); the run goes on"
    assert told.stderr.splitlines().count(sentence) == 1
    assert Failing.rows == {"open": 0, "write": 2, "close": 4}[way]
    assert Failing.closed == (way != "open"), "closed once, whatever failed"
    files = [run / "policy.safetensors" for run in (tmp_path / "run", finished)]
    weights = [load_checkpoint(file, format_name=POLICY_FORMAT)[0] for file in files]
    assert all(torch.equal(tensor, weights[1][name]) for name, tensor in weights[0].items())
    assert len(read_metrics(tmp_path / "run" / "metrics.jsonl")) == 4


def test_a_missing_package_is_one_sentence_before_there_is_a_folder(tmp_path, monkeypatch, copied):
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    sentence = "mlflow is not installed: pip install 'mlflow-skinny>=2.16', or leave out --track mlflow"
    assert refused("train", "--out", tmp_path / "run", "--track", "mlflow") == sentence
    assert not (tmp_path / "run").exists()
    assert refused("train", "--resume", copied, "--track", "mlflow") == sentence
    assert "there is no tracker 'comet'; the trackers are" in refused("train", "--track", "comet")
    with pytest.raises(ValueError, match="there is no tracker 'comet'; the trackers are tensorboard, wandb, mlflow"):
        trackers.require(["comet"])


Curves = dict[str, list[tuple[int, float]]]
"""Steps and values by name, as a tracker holds them."""


def of_tensorboard(run: Path) -> Curves:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    found: Curves = {}
    for folder in [run / "tensorboard", *(run / "tensorboard").glob("seed-*")]:
        accumulator = EventAccumulator(str(folder)).Reload()
        prefix = "" if folder.name == "tensorboard" else f"{folder.name}/"
        for name in accumulator.Tags()["scalars"]:
            found[prefix + name] = [(event.step, event.value) for event in accumulator.Scalars(name)]
    return found


def of_wandb(run: Path) -> Curves:
    found: Curves = {}
    for file in sorted(run.glob("wandb/offline-run-*/run-*.wandb")):
        for record in _whole_run(file):
            row: dict[str, Any] = {
                (item.key or "/".join(item.nested_key)): json.loads(item.value_json) for item in record.history.item
            }
            for name, value in row.items():
                if not name.startswith("_") and name != "step":
                    found.setdefault(name, []).append((row["step"], value))
    return found


def _whole_run(file: Path, seconds: float = 60) -> list[Any]:
    """Return a run's records up to its exit, which wandb's own process may write after the run was told of its end."""
    from google.protobuf.message import DecodeError
    from wandb.proto.wandb_internal_pb2 import Record

    until = time.monotonic() + seconds
    while True:
        records = []
        with contextlib.suppress(DecodeError):  # what is not written to its end
            for content in _log_records(file.read_bytes()[7:]):
                record = Record.FromString(content)
                records.append(record)
        if records and records[-1].WhichOneof("record_type") == "exit":
            return records
        assert time.monotonic() < until, f"{file} does not end"
        time.sleep(0.05)


def _log_records(content: bytes, first_block: int = 32768 - 7) -> Iterator[bytes]:
    """Yield the records of a LevelDB log, whose blocks have 32 KiB: checksum, length and kind before each part."""
    place, end, parts = 0, first_block, b""
    while place + 7 <= len(content):
        if end - place < 7:
            place, end = end, end + 32768
            continue
        length, kind = struct.unpack_from("<HB", content, place + 4)
        parts += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield parts
            parts = b""


def of_mlflow(run: Path) -> Curves:
    os.environ["MLFLOW_ALLOW_FILE_STORE"] = "true"
    from mlflow.tracking import MlflowClient

    client = MlflowClient((run / "mlruns").as_uri())
    run_id = (run / "mlruns" / "run-id").read_text()
    names = client.get_run(run_id).data.metrics
    return {name: [(one.step, one.value) for one in client.get_metric_history(run_id, name)] for name in names}


READERS = {"tensorboard": of_tensorboard, "wandb": of_wandb, "mlflow": of_mlflow}


@pytest.mark.parametrize("name", READERS)
def test_a_real_tracker_holds_what_the_metrics_file_holds_and_writes_nowhere_else(tmp_path: Path, name: str) -> None:
    if not trackers.find_spec(name):
        pytest.skip(f"{name} is not installed; .ci/run installs it")
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    command = ["train", *TINY_OPTIONS, *STEPS, "--seed-list", "3,7", "--track", name, "--out", "run"]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("WANDB", "MLFLOW", "XDG"))}
    environment |= {"HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(ROOT), str(ROOT / "environments"), os.environ.get("PYTHONPATH", "")]
    )
    program = [sys.executable, "-c", "from esp_cli.app import main; main()"]
    done = subprocess.run(
        [*program, *map(str, command)], cwd=work, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "tracking with" not in done.stderr
    assert [path.name for path in work.iterdir()] == ["run"]
    assert [path for path in home.rglob("*") if path.is_file()] == []

    rows = read_metrics(work / "run" / "metrics.jsonl")
    found = READERS[name](work / "run")
    expected = [(row["step"], row[NAME]) for row in rows if NAME in row]
    assert len(expected) >= 3
    assert found[NAME] == [(step, pytest.approx(sum(values) / 2)) for step, values in expected]
    assert found[f"seed-7/{NAME}"] == [(step, pytest.approx(values[1])) for step, values in expected]
    assert set(found) >= {"train/return", "time/steps_per_second"}


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_resumed_run_is_one_run_for_its_tracker(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if not trackers.find_spec(name):
        pytest.skip(f"{name} is not installed; .ci/run installs it")
    monkeypatch.setenv("HOME", str(tmp_path))
    run = train_tiny(tmp_path / "run", "--seed-list", "3,7", "--track", name, steps=100)
    file = run / ("wandb" if name == "wandb" else "mlruns") / "run-id"
    known = file.read_text()
    for checkpoint in (run / "checkpoints").iterdir():
        checkpoint.unlink()
    (run / "policy.safetensors").unlink()
    told = esp("train", "--resume", run, "--track", name)
    assert "tracking with" not in told.stderr
    assert file.read_text() == known
    curves = READERS[name](run)
    assert [step for step, _ in curves[NAME]] in ([0, 100, 0, 100], [0, 0, 100, 100])
    assert not {name for name in os.environ if name.endswith("_DIR") and name.startswith("WANDB_")}, (
        "the next run's own"
    )


def test_a_link_at_the_folder_of_a_tracker_is_not_followed(tmp_path):
    pytest.importorskip("tensorboard")
    (tmp_path / "outside").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "tensorboard").symlink_to(tmp_path / "outside")
    notes: list[str] = []
    (sink,) = trackers.open_trackers(["tensorboard"], trackers.TrackedRun(tmp_path / "run", (0,), {}), notes.append)
    sink.write(100, {"train/loss": [1.0]})
    sink.close()
    assert list((tmp_path / "outside").iterdir()) == []
    assert "a link or no regular file is there" in notes[0]


def test_a_full_disk_under_tensorboard_is_one_line_without_a_traceback(tmp_path, monkeypatch, capsys):
    writer = pytest.importorskip("tensorboard.summary.writer.record_writer").RecordWriter
    notes: list[str] = []
    monkeypatch.setattr(threading, "excepthook", threading.__excepthook__)
    (sink,) = trackers.open_trackers(["tensorboard"], trackers.TrackedRun(tmp_path, (0,), {}), notes.append)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer, "write", full)
    trackers.open_trackers(["tensorboard"], trackers.TrackedRun(tmp_path / "b", (0,), {}), notes.append)
    assert notes == [
        "tracking with tensorboard ended: it cannot open ([Errno 28] No space left on device); the run goes on"
    ]
    assert capsys.readouterr().err == ""
    other = threading.Thread(target=full)
    other.start()
    other.join()
    assert "No space left on device" in capsys.readouterr().err, "other threads are heard"
    sink.close()
