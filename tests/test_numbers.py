"""Every decimal of README.md and docs/ that reports a measurement is on record.

A number is looked up where its section (from one `##` to the next) points: in the JSON files that the section links,
in its tables, which `docs/fill_tables.py` computes from files, and in the tables and files of a page that its own
paragraph links. What stands before the first `##` sums up: it may draw on the files and tables of the whole page.
Pages of rules and settings may also state a constant of the source code. Code counts as no statement.
"""

import ast
import json
import random
import re
import runpy
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from math import isfinite
from pathlib import Path
from statistics import mean, median, stdev
from typing import Any

import pytest

from tests.test_docs import anchors

ROOT = Path(__file__).parents[1]
MADE = ("atlas.md", "robot-models.md", "dependencies.md")
"""Pages that a command writes."""
PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.name not in MADE)]
OF_RULES = [page for page in PAGES if page.parent.name == "docs" and page.name not in ("index.md", "gallery.md")]
BLOCK = re.compile(r"<!-- (?:results|scores): .*?<!-- end of results -->", re.DOTALL)
FENCE = re.compile(r"^ *(```|~~~).*?^ *\1", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"`[^`\n]*`")
LINK = re.compile(r"\]\(([^)\s]+)\)")
NAME = re.compile(r"(?:Python|TorchRL below|mjlab|Sec\.) \d+\.\d+|\d{4}\.\d{5}|\d+\.\d+\.\d+")
NUMBER = re.compile(r"(?<![\w.])-?(\d+\.(\d+))( ?%|[kM]\b| million\b|(?!\.?\w))")
SCALES = {"": 1.0, "%": 100.0, "k": 1e-3, "M": 1e-6, "million": 1e-6}
SETTINGS = {"config", "task_settings", "seeds", "weights"}
MOST_ROWS = 50
"""Of a list of cases; a longer one is raw data, of which a summary has to be on record."""

Number = tuple[str, float, float, float]


def stated(text: str) -> Iterator[Number]:
    """Yield each decimal as written, its size, half a unit of its last place, and its scale."""
    for match in NUMBER.finditer(text):
        yield match[0], float(match[1]), 0.5 * 10.0 ** -len(match[2]), SCALES[match[3].strip()]


def is_in(number: Number, pool: list[float]) -> bool:
    """Return whether one of the sorted numbers is, rounded, the one that is stated."""
    _, size, half, scale = number
    least, most = ((size + sign * half * (1 + 1e-6)) / scale for sign in (-1, 1))
    place = bisect_left(pool, least)
    return place < len(pool) and pool[place] <= most


def summary(values: list[float]) -> set[float]:
    error = {stdev(values) / len(values) ** 0.5} if len(values) > 1 else set()
    return {mean(values), median(values), min(values), max(values)} | error


@cache
def recorded(file: Path) -> frozenset[float]:
    """Return the sizes of the numbers of a JSON file; lists of more than three give what sums them up.

    Of curves, {name: rows}, the ends count, over the names that differ in a number at their end, the seed. Greedy
    returns beside those of reference policies also count from 0, the random one, to 1, the one written by hand.
    """
    found = set[float]()

    def read(value: Any) -> None:
        if isinstance(value, dict):
            curves = {key: rows for key, rows in value.items() if is_curve(rows)}
            for key in value.keys() - curves.keys() - SETTINGS:
                read(value[key])
            groups = defaultdict[str, list[list[float]]](list)
            for key, rows in curves.items():
                groups[key.rstrip("0123456789")].append(end_of(rows))
            for ends in groups.values():
                found.update(number for column in zip(*ends, strict=True) for number in summary(list(column)))
            of_study = value["returns"] if isinstance(value.get("returns"), dict) else value
            scores, anchors = of_study.get("greedy"), value.get("anchors") or {}
            if scores and "heuristic" in anchors:
                low, span = anchors["random"], anchors["heuristic"] - anchors["random"]
                seeds = scores["per_seed"] if isinstance(scores, dict) else scores
                found.update(summary([(score - low) / span for score in seeds]))
        elif isinstance(value, list):
            numbers = [one for one in value if isinstance(one, int | float)]
            if numbers and len(numbers) == len(value):
                found.update(summary([one for one in numbers if isfinite(one)] or [0.0]))
                found.update(numbers if len(numbers) <= 3 else ())
            elif len(value) <= MOST_ROWS:
                for inner in value:
                    read(inner)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.add(value)

    read(json.loads(file.read_text(encoding="utf-8")))
    return frozenset(map(abs, found))


def is_curve(rows: Any) -> bool:
    return isinstance(rows, list) and len(rows) > 3 and all(isinstance(row, list) and len(row) == 3 for row in rows)


def end_of(rows: list[list[float]]) -> list[float]:
    """Return the last row of steps and two numbers, and the means of those over the last 6000 steps."""
    late = [row for row in rows if row[0] > rows[-1][0] - 6000]
    return rows[-1] + [mean(row[k] for row in late) for k in (1, 2)]


