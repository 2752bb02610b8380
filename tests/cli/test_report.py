"""`esp report`: runs side by side."""

import json
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from esp_cli.files.formatting import format_mean
from esp_cli.policies.statistics import mean_and_sem
from esp_cli.studies.plan import STUDY_FORMAT
from esp_cli.training.checkpoint import load_checkpoint, save_checkpoint
from tests.cli.running import DAMAGE, esp, refused, train_tiny


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train_tiny(tmp_path_factory.mktemp("runs") / "plain", "--seed-list", "3,7", "--prior", "none")


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("│").split("│")]


def test_two_runs_are_held_against_each_other(finished: Path, plain: Path, tmp_path: Path) -> None:
    file, picture = tmp_path / "report.json", tmp_path / "curves.png"
    options = ["--full", "--at", "100", "--at", "150", "--threshold", "-1000", "--threshold", "-0.5"]
    told = esp("report", plain, f"ESP={finished}", *options, "--json", file, "--plot", picture)
    result = json.loads(file.read_text())
    assert (result["format"], result["kind"], result["config"]["task"]) == ("esp-results", "runs", "navigation")
    found = {(cell["variant"], cell["at"]): cell for cell in result["cells"]}
    assert list(found) == [(label, step) for step in (100, 150) for label in ("plain", "ESP")]
    first, second = found["plain", 150], found["ESP", 150]
    assert (first["task_version"], first["episodes"]) == (1, 2)
    assert first["seeds"] == second["seeds"] == [3, 7]
    assert (first["config"]["prior.kind"], second["config"]["prior.kind"]) == ("none", "esp")
    for step in (100, 150):
        plain_at, esp_at = found["plain", step]["summary"], found["ESP", step]["summary"]
        assert "gap" not in plain_at
        assert esp_at["gap"]["paired"] is True
        gained = esp_at["returns"]["mean"] - plain_at["returns"]["mean"]
        assert esp_at["gap"]["difference"]["value"] == pytest.approx(gained)
    assert first["steps_to"] == [
        {"threshold": -1000.0, "of_mean": 0, "per_seed": [0, 0]},
        {"threshold": -0.5, "of_mean": None, "per_seed": [None, None]},
    ]
    table = [cells(line) for line in told.stdout.splitlines() if line.startswith("│")]
    panels = ["navigation, 100", "navigation, 150"]
    compared = [row for row in table if row[0] in panels and row[2] == "150"]
    assert [row[:2] for row in compared] == [[panel, label] for panel in panels for label in ("plain", "ESP")]
    assert [row[5] for row in compared[::2]] == ["", ""]
    assert compared[3][5].startswith(f"{second['summary']['gap']['difference']['value']:+.2f} [")
    assert [row[6] for row in compared[1::2]] == ["-", "-"], "two seeds do not rank"
    assert (first["step"], second["step"]) == (150, 150)
    passed = [row[1:] for row in table if {"-1000.00", "-0.50"} & {*row}]
    assert passed == [
        [label, *texts, "" if label == "plain" else "-"]
        for label in ("plain", "ESP")
        for texts in (["-1000.00", "0", "0", "-", "0.00"], ["-0.50", "> 150", "> 150", "-", "-"])
    ]
    assert first["convention"] in told.stdout
    with Image.open(picture) as image:
        assert image.format == "PNG"
    drawing = picture.with_suffix(".svg").read_text()
    assert all(text in drawing for text in ("<svg", "ESP", "plain"))
    assert f"curves -> {picture}" in told.stderr


def test_json_on_standard_output_is_alone_there_and_the_last_common_step_is_the_default(finished, plain, tmp_path):
    short = train_tiny(tmp_path / "short", "--seed-list", "3,7", steps=100)
    result = json.loads(esp("report", finished, short, plain, "--json", "-").stdout)
    assert [(cell["at"], cell["step"]) for cell in result["cells"]] == [(100, 150), (100, 100), (100, 150)]


def test_page_markdown_results_and_terminal_compare_at_the_same_step(finished, plain, tmp_path):
    short = train_tiny(tmp_path / "a b", "--seed-list", "3,7", "--prior", "none", steps=100)
    out, small = tmp_path / "the page", tmp_path / "results.json"
    told = esp("report", f"short={short}", f"ESP={finished}", "--out", out, "--results", small)
    page, markdown = (out / "report.html").read_text(), (out / "report.md").read_text()
    cell = json.loads(small.read_text())["cells"][1]
    assert (cell["step"], cell["at"], cell["panel"]) == (150, 100, "navigation, 100")
    shown = format_mean(*mean_and_sem(cell["returns"]["greedy"]))
    longer = json.loads(esp("report", finished, "--json", "-").stdout)["cells"][0]["summary"]["returns"]
    assert shown != format_mean(longer["mean"], longer["sem"])
    for text in (told.stdout, page, markdown):
        assert shown in text
        assert "navigation, 100" in text
    assert f"| navigation, 100 | ESP | 150 | {shown} |" in markdown
    command = shlex.join(
        ["esp", "report", f"short={short}", f"ESP={finished}", "--out", str(out), "--results", str(small)]
    )
    assert f"```sh\n{command}\n```" in markdown
    assert "'" in command, "a path with a space is quoted"
    at = esp("report", f"short={short}", f"ESP={finished}", "--at", "100", "--mode", "stochastic", "--out", out)
    assert "navigation, 100" in at.stdout
    assert "--at 100 --mode stochastic --out " in (out / "report.md").read_text()


