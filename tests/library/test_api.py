"""The public API is documented, its page holds all of it, and its signatures change with the changelog."""

import inspect
import json
import runpy
from pathlib import Path
from typing import Any

import pytest

import esp_cli

ROOT = Path(__file__).parents[2]
MAKER = runpy.run_path(str(ROOT / "docs" / "make_api.py"))


def complaints(held: dict[str, Any], found: dict[str, str], changelog: str) -> list[str]:
    wrong = [
        f"{name} changed"
        for name in held["signatures"].keys() | found
        if held["signatures"].get(name) != found.get(name)
    ]
    lines = [change["line"] for change in held["changes"]]
    if held["changes"][-1]["digest"] != MAKER["digest"](found):
        wrong.append("the last change on file is not that of these signatures; run python docs/make_api.py")
    wrong += [f"the changelog does not say: {line}" for line in lines if line not in changelog.splitlines()]
    if len(set(lines)) < len(lines):
        wrong.append("each change needs a line of its own in the changelog")
    return sorted(wrong)


def held() -> dict[str, Any]:
    return json.loads((ROOT / "tests" / "library" / "signatures.json").read_text(encoding="utf-8"))


CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_signatures_change_with_a_line_in_the_changelog() -> None:
    assert complaints(held(), MAKER["signatures"](), CHANGELOG) == []


def test_a_changed_signature_is_noticed_until_the_changelog_says_so() -> None:
    changed = {**MAKER["signatures"](), "train": "(nothing)"}
    silent = held()
    assert "train changed" in complaints(silent, changed, CHANGELOG)
    silent["signatures"] = changed
    assert any("run python docs/make_api.py" in text for text in complaints(silent, changed, CHANGELOG))
    again = {"digest": MAKER["digest"](changed), "line": silent["changes"][-1]["line"]}
    silent["changes"].append(again)
    assert complaints(silent, changed, CHANGELOG) == ["each change needs a line of its own in the changelog"]
    again["line"] = "- `train` takes nothing"
    assert complaints(silent, changed, CHANGELOG) == ["the changelog does not say: - `train` takes nothing"]
    assert complaints(silent, changed, CHANGELOG + "\n- `train` takes nothing\n") == []


def test_the_page_holds_all_that_is_public() -> None:
    page = MAKER["page"]()
    for name, member in MAKER["members"]():
        assert f"# {name}\n" in page or f"\n`{name}`: " in page, name
        first = (inspect.getdoc(member) or "").splitlines()[0]
        assert first in page.replace("\\[", "["), name


@pytest.mark.parametrize("name", [name for name in esp_cli.__all__ if not name.startswith("__")])
def test_every_public_name_is_found_and_documented(name: str) -> None:
    thing = getattr(esp_cli, name)
    assert name in dir(esp_cli)
    assert (inspect.getdoc(thing) or "").endswith((".", ")", "`"))
    for own, member in MAKER["members"]():
        if own.startswith(name + "."):
            assert inspect.getdoc(member), own
