"""The documentation keeps its word: links lead somewhere, names of code exist, every `esp` command line parses."""

import ast
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from esp_cli import __version__
from esp_cli.app import app

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "checkpoints").rglob("*.md")])

_FENCE = re.compile(r"^(```|~~~).*?^\1", re.MULTILINE | re.DOTALL)
_CODE_SPAN = re.compile(r"`[^`\n]*`")
_LINK = re.compile(r"\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
_ELSEWHERE = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)
_NAMES_IN_A_FILE = re.compile(r"\[((?:`[^`\n]+`(?:, )?)+)\]\(([^)#\s]+\.py)\)")
_HEADING = re.compile(r"^#{1,6}\s+(.+?)\s*#*$", re.MULTILINE)


def prose(text: str) -> str:
    """Return a page without its code."""
    return _CODE_SPAN.sub("", _FENCE.sub("", text))


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, made as web views of Markdown make them."""
    found: set[str] = set()
    for heading in _HEADING.findall(_FENCE.sub("", text)):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        count = 1
        anchor = slug
        while anchor in found:
            anchor, count = f"{slug}-{count}", count + 1
        found.add(anchor)
    return found


def broken_links(page: Path) -> list[str]:
    broken = []
    for link in _LINK.findall(prose(page.read_text(encoding="utf-8"))):
        if _ELSEWHERE.match(link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (
            anchor and target.suffix == ".md" and anchor not in anchors(target.read_text(encoding="utf-8"))
        ):
            broken.append(link)
    return broken


def missing_names(page: Path) -> list[str]:
    """Return the names that a page links to a Python file, [`module:Class.method`](file.py), which the file lacks."""
    missing = []
    for names, file in _NAMES_IN_A_FILE.findall(page.read_text(encoding="utf-8")):
        target = page.parent / file
        defined = names_of(target) if target.exists() else set[str]()
        told = [name for name in re.findall(r"`([^`]+)`", names) if not name.endswith(".py") and "/" not in name]
        missing += [f"{name} in {file}" for name in told if re.split("[.:]", name)[-1] not in defined]
    return missing


def names_of(source: Path) -> set[str]:
    """Return the names of all functions, classes, variables and attributes that a file defines."""
    names = set[str]()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.id if isinstance(node, ast.Name) else node.attr)
    return names


def command_lines(text: str) -> Iterator[str]:
    """Yield the `esp` command lines in a page's code blocks, continued lines joined, comments and pipes cut off."""
    for block in _FENCE.finditer(text):
        for line in re.sub(r"\\\n\s*", " ", block.group()).splitlines():
            for part in re.split(r"\s(?:&&|\|\||\||;|>|2>)\s", re.sub(r"\s#\s.*", "", line)):
                command = part.strip().removeprefix("$ ")
                if re.match(r"esp\s", command):
                    yield command


def complaint(command_line: str) -> str | None:
    """Say why a command line does not parse, without running it; None where it does."""
    words = shlex.split(command_line)[1:]
    group = typer.main.get_command(app)
    try:
        with group.make_context("esp", list(words)) as context:
            name, command, rest = group.resolve_command(context, words)
            command.make_context(name, rest, parent=context).close()
    except typer.Exit:  # --help and --version answer while parsing
        return None
    except (typer.TyperException, ValueError) as failure:
        return str(failure) or type(failure).__name__
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    assert broken_links(page) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_command_lines_parse(page: Path) -> None:
    complaints = {line: complaint(line) for line in command_lines(page.read_text(encoding="utf-8"))}
    assert {line: reason for line, reason in complaints.items() if reason} == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_names_of_code_are_in_the_files_that_they_link_to(page: Path) -> None:
    assert missing_names(page) == []


def test_the_readme_is_among_the_pages() -> None:
    assert ROOT / "README.md" in PAGES


def test_a_broken_link_and_a_missing_anchor_are_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# Two words, *here*\n```\n# no heading\n```\n## Two words, here\n")
    page = tmp_path / "page.md"
    page.write_text(
        "# Top\n[a](other.md) [b](other.md#two-words-here) [c](other.md#two-words-here-1) [d](#top) [e](https://x.y/z)\n"
        "[![f](lost.png)](other.md) [g](gone.md) [h](other.md#no-heading) [i](#bottom) `[j](code.md)`\n"
        "```\n[k](block.md)\n```\n"
    )
    assert broken_links(page) == ["lost.png", "gone.md", "other.md#no-heading", "#bottom"]


def test_a_name_that_a_file_lacks_is_found(tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("LIMIT = 1\nclass Learner:\n    def step(self):\n        self.count = LIMIT\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[`a.code:LIMIT`, `Learner.step`, `Learner.count`](code.py), [`code:Learner.leap`](code.py), [`x`](no.py)"
    )
    assert missing_names(page) == ["code:Learner.leap in code.py", "x in no.py"]


def test_command_lines_are_found_where_they_stand() -> None:
    text = (
        "Use `esp nothing` or\n```sh\n$ esp --help\nesp one --two \\\n    three  # comment\n"
        "make demo && esp four | jq .x\n"
        "pip install esp\n```\nesp five\n"
    )
    assert list(command_lines(text)) == ["esp --help", "esp one --two  three", "esp four"]


@pytest.mark.parametrize("line", ["esp --help", "esp --version"])
def test_a_good_command_line_parses(line: str) -> None:
    assert complaint(line) is None


@pytest.mark.parametrize("line", ["esp nothing", "esp --speed 3 train"])
def test_a_bad_command_line_does_not(line: str) -> None:
    assert complaint(line) is not None


def test_the_citation_names_the_version_of_the_package() -> None:
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


MOST_WORDS, MOST_BY_HAND = 40_000, 25_000


def by_hand(text: str) -> str:
    """Return a page without the tables that are computed and the code, which tests run."""
    text = re.sub(r"<!-- (?:results|scores): .*?<!-- end of results -->", "", text, flags=re.DOTALL)
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def test_the_documentation_is_read_in_an_afternoon() -> None:
    pages = {page: page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md")}
    generated = ("atlas.md", "robot-models.md", "dependencies.md")
    own = [by_hand(text) for page, text in pages.items() if page.name not in generated]
    every = [(ROOT / "README.md").read_text(encoding="utf-8"), *pages.values()]
    assert sum(len(text.split()) for text in every) <= MOST_WORDS, "as wc -w counts"
    assert sum(len(text.split()) for text in own) <= MOST_BY_HAND
    assert by_hand("a <!-- results: f.json pairs -->\nb\n<!-- end of results --> c") == "a  c"
    assert by_hand("a\n```sh\nesp\n```\nb") == "a\n\nb"
