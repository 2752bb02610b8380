"""What the console prints, and how it writes numbers."""

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from pydantic import BaseModel

from esp_cli import console
from esp_cli.console import TrainingProgress, format_count, format_duration, format_interval, format_mean, format_span
from esp_cli.console.progress import stop_requests
from esp_cli.files.formatting import file_name, format_exactly


class Model(BaseModel):
    rate: float = 0.5


@dataclass
class Interval:
    low: float
    high: float


def test_json_takes_what_the_engine_hands_over(tmp_path: Path) -> None:
    value = {
        "tensor": torch.tensor([1.0, math.inf]),
        "scalar": torch.tensor(2),
        "nan": math.nan,
        "flag": True,
        "model": Model(),
        "interval": Interval(-1.0, 1.5),
        "path": Path("runs/a"),
        3: (None, "ä"),
    }
    target = tmp_path / "new" / "result.json"
    console.write_json(target, value)
    assert json.loads(target.read_text(encoding="utf-8")) == {
        "tensor": [1.0, None],
        "scalar": 2,
        "nan": None,
        "flag": True,
        "model": {"rate": 0.5},
        "interval": {"low": -1.0, "high": 1.5},
        "path": "runs/a",
        "3": [None, "ä"],
    }
    assert [path.name for path in target.parent.iterdir()] == ["result.json"]


def test_what_has_no_place_in_json_is_refused_and_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.write_text("{}")
    with pytest.raises(AttributeError, match="tolist"):
        console.write_json(target, {"x": object()})
    assert target.read_text() == "{}"


def test_an_error_is_one_line_without_markup(capsys: pytest.CaptureFixture[str]) -> None:
    console.error("field [bold]x[/bold] is wrong;\n   " + "mend it " * 30)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err == "error: field [bold]x[/bold] is wrong; " + ("mend it " * 30).strip() + "\n"


HOSTILE = "a\x1b]52;c;aGk=\x07\x9b2Jb\x7f\u202ec\u2028"
"""It would set the clipboard, clear the screen and write backwards."""


def test_no_control_character_of_a_text_reaches_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    console.say(HOSTILE)
    console.text(HOSTILE)
    console.note(HOSTILE)
    console.error(HOSTILE)
    console.table((HOSTILE, "n>"), [(HOSTILE, 1)], title=HOSTILE, caption=HOSTILE)
    console.write_json("-", {HOSTILE: HOSTILE})
    captured = capsys.readouterr()
    shown = captured.out + captured.err
    assert [c for c in shown if c != "\n" and not c.isprintable()] == []
    assert shown.count(r"a\x1b]52;c;aGk=") == 8
    console.say("\tä ± 1")
    assert "ä ± 1" in capsys.readouterr().out  # negative control: other characters stay


