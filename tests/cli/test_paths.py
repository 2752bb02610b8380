"""Places that nothing can be written to: one sentence, the documented exit code, and nothing destroyed."""

import stat
from pathlib import Path

import pytest
from typer.testing import CliRunner

from esp_cli.app import app


def told(*arguments: object) -> tuple[int, str]:
    """Run a command line in this process; return its exit code and what it says on standard error."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stderr


def test_a_null_device_takes_json_and_stays_a_device() -> None:
    assert told("tasks", "--json", "/dev/null")[0] == 0
    assert stat.S_ISCHR(Path("/dev/null").stat().st_mode)


def test_a_full_device_is_a_failure_of_the_machine() -> None:
    code, sentence = told("tasks", "navigation", "--json", "/dev/full")
    assert code == 1
    assert sentence.endswith("free some space and run the command again, or resume it\n")


@pytest.mark.parametrize("option", ["--out=", "--json=", "--results="])
def test_an_option_without_a_value_is_one_sentence(option: str) -> None:
    assert told("report", "runs/a", option) == (2, f"error: '{option}' is empty; write its value, or leave it out\n")


def test_a_link_given_to_json_is_followed_and_kept(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("target.json")
    assert told("tasks", "--json", tmp_path / "link")[0] == 0
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target.json").read_text().startswith("[")


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        ("", "is empty; write its value, or leave it out"),
        (".", "is a folder; name a file in it"),
        ("x" * 300, "file name too long"),
        ("a" * 200 + "/" + "b" * 300, "file name too long"),
        ("loop", "too many levels of symbolic links"),
        ("loop/a", "file exists|too many levels of symbolic links"),
        ("file/a", "not a directory|file exists"),
        ("/proc/no/such", "no such file or directory"),
    ],
)
@pytest.mark.parametrize(
    "command", [("tasks", "navigation", "--json"), ("eval", "navigation-mappo-esp", "-e", "2", "--json")]
)
def test_a_place_that_cannot_be_is_one_sentence(tmp_path, monkeypatch, command, place, reason):
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    Path("file").write_text("mine")
    code, sentence = told(*command, place)
    assert code == 2
    assert sentence.startswith("error: ")
    assert sentence.count("\n") == 1
    assert any(part in sentence for part in reason.split("|")), sentence
    assert Path("file").read_text() == "mine"


@pytest.mark.parametrize("place", ["", "loop", "x" * 300, "file", "file/a", "/proc/no/such"])
@pytest.mark.parametrize(
    "command",
    [
        ("train", "--steps", "100", "--out"),
        ("train", "--resume"),
        ("eval",),
        ("report",),
        ("reproduce", "table1", "--task", "navigation", "--algo", "mappo", "--out"),
        ("export", "navigation", "-f", "numpy", "-o"),
    ],
    ids=" ".join,
)
def test_a_run_a_study_or_a_policy_that_cannot_be_there_is_one_sentence(tmp_path, monkeypatch, command, place):
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    Path("file").write_text("mine")
    code, sentence = told(*command, place)
    assert code == 2
    assert sentence.splitlines()[-1].startswith("error: ")
    assert Path("file").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--threshold", "nan"), "--threshold nan is not a finite number"),
        (("--threshold", "inf"), "--threshold inf is not a finite number"),
        (("--at", "1e30"), "more than the 1e+12 steps that can be asked for"),
    ],
)
def test_numbers_that_say_nothing_are_refused_before_a_run_is_read(options: tuple[str, ...], sentence: str) -> None:
    code, said = told("report", "no-run", *options)
    assert code == 2
    assert sentence in said


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--steps", "1e30"), "more than the 1e+12 steps"),
        (("--set", "mappo.num_envs=1000000000"), "GB of memory"),
        (("--set", "mappo.num_envs=" + "[" * 20_000), "has a value that is not JSON"),
    ],
)
def test_settings_beyond_every_bound_are_refused_before_a_run_is_made(tmp_path, options, sentence):
    code, said = told("train", "--out", tmp_path / "run", *options)
    assert code == 2
    assert sentence in said
    assert not (tmp_path / "run").exists()
