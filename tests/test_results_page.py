"""Every table of results in the documentation is what its committed file gives."""

import re
import runpy
from pathlib import Path

import pytest

from esp_cli.reporting.results import read_results, summarised
from esp_cli.reporting.study_figures import series_of
from esp_cli.reporting.tables import returns_table

DOCS = Path(__file__).parents[1] / "docs"
FILL = runpy.run_path(str(DOCS / "fill_tables.py"))
files_of, filled = FILL["files_of"], FILL["filled"]
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if "<!-- end of results -->" in page.read_text(encoding="utf-8")]
FILES = sorted({(page.parent / file).resolve() for page in PAGES for file in files_of(page)})
LARGEST_BYTES = 200_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tables_are_computed_from_the_committed_files(page: Path) -> None:
    assert filled(page) == page.read_text(encoding="utf-8"), (
        f"run: python docs/fill_tables.py docs/{page.relative_to(DOCS)}"
    )


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_a_file_is_small_and_says_what_made_it(file: Path) -> None:
    found = read_results(file)
    assert file.stat().st_size < LARGEST_BYTES
    assert found.command.startswith("esp ")
    for cell in found.cells:
        if cell.status != "finished":
            continue
        assert {**found.config, **cell.config}["task"]
        assert cell.esp_version
        assert all(len(values) == len(cell.seeds) for values in cell.returns.values())


def test_a_number_changed_by_hand_is_noticed(tmp_path: Path) -> None:
    page = DOCS / "measurements" / "parts.md"
    text = page.read_text(encoding="utf-8")
    results = read_results(DOCS / "measured" / "ablate-coefficient.json")
    number = next(cell for row in returns_table(summarised(results)).rows for cell in row if "±" in cell)
    assert number in text
    (tmp_path / "pages").mkdir()
    copy = tmp_path / "pages" / "parts.md"
    copy.write_text(text.replace(number, "-99.99 ± 0.01"), encoding="utf-8")
    (tmp_path / "measured").symlink_to(DOCS / "measured")
    assert filled(copy) == text


def beginning(text: str) -> tuple[str, str, str]:
    """Return title, first paragraph and what follows it of a page."""
    title, answer, after = text.split("\n\n", 3)[:3]
    return title, answer, after


@pytest.mark.parametrize("page", sorted((DOCS / "measurements").glob("[!i]*.md")), ids=lambda page: page.name)
def test_a_measurement_begins_with_its_question_its_answer_and_a_figure(page: Path) -> None:
    title, answer, after = beginning(page.read_text(encoding="utf-8"))
    assert title.startswith("# ")
    assert title.endswith("?")
    assert 8 <= len(answer.split()) <= 75, "one to three sentences"
    assert after.startswith("![")


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.name)
def test_a_figure_of_learning_curves_says_its_command(page: Path) -> None:
    assert silent_figures(page.read_text(encoding="utf-8")) == []


def silent_figures(text: str) -> list[str]:
    """Return the figures of learning curves that no command follows."""
    blocks = re.findall(r"((?:^!\[Learning curves.*\n)+)\n(.*)", text, re.MULTILINE)
    return [figures for figures, following in blocks if not following.startswith("Drawn by `esp ")]


def test_a_figure_without_its_command_is_noticed() -> None:
    figure = "![Learning curves of two](measured/two.png)\n"
    assert silent_figures(f"text\n\n{figure}\nDrawn by `esp report runs/two`.\n") == []
    assert silent_figures(f"text\n\n{figure}\n*Ten seeds.*\n") == [figure]


def test_every_figure_of_a_table_can_be_drawn_again_and_is_on_its_page() -> None:
    drawing = runpy.run_path(str(DOCS / "make_figures.py"))
    for name, panels in drawing["FIGURES"].items():
        for panel in panels:
            rows = drawing["table"](panel)
            assert len(rows) >= 2
            assert all(drawing["numbers"](row[panel.value]) for row in rows if row[panel.value])
            page = (DOCS / "measurements" / f"{panel.page}.md").read_text(encoding="utf-8")
            assert f"../measured/{name}.png" in page
        assert (DOCS / "measured" / f"{name}.png").is_file()


def test_every_figure_of_results_can_be_drawn_again_and_is_on_a_page() -> None:
    drawing = runpy.run_path(str(DOCS / "make_figures.py"))
    pages = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "measurements").glob("*.md"))
    for name, picture in drawing["RESULTS"].items():
        for cell in drawing["read_results"](DOCS / "measured" / f"{name}.json").cells:
            figure = f"{picture}-{cell.name.split('-')[1]}.png"
            assert f"../measured/{figure}" in pages
            assert (DOCS / "measured" / figure).is_file()


def test_every_figure_of_broken_symmetry_can_be_drawn_again_and_is_on_its_page() -> None:
    drawing = runpy.run_path(str(DOCS / "make_figures.py"))
    page = (DOCS / "measurements" / "breaking.md").read_text(encoding="utf-8")
    for picture, parts in drawing["BREAKING"].items():
        both = drawing["join"]([drawing["read_results"](DOCS / "measured" / f"{picture}{part}.json") for part in parts])
        for k, _ in enumerate(series_of(both), 1):
            assert f"(../measured/{picture}-{k}.png)" in page
            assert (DOCS / "measured" / f"{picture}-{k}.png").is_file()


def test_a_table_that_is_gone_is_noticed() -> None:
    drawing = runpy.run_path(str(DOCS / "make_figures.py"))
    with pytest.raises(ValueError, match="no table with the column 'gone'"):
        drawing["table"](drawing["Panel"]("replay", "run", ["run"], "gone", ""))


def test_the_figure_of_the_steps_is_on_its_page() -> None:
    page = (DOCS / "measurements" / "learners.md").read_text(encoding="utf-8")
    assert "(../measured/steps-saved.png)" in page
    assert (DOCS / "measured" / "steps-saved.png").is_file()
