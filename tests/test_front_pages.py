"""The README and what it shows: short, its snippet runs, and every number is that of a file."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest

from esp_cli.files.formatting import format_count, format_interval
from esp_cli.policies.statistics import median_steps
from esp_cli.reporting.results import CellResult, read_results, summarised

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
HOME, GALLERY = ((DOCS / name).read_text(encoding="utf-8") for name in ("index.md", "gallery.md"))
_BLOCK, _HTML, _TARGET = "```.*?```", "<[^>]*>", r"\]\([^)]*\)"


def prose(text: str) -> str:
    """Return a page without code, tags and addresses."""
    return re.sub(f"{_BLOCK}|{_HTML}|{_TARGET}|`[^`]*`", " ", text, flags=re.DOTALL)


def numbers(text: str) -> list[str]:
    """Return the numbers of a page, without those in names and code."""
    return re.findall(r"(?<![\w.-])-?\d[\d.]*[kM]?(?!\w)", prose(text))


def cells(file: str, panel: str) -> dict[str, CellResult]:
    """Return the runs of a panel of a results file, with their statistics."""
    found = summarised(read_results(DOCS / "measured" / file)).cells
    return {cell.variant: cell for cell in found if cell.panel == panel}


def test_the_readme_is_short_and_begins_with_few_numbers() -> None:
    assert len(re.sub(f"{_BLOCK}|{_HTML}", "", README, flags=re.DOTALL).split()) <= 450
    assert 2 <= len(numbers(README.split("\n---\n")[0])) <= 5
    assert all((ROOT / source).is_file() for source in re.findall(r'src="([^"]*)"', README))
    assert numbers("MAPPO `-3` has [1.5](x7.md) and -2 after 50k steps") == ["1.5", "-2", "50k"]


def test_the_snippet_of_the_readme_runs_as_it_stands(tmp_path: Path) -> None:
    (snippet,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    (tmp_path / "snippet.py").write_text(snippet, encoding="utf-8")
    assert float(runpy.run_path(str(tmp_path / "snippet.py"))["loss"].detach()) > 0


def test_the_pictures_of_the_demo_are_those_of_its_numbers() -> None:
    shown = json.loads((DOCS / "pictures" / "demo.json").read_text(encoding="utf-8"))
    digest = runpy.run_path(str(DOCS / "make_demo.py"))["digest"]
    assert {name: digest(DOCS / "pictures" / name) for name in shown["sha256"]} == shown["sha256"]


@pytest.mark.parametrize("page", [README, HOME], ids=["README", "home"])
def test_the_caption_of_the_demo_states_its_returns(page: str) -> None:
    runs = cells("demo.json", "predator-prey, 50k")
    ours, plain = runs["MAPPO with symmetry"], runs["MAPPO"]
    means = [f"{one.summary.returns.mean:.1f}" for one in (ours, plain)]
    assert ours.summary.gap.ahead == "ahead"
    told = f"After 50k steps its greedy return is {means[0]} with symmetry and {means[1]} without."
    assert told in " ".join(page.split())


def test_the_caption_of_the_film_states_its_returns() -> None:
    film = json.loads((DOCS / "pictures" / "demo.json").read_text(encoding="utf-8"))["film"]
    told = f"return {film['MAPPO with symmetry']} with symmetry and {film['MAPPO']} without"
    assert film["MAPPO with symmetry"] > 2 * film["MAPPO"]
    assert told in " ".join(GALLERY.split())


def test_steps_are_those_at_which_both_first_have_a_return_and_the_tuned_gain_has_its_interval() -> None:
    text, runs = " ".join(README.split()), cells("table1.json", "navigation, 500k")
    (ours,), (plain,) = runs["MAPPO-ESP"].steps_to, runs["MAPPO"].steps_to
    assert ours.threshold == plain.threshold
    medians = [format_count(round(median_steps(one.per_seed)[0], -4)) for one in (ours, plain)]
    assert f"first reaches {ours.threshold:.1f} after {medians[0]} steps with symmetry and {medians[1]} without" in text
    tuned = cells("tuned-navigation-mappo.json", "navigation, MAPPO, 500k")
    by_kind = {name.split(" (")[0]: cell.summary.returns for name, cell in tuned.items()}
    gain = by_kind["ESP, tuned"].mean - by_kind["plain, tuned"].mean
    (interval,) = re.findall(r"it is ([\d.]+) \[([\d.]+), ([\d.]+)\] ahead after 500k", text)
    assert float(interval[0]) == pytest.approx(gain, abs=0.05)
    gap = next(cell.summary.gap for name, cell in tuned.items() if name.startswith("ESP, tuned"))
    assert format_interval(gap.difference.ci95) == "[5.68, 7.03]"
    assert interval[1:] == ("5.7", "7.0")


def test_the_learners_of_the_notebook_end_as_its_text_says() -> None:
    book = json.loads((DOCS / "tutorial.ipynb").read_text(encoding="utf-8"))
    shown = "".join(text for cell in book["cells"] for one in cell.get("outputs", []) for text in one.get("text", []))
    plain, ours = (float(re.search(rf"{name} +([\d.]+) ±", shown)[1]) for name in ("plain", "ESP"))
    assert ours > 2 * plain, "far ahead"
    assert "far ahead" in str(book["cells"])


def test_each_part_of_the_prior_is_ahead_in_the_first_study() -> None:
    runs = cells("first-study.json", "predator-prey, MAPPO, 50k")
    assert {name: cell.summary.gap.ahead for name, cell in runs.items() if name != "none"} == {
        "loss": "ahead",
        "augmentation": "ahead",
        "both": "ahead",
    }
