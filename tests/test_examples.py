"""The examples of the pages give what the pages say."""

import doctest
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.parametrize(
    ("page", "examples", "needs"),
    [
        ("environments.md", 15, "pettingzoo"),
        ("legged-robots.md", 10, "gymnasium"),
        ("library.md", 20, "torch"),
        ("symmetry.md", 8, "torch"),
    ],
)
def test_examples_of_the_page(page: str, examples: int, needs: str, tmp_path, monkeypatch) -> None:
    pytest.importorskip(needs)
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testfile(str(DOCS / page), module_relative=False, encoding="utf-8")
    assert tried >= examples
    assert failed == 0
