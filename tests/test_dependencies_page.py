"""docs/dependencies.md says what constraints.txt says, for every package that a user installs."""

import re
from datetime import date
from pathlib import Path

import pytest

tomllib = pytest.importorskip("tomllib", reason="the script that writes the page needs Python 3.11")
ROOT = Path(__file__).parents[1]
ROW = re.compile(r"^\| ([\w.-]+) \| ([^ |]+) \| (\d{4}-\d\d-\d\d) \|$", re.MULTILINE)
LOCK = """
[[packages]]
name = "numpy"
version = "VERSION"
sdist = { upload-time = 2026-01-03T00:00:00Z }
wheels = [{ upload-time = 2026-01-02T00:00:00Z }]
"""


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import make_dependencies

    return make_dependencies


def test_the_page_lists_the_pinned_versions_of_all_direct_dependencies(script) -> None:
    named, others = (ROW.findall(part) for part in script.PAGE.read_text(encoding="utf-8").split("## ")[1:])
    rows = named + others
    assert len(rows) > 30
    assert {(name, version) for name, version, _ in rows} <= script.pinned()
    assert {name for name, _, _ in named} == script.direct()
    assert all(date.fromisoformat(released) for _, _, released in rows)


def test_a_row_has_the_day_of_the_first_upload_and_other_versions_have_none(script) -> None:
    pinned = dict(script.pinned())["numpy"]
    page = script.page(tomllib.loads(LOCK.replace("VERSION", pinned)))
    assert ROW.findall(page) == [("numpy", pinned, "2026-01-02")]
    assert not ROW.findall(script.page(tomllib.loads(LOCK.replace("VERSION", "0.1"))))
