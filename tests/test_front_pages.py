"""The README and what it shows: short, its snippet runs, and every number is that of a file."""

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


def worded(text: str) -> str:
    """Return a page on one line, its links as their words alone."""
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", " ".join(text.split()))


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
    ours, without = runs["MAPPO with symmetry"], runs["MAPPO"]
    means = [f"{one.summary.returns.mean:.1f}" for one in (ours, without)]
    assert ours.summary.gap.ahead == "ahead"
    told = f"After 50k steps its greedy return is {means[0]} with symmetry and {means[1]} without."
    assert told in worded(page)


def test_the_caption_of_the_film_states_its_returns() -> None:
    film = json.loads((DOCS / "pictures" / "demo.json").read_text(encoding="utf-8"))["film"]
    told = f"return {film['MAPPO with symmetry']} with symmetry and {film['MAPPO']} without"
    assert film["MAPPO with symmetry"] > 2 * film["MAPPO"]
    assert told in worded(GALLERY)


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


EXPORT, LIBRARY, READING = "docs/export.md", "docs/library.md", 200
QUESTIONS = [
    # a researcher of multi-agent learning
    ("What does the prior gain?", (), "83.7 with symmetry and 15.6 without"),
    ("Which task is simple_spread?", (), "`simple_spread` is `navigation` here"),
    ("Which return is good?", ("docs/measurements/index.md", "#how-to-read-the-numbers"), "0 is the random policy"),
    ("Is it ahead of BenchMARL?", ("docs/measurements/peers.md",), "BenchMARL's -22.1 ± 1.0"),
    ("How does a run reach wandb?", ("docs/index.md", "configuration.md#trackers"), "`WANDB_MODE=online`"),
    # a roboticist
    ("Has a real robot driven?", (EXPORT, "#on-robots"), "Untested on hardware"),
    ("Has my robot a mirror?", ("docs/legged-robots.md",), "esp mirror robot.xml"),
    ("Does a policy fit a microcontroller?", (EXPORT, "#on-a-microcontroller"), "about 1 kB beside the weights"),
    ("What if the tracker fails?", (EXPORT, "#from-poses-to-wheel-speeds"), "poses are older than 0.5 s"),
    ("How do I declare a lidar?", (LIBRARY,), "a lidar `Kind.RING`"),
    # the owner of a task or of a loop
    ("How do I bring a PettingZoo task?", ("docs/adapters.md",), "class Spread(ParallelTask)"),
    ("Is what I declared true?", (LIBRARY, "#check-what-you-said"), "shows in transitions"),
    ("What may my policy return?", (LIBRARY, "#add-consistency-to-a-loss"), "`OneHotCategorical`, or logits"),
    ("How do I use it in TorchRL?", (LIBRARY, "#torchrl"), "`SymmetricLoss` goes around"),
    ("What about a replay?", (LIBRARY, "#a-replay"), "the next observation and the reward by the same element"),
]


def read_first(page: Path, anchor: str) -> str:
    text = page.read_text(encoding="utf-8")
    for heading in re.finditer(r"^#+ (.+)$", text, re.MULTILINE) if anchor else ():
        if re.sub(r"[^\w\- ]", "", heading[1].lower()).replace(" ", "-") == anchor:
            text = text[heading.start() :]
            break
    words = list(re.finditer(r"\S*\w\S*", text))[:READING]
    return " ".join(text[: words[-1].end()].split())


def reached(links: tuple[str, ...]) -> str:
    """Follow links from the README on, each among what is read of the page before; return what is read of the last."""
    page, text = ROOT / "README.md", " ".join(README.split())
    for link in links:
        assert f"]({link})" in text, f"no link to {link} at the beginning of {page}"
        path, _, anchor = link.partition("#")
        page = page.parent / path if path else page
        text = read_first(page, anchor)
    return text


@pytest.mark.parametrize(("question", "links", "answer"), QUESTIONS, ids=[one[0] for one in QUESTIONS])
def test_a_question_is_answered_within_two_links_and_200_words(question, links, answer):
    assert len(links) <= 2
    assert answer in reached(links)


def test_a_lost_link_and_an_answer_far_down_a_page_are_found() -> None:
    with pytest.raises(AssertionError, match=r"no link to gone\.md"):
        reached((LIBRARY, "gone.md"))
    assert "SymmetricLoss" in (ROOT / LIBRARY).read_text(encoding="utf-8")
    assert "SymmetricLoss" not in reached((LIBRARY,))
