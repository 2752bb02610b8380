"""`esp export` and `esp policies`: what is asked for is written, and mistakes are told in a sentence."""

import json
import shutil
from pathlib import Path

import pytest

from esp_cli.export import c_file
from esp_cli.policies.bundled import MANIFEST, bundled_folder, read_bundled
from tests.cli.running import esp, refused


def test_the_best_seed_of_a_run_goes_out(finished: Path, tmp_path: Path) -> None:
    result = esp("export", finished, "-f", "numpy", "-f", "onnx", "-o", tmp_path / "out", "--episodes", 4)
    assert "is the best of 2 over 4 episodes each" in result.stderr
    assert "parameters: " in result.stderr
    for part in ("policy.py", "policy.onnx", "10000"):
        assert part in result.stdout
    files = {file.name for file in (tmp_path / "out").iterdir()}
    assert files == {"policy.py", "policy.onnx", "policy.json", "README.md"}
    assert json.loads((tmp_path / "out" / "policy.json").read_text())["policy"]["seed"] in (3, 7)


@pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")
def test_the_seed_that_is_named_goes_out(finished: Path, tmp_path: Path) -> None:
    result = esp("export", finished, "-f", "c", "-o", tmp_path, "--seed", 7, "--json", "-")
    written = json.loads(result.stdout)
    (only,) = written["formats"]
    assert (only["name"], only["agreement"]["observations"]) == ("c", 10_000)
    assert json.loads((tmp_path / "policy.json").read_text())["policy"]["seed"] == 7


def test_without_a_compiler_the_source_is_written_and_said_to_be_unchecked(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(c_file, "compiler", lambda: None)
    result = esp("export", finished, "-f", "c", "-o", tmp_path, "--seed", 7)
    assert "there is no C compiler cc here" in result.stderr
    assert "Not compared with the policy" in (tmp_path / "README.md").read_text()


def test_a_bundled_policy_is_used_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (entry,) = (e for e in read_bundled() if e.name == "navigation-mappo-esp")
    esp("render", entry.name, "-o", tmp_path / "n.png")
    assert (tmp_path / "n.png").stat().st_size
    said = refused("eval", "navigation", "--algo", "ppo")
    assert "no policy fits navigation --algo ppo; the bundled policies are navigation-" in said
    assert "has no policy of mine" in refused("policies", "mine")
    monkeypatch.setattr("esp_cli.policies.bundled.bundled_folder", lambda: tmp_path)
    (tmp_path / MANIFEST).write_text("{")
    assert "is not valid JSON" in refused("eval", "navigation")


def test_the_folder_that_comes_along_is_listed() -> None:
    listed = json.loads(esp("policies", "--json", "-").stdout)
    assert [item["name"] for item in listed] == [entry.name for entry in read_bundled()]
    shown = esp("policies").stdout
    assert all(entry.name in shown for entry in read_bundled())
    assert (bundled_folder() / MANIFEST).is_file()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["-f", "tflite"], "there is no format 'tflite'; the formats are onnx, torch, c, numpy"),
        (["-f", "c", "--seed", "4"], "has no seed 4; it has 3, 7"),
        (["-f", "c", "--algo", "mappo"], "--algo and --prior choose among a task's policies"),
    ],
)
def test_a_bad_option_is_told_in_one_sentence(finished, tmp_path, options, sentence):
    assert sentence in refused("export", finished, "-o", tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()


def test_what_is_there_is_kept_unless_forced(finished: Path, tmp_path: Path) -> None:
    arguments = ("export", finished, "-f", "numpy", "-o", tmp_path, "--seed", 3)
    esp(*arguments)
    before = (tmp_path / "policy.py").read_bytes()
    assert "has README.md, policy.json, policy.py already" in refused(*arguments)
    shutil.copy(tmp_path / "policy.py", tmp_path / "mine.py")
    (tmp_path / "policy.onnx").write_text("of another policy")
    (tmp_path / "policy.c").write_text("of the user")
    described = (tmp_path / "policy.json").read_text()
    (tmp_path / "policy.json").write_text(described.replace('"numpy"', '"numpy", "onnx"'))
    (tmp_path / "policy.py").write_text("")
    esp(*arguments, "--force")
    assert (tmp_path / "policy.py").read_bytes() == before
    assert (tmp_path / "mine.py").exists()
    assert not (tmp_path / "policy.onnx").exists()
    assert (tmp_path / "policy.c").read_text() == "of the user"
    (tmp_path / "policy.json").write_text("{")
    (tmp_path / "policy.onnx").write_text("of the user")
    esp(*arguments, "--force")
    assert (tmp_path / "policy.onnx").exists()


def test_episodes_that_choose_nothing_are_refused(finished: Path, tmp_path: Path) -> None:
    said = refused("export", finished, "-f", "numpy", "-o", tmp_path / "out", "--seed", 3, "--episodes", 4)
    assert "--episodes finds the best seed, and --seed names one" in said