@cache
def constants() -> frozenset[float]:
    sources = [file for folder in ("esp_cli", "environments") for file in (ROOT / folder).rglob("*.py")]
    nodes = (node for file in sources for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))))
    return frozenset(node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, float))


def links(text: str) -> list[str]:
    return LINK.findall(CODE.sub("", FENCE.sub("", text)))


def tables(text: str) -> set[float]:
    return {size for block in BLOCK.findall(text) for _, size, _, _ in stated(block)}


def files(page: Path, text: str) -> set[float]:
    """Return the numbers of the JSON files that a text links."""
    linked = {page.parent / link for link in links(text) if link.endswith(".json")}
    return {number for file in linked if file.is_file() for number in recorded(file)}


def pages(page: Path, paragraph: str) -> set[float]:
    """Return the numbers of the tables and files of the other pages, or sections of pages, that a paragraph links."""
    found = set[float]()
    for link in links(paragraph):
        path, _, anchor = link.partition("#")
        target = page.parent / path
        if path.endswith(".md") and target.is_file() and target.name not in MADE:
            text = target.read_text(encoding="utf-8")
            parts = re.split(r"^(?=#{1,6} )", text, flags=re.MULTILINE)
            part = next((one for one in parts if anchor in anchors(one)), text) if anchor else text
            found |= tables(part) | files(target, part)
    return found


def paragraphs(page: Path, text: str) -> Iterator[tuple[str, list[float]]]:
    """Yield each paragraph without code and links, and the sorted numbers that it may state."""
    text = FENCE.sub("", text)
    for k, section in enumerate(re.split(r"^(?=## )", text, flags=re.MULTILINE)):
        near = text if k == 0 else section
        common = tables(near) | files(page, near)
        for paragraph in re.split(r"\n\s*\n", BLOCK.sub("", section)):
            bare = NAME.sub("", LINK.sub("]", CODE.sub("", paragraph)))
            yield bare, sorted(common | pages(page, paragraph))


def missing(page: Path, text: str) -> list[str]:
    """Return the decimals of a page that are on no record, with what stands before them."""
    literals = constants() if page in OF_RULES else frozenset()
    return [
        f"{number[0]}: {' '.join(bare.split(number[0])[0].split()[-6:])}"
        for bare, pool in paragraphs(page, text)
        for number in stated(bare)
        if not is_in(number, pool) and number[1] not in literals
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_decimal_is_on_record(page: Path) -> None:
    found = missing(page, page.read_text(encoding="utf-8"))
    assert found == [], "link its file in the same section"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_numbers_that_were_made_up_are_refused(page: Path) -> None:
    """At most a third of random numbers of three digits and more, written as those of the page are, may pass."""
    drawn, passed = 0, 0
    rng = random.Random(0)
    for bare, pool in paragraphs(page, page.read_text(encoding="utf-8")):
        for written, *form in stated(bare):
            if len(re.sub(r"\D", "", written).lstrip("0")) >= 3:
                for _ in range(30):
                    digits = re.sub(r"[1-9]", lambda _: str(rng.randint(1, 9)), re.match(r"-?([\d.]+)", written)[1])
                    drawn, passed = drawn + 1, passed + is_in(("", float(digits), *form[1:]), pool)
    assert 3 * passed <= drawn, f"{passed} of {drawn}"


def test_the_atlas_has_the_rows_that_its_file_gives() -> None:
    """Their order is that of the packages at hand."""
    rows = json.loads((ROOT / "docs" / "measured" / "atlas.json").read_text(encoding="utf-8"))
    atlas = runpy.run_path(str(ROOT / "tests" / "benchmarks" / "atlas.py"))
    kept, made = ((ROOT / "docs" / "atlas.md").read_text(encoding="utf-8"), atlas["page"](rows))
    assert sorted(kept.splitlines()) == sorted(made.splitlines())


def test_robot_models_are_those_of_its_file() -> None:
    record = json.loads((ROOT / "docs" / "measured" / "robot-models.json").read_text(encoding="utf-8"))
    robots = runpy.run_path(str(ROOT / "docs" / "make_robots.py"))
    assert robots["page"](record) == (ROOT / "docs" / "robot-models.md").read_text(encoding="utf-8")


def test_a_number_without_a_file_and_a_changed_digit_are_noticed() -> None:
    page = ROOT / "docs" / "measurements" / "peers.md"
    text = page.read_text(encoding="utf-8")
    assert missing(page, text) == []
    assert missing(page, f"{text}\n\nWith luck it has -98.76.\n") == ["-98.76: With luck it has"]
    assert len(missing(page, text.replace("-22.07 ± 0.96", "-22.17 ± 0.96"))) == 1
    assert len(missing(page, text.replace("peers-spread.json", "fast.json"))) > 15
    assert missing(page, f"{text}\n\n`c = 0.777` of 12.5e-6, Python 3.99\n") == []
