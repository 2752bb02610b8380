"""Metrics files: rows per update and seed, torn ends, resuming."""

import json
import math
import os

import numpy as np
import pytest
import torch

from esp_cli.training import metrics
from esp_cli.training.metrics import MetricsWriter, column, read_last_row, read_metrics, truncate_metrics
from esp_envs.errors import UserError

ROWS = [
    {"step": 100, "train/loss": [1.0, 2.0], "time/seconds": 0.5},
    {"step": 200, "train/loss": [0.5, None], "eval/return": [-120.0, -130.0]},
    {"step": 300, "train/loss": [0.25, None], "eval/return": [-110.0, None]},
]


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in ROWS))
    return path


def test_rows_take_tensors_lists_and_numbers(tmp_path):
    path = tmp_path / "m.jsonl"
    with MetricsWriter(path) as writer:
        writer.write(
            100,
            {
                "train/loss": torch.tensor([0.5, float("nan")]),
                "train/kl": [1.0, -math.inf],
                "train/count": torch.tensor(3),
                "train/list": [1, 0.25, None],
                "time/seconds": 0.1,
            },
        )
    assert path.read_text() == (
        '{"step":100,"train/loss":[0.5,null],"train/kl":[1.0,null],"train/count":3,'
        '"train/list":[1,0.25,null],"time/seconds":0.1}\n'
    )


def test_each_row_is_in_the_file_when_write_returns(tmp_path):
    path = tmp_path / "m.jsonl"
    writer = MetricsWriter(path)
    for step in (1, 2, 3):
        assert writer.write(step, {"train/loss": [0.0, 1.0]}, without={1}) == {"train/loss": [0.0, None]}
        assert [row["step"] for row in read_metrics(path)] == list(range(1, step + 1))


@pytest.mark.parametrize("value", ["text", [[1.0]], {"a": 1}, torch.zeros(2, 2)])
def test_what_is_no_number_is_refused(tmp_path, value):
    path = tmp_path / "m.jsonl"
    with MetricsWriter(path) as writer, pytest.raises(UserError, match="'train/loss' is neither a number"):
        writer.write(1, {"train/loss": value})
    assert path.read_text() == ""


def test_step_is_no_metric(tmp_path):
    with MetricsWriter(tmp_path / "m.jsonl") as writer, pytest.raises(UserError, match="'step' is the row's own"):
        writer.write(1, {"step": 2.0})


def test_a_full_disk_names_the_file(tmp_path, full_disk):
    writer = MetricsWriter(tmp_path / "m.jsonl")
    with full_disk(), pytest.raises(OSError, match="File too large") as caught:
        writer.write(1, {"train/loss": [1.0]})
    assert caught.value.filename == str(tmp_path / "m.jsonl")


def test_column_is_steps_and_values_per_seed(path):
    rows = read_metrics(path)
    steps, values = column(rows, "train/loss")
    assert steps.tolist() == [100, 200, 300]
    np.testing.assert_array_equal(values, [[1.0, 2.0], [0.5, math.nan], [0.25, math.nan]])
    steps, values = column(rows, "eval/return")
    assert steps.tolist() == [200, 300]
    assert values.shape == (2, 2)
    assert column(rows, "time/seconds")[1].tolist() == [[0.5]]


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        ([], "no row has the metric 'train/loss', and no other"),
        ([{"step": 1, "train/los": [1.0]}], "there is train/los"),
        ([{"step": 1, "train/loss": [1.0]}, {"step": 2, "train/loss": [1.0, 2.0]}], "differ in the number of seeds"),
        ([{"step": 1, "train/loss": ["x"]}], "not a number"),
        ([{"step": 1, "train/loss": [[1.0]]}], "not a number"),
        ([{"step": 1, "train/loss": [10**400]}], "not a number"),
    ],
)
def test_columns_that_are_not_there_are_one_sentence(rows, text):
    with pytest.raises(UserError, match=text):
        column(rows, "train/loss")


def test_the_last_line_may_be_torn_at_any_byte(path):
    whole = path.read_bytes()
    start = whole.rindex(b"\n", 0, -1) + 1
    for end in range(start, len(whole) - 1):
        path.write_bytes(whole[:end])
        assert read_metrics(path) == ROWS[:2]
    path.write_bytes(whole[:-1])
    assert read_metrics(path) == ROWS


@pytest.mark.parametrize("line", [b"{}", b"[1]", b'{"step": "1"}', b'{"step": 1.5}', b"\x00\x00", b"[" * 100_000, b""])
def test_damage_inside_is_told_with_its_line(path, line):
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join([lines[0], line, *lines[1:]]))
    with pytest.raises(UserError, match=r"metrics\.jsonl is damaged: line 2 is not a row"):
        read_metrics(path)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_metrics(tmp_path / "m.jsonl")


def test_truncating_keeps_the_rows_up_to_a_step_byte_for_byte(path):
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(path.read_bytes() + b'{"step": 400, "train/l')
    truncate_metrics(path, 200)
    assert path.read_bytes() == lines[0] + b"\n" + lines[1] + b"\n"
    truncate_metrics(path, 0)
    assert path.read_bytes() == b""


def test_a_torn_line_does_not_swallow_the_next_row(path):
    whole = path.read_bytes()
    for end in range(len(whole) + 1):
        path.write_bytes(whole[:end])
        before = read_metrics(path)
        truncate_metrics(path, 300)
        with MetricsWriter(path) as writer:
            writer.write(999, {"train/loss": [1.0]})
        assert read_metrics(path) == [*before, {"step": 999, "train/loss": [1.0]}]


def test_the_last_row_is_found_however_long_it_is(path, monkeypatch):
    monkeypatch.setattr(metrics, "_TAIL_BYTES", 8)
    with path.open("a") as file:
        file.write('{"step": 400, "train/l')
    assert read_last_row(path) == ROWS[-1]
    path.write_text("torn")
    assert read_last_row(path) == {}


def test_a_pipe_in_its_place_is_waited_for_by_nobody(tmp_path):
    path = tmp_path / "metrics.jsonl"
    os.mkfifo(path)
    assert read_last_row(path) == {}
    with pytest.raises(UserError, match="is not a regular file"):
        read_metrics(path)


def test_metrics_of_other_seeds_than_the_run_has_are_refused():
    with pytest.raises(UserError, match="the metrics are damaged: 'a' has 2 seeds, the run 3"):
        metrics.Metrics([{"step": 1, "a": [1.0, 2.0]}], [0, 1, 2])


def test_a_file_of_forty_gigabytes_that_holds_nothing_is_one_sentence(tmp_path):
    path = tmp_path / "metrics.jsonl"
    with path.open("wb") as file:
        file.truncate(40 * 2**30)  # a hole, which takes no space
    with pytest.raises(UserError, match="line 1 is not a row of metrics"):
        read_metrics(path)
    with pytest.raises(UserError, match="line 1 is not a row of metrics"):
        truncate_metrics(path, 100)
    assert read_last_row(path) == {}
    assert [entry.name for entry in tmp_path.iterdir()] == ["metrics.jsonl"]
