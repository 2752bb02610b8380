"""Tables of pages are computed from results files and from nothing else."""

from __future__ import annotations

import json
import os

import pytest

from esp_cli.reporting.collect import collect
from esp_cli.reporting.pages import files_of, filled
from tests.studies.small_studies import small_study, write_study

BLOCK = "<!-- results: measured/a.json {} -->\nstale\n<!-- end of results -->"


@pytest.fixture
def page(tmp_path):
    ends = {"MAPPO": [-150.0, -160.0, -140.0], "MAPPO-ESP": [-130.0, -120.0, -140.0]}
    found = collect(write_study(tmp_path / "s", small_study(), ends)).results.document()
    (tmp_path / "measured").mkdir()
    (tmp_path / "measured" / "a.json").write_text(json.dumps(found))
    page = tmp_path / "page.md"
    page.write_text(f"# Before\n\n{BLOCK.format('returns')}\n\nbetween\n\n{BLOCK.format('comparison')}\n\nafter\n")
    return page


def test_what_stands_between_the_marks_is_computed_and_the_rest_stays(page):
    text = filled(page)
    assert "stale" not in text
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in text
    assert text.startswith("# Before\n\n<!-- results: measured/a.json returns -->\n\n| ")
    assert "\n\nbetween\n\n" in text
    assert text.endswith("<!-- end of results -->\n\nafter\n")
    assert files_of(page) == ["measured/a.json"]


def test_an_indented_example_stays_as_it_is(page):
    example = "```\n  <!-- results: measured/no.json paper -->\n  <!-- end of results -->\n```\n"
    page.write_text(example + page.read_text())
    assert filled(page).startswith(example)
    assert files_of(page) == ["measured/a.json"]


def test_filling_twice_changes_nothing_and_a_changed_number_does(page):
    page.write_text(filled(page))
    assert filled(page) == page.read_text()
    file = page.parent / "measured" / "a.json"
    found = json.loads(file.read_text())
    found["cells"][0]["returns"]["greedy"][0] += 30
    file.write_text(json.dumps(found))
    assert filled(page) != page.read_text()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [("a.json returns", "a.json wishes", "asks for the table 'wishes'"), ("a.json", "b.json", "cannot read")],
)
def test_a_table_or_file_that_is_not_there_is_told(page, old, new, sentence):
    page.write_text(page.read_text().replace(old, new))
    with pytest.raises(ValueError, match=sentence):
        filled(page)
    with pytest.raises(ValueError, match="cannot read"):
        filled(page.with_name("no.md"))


def test_a_table_of_final_returns_takes_those_of_drawn_actions(page):
    file = page.parent / "measured" / "a.json"
    found = json.loads(file.read_text())
    for cell in found["cells"]:
        cell["returns"]["stochastic"] = [value - 7 for value in cell["returns"]["greedy"]]
    file.write_text(json.dumps(found))
    page.write_text(page.read_text().replace("comparison -->", "comparison stochastic -->"))
    greedy, _, drawn = filled(page).partition("between")
    assert "-150.00 ± 5.77" in greedy
    assert "of the greedy return" in greedy
    assert "| MAPPO | -157.00 ± 5.77 |" in drawn
    assert "Returns are those of drawn actions." in drawn
    page.write_text(page.read_text().replace("comparison stochastic", "steps stochastic"))
    with pytest.raises(ValueError, match="asks for 'steps stochastic'; returns, paper, comparison take a mode"):
        filled(page)


def longer(page, seeds=(0, 1), **change):
    """Write the results of a second study, of more steps and fewer seeds, beside those of the page."""
    study = small_study(steps=((None, 400),), seeds=seeds)
    found = collect(write_study(page.parent / "longer", study, {"MAPPO": [-110.0, -112.0]})).results.document() | change
    (page.parent / "measured" / "b.json").write_text(json.dumps(found))
    page.write_text("<!-- results: measured/a.json measured/b.json returns -->\n<!-- end of results -->\n")


def test_studies_of_one_kind_stand_in_one_table_and_fewer_seeds_are_told(page):
    longer(page)
    text = filled(page)
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in text
    assert "| navigation, 400 | -111.00 ± 1.00 (n = 2) | not run |" in text
    assert "over 2 to 3 seeds" in text
    assert files_of(page) == ["measured/a.json", "measured/b.json"]


def test_studies_that_do_not_go_together_are_refused(page):
    longer(page, kind="agents")
    with pytest.raises(ValueError, match="different kinds"):
        filled(page)
    page.write_text(page.read_text().replace("b.json", "a.json"))
    assert "| navigation, 200 | -150.00 ± 5.77 | -130.00 ± 5.77 |" in filled(page), "what is the same counts once"
    first, second = (page.parent / "measured" / name for name in ("a.json", "b.json"))
    second.write_text(first.read_text().replace("-130.0", "-131.0"))
    page.write_text(page.read_text().replace("a.json", "b.json", 1))
    with pytest.raises(ValueError, match="navigation-200-mappo-esp stands in two of the results files, with different"):
        filled(page)


def test_a_page_that_is_none_is_told_in_one_sentence(tmp_path):
    (tmp_path / "weights.md").write_bytes(b"\xf8\x00")
    with pytest.raises(ValueError, match=r"weights.md is no text in UTF-8"):
        filled(tmp_path / "weights.md")
    os.mkfifo(tmp_path / "pipe.md")
    with pytest.raises(ValueError, match=r"cannot read .*pipe.md: .*regular file"):
        filled(tmp_path / "pipe.md")
