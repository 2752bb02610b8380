"""The examples of docs/legged-robots.md give what the page says."""

from __future__ import annotations

import doctest
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"


def test_examples_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gymnasium")
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testfile(str(DOCS / "legged-robots.md"), module_relative=False, encoding="utf-8")
    assert tried >= 10
    assert failed == 0