def test_figures_for_papers_are_a_column_wide_with_embedded_letters(finished, plain, tmp_path):
    told = esp("report", plain, finished, "--style", "paper", "--out", tmp_path / "out", "--plot", tmp_path / "c.pdf")
    assert f"curves -> {tmp_path / 'c.pdf'}" in told.stderr
    for pdf in ((tmp_path / "c.pdf").read_bytes(), (tmp_path / "out" / "curves.pdf").read_bytes()):
        (width,) = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ", pdf)
        assert float(width) == 3.5 * 72
        assert b"/FontFile2" in pdf
        assert b"/Type3" not in pdf
    esp("report", plain, finished, "--plot", tmp_path / "screen.png")
    assert not (tmp_path / "screen.pdf").exists()


def test_two_runs_of_one_label_are_refused(finished: Path, tmp_path: Path) -> None:
    assert "two runs are called 'a'; give each a label of its own" in refused(
        "report", f"a={finished}", f"a={finished}", "--out", tmp_path / "page"
    )
    assert not (tmp_path / "page").exists()


def test_one_seed_and_a_step_not_reached_are_dashes(tmp_path: Path, finished: Path) -> None:
    one = train_tiny(tmp_path / "one", "--seed-list", "3", steps=100)
    told = esp("report", "--full", one, finished, "--at", "100", "--at", "150", "--json", tmp_path / "report.json")
    rows = [cells(line) for line in told.stdout.splitlines() if line.startswith("│ navigation, ")]
    assert rows[0][:3] == ["navigation, 100", "one", "100"]
    assert "±" not in rows[0][3]
    assert rows[0][4] == "-"
    assert rows[2] == ["navigation, 150", "one", "100", "at 100", "-", "-", "-", "-", "-"]
    assert ["runs finished", "2 of 2"] in [cells(line) for line in told.stdout.splitlines()], "not of four columns"
    one, _, ahead = json.loads((tmp_path / "report.json").read_text())["cells"][:3]
    assert (one["summary"]["returns"]["sem"], one["summary"]["returns"]["ci95"]) == (None, None)
    assert "summary" not in ahead, "it did not get there"
    second = json.loads((tmp_path / "report.json").read_text())["cells"][1]
    assert second["summary"]["gap"]["paired"] is False, "other seeds"


def test_options_of_what_is_not_written_are_refused(finished: Path) -> None:
    assert "add --out FOLDER" in refused("report", finished, "--films")
    assert "--style is of the figures that --out or --plot writes" in refused("report", finished, "--style", "paper")


def test_a_folder_may_have_an_equals_sign_in_its_name(finished: Path, copied: Path) -> None:
    renamed = copied.rename(copied.with_name("rate=1e-3"))
    for argument, label in ((renamed, "rate=1e-3"), (f"new={renamed}", "new"), (f"c=0.5={renamed}", "c=0.5")):
        result = json.loads(esp("report", argument, "--json", "-").stdout)
        assert result["cells"][0]["variant"] == label


@pytest.mark.parametrize("option", ["--json", "--results"])
def test_what_a_run_or_a_study_needs_is_not_overwritten_by_a_report(copied: Path, tmp_path: Path, option: str) -> None:
    study = tmp_path / "study"
    study.mkdir()
    STUDY_FORMAT.write(study / "study.json", {})
    (tmp_path / "link.csv").symlink_to(copied / "metrics.jsonl")
    needed = [copied / "config.json", copied / "metrics.jsonl", copied / "policy.safetensors"]
    for file in (*needed, study / "study.json", tmp_path / "link.csv"):
        before = file.read_bytes()
        assert f"{file} belongs to the run or study in" in refused("report", copied, option, file)
        assert file.read_bytes() == before
    for file in (copied / "final-evaluation.json", copied / "checkpoints" / "new" / "table.csv"):
        esp("eval", copied, "--episodes", "4", "--json", copied / "final-evaluation.json")
        assert f"{file} belongs to the run or study in {copied};" in refused("report", copied, option, file)
    (copied / "policy.safetensors").unlink()
    assert "belongs to the run" in refused("report", copied, option, copied / "policy.safetensors"), "it is to come"
    for file in (copied / "all.csv", tmp_path / "config.json"):
        file.touch()
        esp("report", copied, option, file)
        assert file.stat().st_size > 0, "a name of the user's own, and a name that is taken in no such folder"


def test_runs_of_two_versions_of_a_task_are_refused_and_a_run_states_its_own(finished: Path, copied: Path) -> None:
    policy = DAMAGE["a policy of another version"][0](copied)
    assert "were trained on versions 0 and 1 of navigation" in refused("report", finished, copied)
    assert json.loads(esp("report", copied, "--json", "-").stdout)["cells"][0]["task_version"] == 0
    policy.unlink()
    checkpoint = next((copied / "checkpoints").iterdir())
    tensors, meta = load_checkpoint(checkpoint)
    save_checkpoint(checkpoint, tensors, meta | {"task_version": 2})
    assert "were trained on versions 1 and 2 of navigation" in refused("report", finished, copied)
