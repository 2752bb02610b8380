"""Every table of results in the documentation is what its committed file gives."""

from __future__ import annotations

from pathlib import Path

import pytest

from esp_cli.reporting.pages import files_of, filled
from esp_cli.reporting.results import read_results
from esp_cli.reporting.tables import TABLES

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [page for page in sorted(DOCS.rglob("*.md")) if files_of(page)]
FILES = sorted({page.parent / file for page in PAGES for file in files_of(page)})
LARGEST_BYTES = 200_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_tables_are_computed_from_the_committed_files(page: Path) -> None:
    assert filled(page) == page.read_text(encoding="utf-8"), f"run: esp report --fill docs/{page.relative_to(DOCS)}"


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


def test_the_results_page_is_among_them() -> None:
    assert DOCS / "results.md" in PAGES


def test_a_number_changed_by_hand_is_noticed(tmp_path: Path) -> None:
    page = DOCS / "results.md"
    text = page.read_text(encoding="utf-8")
    number = next(cell for row in TABLES["returns"](read_results(FILES[0])).rows for cell in row if "±" in cell)
    assert number in text
    copy = tmp_path / "results.md"
    copy.write_text(text.replace(number, "-99.99 ± 0.01"), encoding="utf-8")
    (tmp_path / "measured").symlink_to(DOCS / "measured")
    assert filled(copy) == text
