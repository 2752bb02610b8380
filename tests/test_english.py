"""The English of the documentation: words that are not used, and sentences that can be read at once."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
LONGEST_WORDS = 36
"""Of a sentence. The rule is some 25; an enumeration may have more."""

_NOT_PROSE = re.compile(
    r"^(```|~~~).*?^\1|^<!--.*?-->|^ {0,3}\|.*?$|^#.*?$|!?\[[^\]]*\]\([^)]*\)(?=\s*$)", re.MULTILINE | re.DOTALL
)
_AVOIDED = re.compile(
    r"\b(whom|whoever|whomever|thereof|shall|contestants?|judgements?|judged|both means|the box|the way there)\b",
    re.IGNORECASE,
)


def sentences(page: str) -> Iterator[str]:
    """Yield the sentences of a page without its code, tables, headings and comments."""
    for paragraph in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s", _NOT_PROSE.sub("\n\n", page)):
        text = re.sub(r"^(?:[-*]|\d+\.)\s", "", " ".join(paragraph.split()))
        text = re.sub(r"`[^`]*`", "code", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text))
        yield from (sentence for sentence in re.split(r"(?<=[.!?:;])\)?\s+(?=[A-Z`\"*(]|code)", text) if sentence)


def complaints(page: str) -> list[str]:
    found = []
    for sentence in sentences(page):
        found += [f"'{word[0]}' in: {sentence}" for word in _AVOIDED.finditer(sentence)]
        if len(sentence.split()) > LONGEST_WORDS:
            found.append(f"{len(sentence.split())} words: {sentence}")
        if re.match(r"-?\d+(?![.\d]*[.)]\s)", sentence):
            found.append(f"begins with a number: {sentence}")
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_can_be_read_at_once(page: Path) -> None:
    assert complaints(page.read_text(encoding="utf-8")) == []


def test_a_long_sentence_an_old_word_and_a_number_in_front_are_noticed() -> None:
    page = (
        f"# Heading whom\n\nIt is {'very ' * 40}long.\n\n```\nwhom\n```\n| shall |\n\n1. Ask whom `shall` do.\n\n9 ran."
    )
    assert [line.split(":")[0] for line in complaints(page)] == ["43 words", "'whom' in", "begins with a number"]