def shell(words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python code that has the console, in a shell that can send its output anywhere."""
    known = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment
    command = words.replace("PYTHON", f"{sys.executable} -c")
    return subprocess.run(["sh", "-c", command], env=known, capture_output=True, text=True, check=False)


def test_a_full_disk_behind_standard_error_ends_nothing() -> None:
    code = "from esp_cli import console; console.note('a'); console.note('b'); print('done')"
    done = shell(f'PYTHON "{code}" 2>/dev/full')
    assert (done.returncode, done.stdout) == (0, "done\n")
    done = shell(f'PYTHON "{code.replace("note", "say")}" >/dev/full')
    assert done.returncode != 0, "negative control: results have to be written"


def test_a_request_to_stop_counts_where_it_cannot_be_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(text: str) -> None:
        raise RuntimeError("reentrant call")

    monkeypatch.setattr("esp_cli.console.progress.note", busy)
    with stop_requests("stopping") as requests:
        signal.raise_signal(signal.SIGTERM)
    assert requests == [signal.SIGTERM]


def test_what_a_terminal_cannot_show_is_written_otherwise() -> None:
    code = "from esp_cli import console; console.fit_encoding(); console.table(('a','b>'), [('x', '1 ± 2')])"
    done = shell(f'PYTHON "{code}"', PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stderr) == (0, "")
    assert "1 ? 2" in done.stdout


def test_a_deleted_working_directory_is_one_sentence(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    done = shell(f"cd {gone} && rmdir {gone} && PYTHON 'from esp_cli.app import main; main()' tasks")
    assert done.returncode == 2
    assert done.stderr == "error: the working directory was deleted; change to another one (cd)\n"


def test_a_table_in_a_pipe_keeps_its_columns(capsys: pytest.CaptureFixture[str]) -> None:
    console.table(["policy", "mean>"], [["a" * 90, -122.5], ["random [x]", 3]], title="navigation", caption="esp")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].strip() == "navigation"
    assert any("a" * 90 in line and "-122.5" in line for line in lines)
    assert any("random [x]" in line and line.rstrip(" │").endswith("  3") for line in lines)


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0"), (950, "950"), (20_000, "20k"), (999_999, "1M"), (1_500_000, "1.5M"), (3e9, "3G"), (43_210, "43.2k")],
)
def test_counts(count: float, text: str) -> None:
    assert format_count(count) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (59.4, "59 s"), (59.7, "1 min 00 s"), (125, "2 min 05 s"), (3780, "1 h 03 min"), (math.inf, "?")],
)
def test_durations(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


def test_means_and_intervals() -> None:
    assert format_mean(-122.251, 1.618) == "-122.25 ± 1.62"
    assert format_mean(-122.251, math.nan) == "-122.25"
    assert format_mean(3.0) == "3.00"
    assert format_interval((-125.041, -119.958)) == "[-125.04, -119.96]"
    assert [format_span(counts) for counts in ([160, 32, 64], {10})] == ["32 to 160", "10"]


def test_names_of_folders_hold_words_in_ascii() -> None:
    texts = ["rot90, rot180", "mine._tasks:Task", "1.5M", "..", "é", ""]
    assert [file_name(text) for text in texts] == ["rot90-rot180", "mine-tasks-task", "1.5m", *["unnamed"] * 3]


class Clock:
    """A clock that the test turns."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_progress_in_a_pipe_is_a_line_every_ten_seconds_and_the_last(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    with TrainingProgress(total=100_000, num_seeds=10, start=20_000, clock=clock) as progress:
        for second in range(1, 25):
            clock.now_s = 100.0 + second
            progress.update(20_000 + 1000 * second, {"return": -130.0 - second})
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == [
        "train   21%  21k/100k  10k seed-steps/s  1 min 19 s left  return -131",
        "train   31%  31k/100k  10k seed-steps/s  1 min 09 s left  return -141",
        "train   41%  41k/100k  10k seed-steps/s  59 s left  return -151",
        "train   44%  44k/100k  10k seed-steps/s  56 s left  return -154",
    ]


def test_parts_of_another_kind_get_progress_of_their_own(capsys: pytest.CaptureFixture[str]) -> None:
    with console.watching("check", "elements") as watch:
        watch(1, 22, "steps")
        watch(22, 22, "steps")
        watch(3, 4)
    shown = [line.split()[:3] for line in capsys.readouterr().err.splitlines()]
    assert shown == [["check", "5%", "1/22"], ["check", "100%", "22/22"], ["check", "75%", "3/4"]]


def test_the_rate_forgets_what_is_half_a_minute_old() -> None:
    clock = Clock()
    with TrainingProgress(total=10**6, clock=clock) as progress:
        for second in range(1, 101):
            clock.now_s = 100.0 + second
            progress.update(10 * second if second <= 60 else 600 + 500 * (second - 60))
        assert progress.rate() == pytest.approx(500)


def test_progress_before_its_first_update_promises_nothing() -> None:
    with TrainingProgress(total=1000, clock=Clock()) as progress:
        assert progress.parts() == ["0/1k  0 steps/s  ? left"]
    with TrainingProgress(total=8, clock=Clock(), unit="elements") as progress:
        assert progress.parts() == ["0/8  0 elements/s  ? left"]


def test_work_goes_on_where_nobody_reads_its_notes_any_more() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    program = "from esp_cli import console\nfor k in range(3): console.note(f'note {k}')\nprint('done')"
    try:
        done = subprocess.run(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=writing, text=True, check=False
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stdout) == (0, "done\n")


def test_a_count_in_a_name_is_exact() -> None:
    assert [format_exactly(count) for count in (500_000, 1000, 1004, 1234)] == ["500k", "1k", "1004", "1234"]
