"""What `make site` adds to docs/: pages from the application, and the files outside docs/ that pages link to."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable
from pathlib import Path

import site_notebook
import site_reference
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
AT_THE_ROOT = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
_CODE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]*`", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?\)")
_WIDE = 7  # columns of a table from which a page has no side bars
_UNSEARCHED = "---\nsearch:\n  exclude: true\nhide: [navigation]\n---\n"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not files of docs/."""
    pages = site_reference.pages()
    for name, page in AT_THE_ROOT.items():
        if page != "index.md":
            pages[page] = inside((ROOT / name).read_text(encoding="utf-8"), "", ROOT)
    for page in [*DOCS.rglob("*.md"), *(ROOT / name for name in AT_THE_ROOT)]:
        for target in _targets(page.read_text(encoding="utf-8"), page.parent):
            pages[source_page(target)] = _source(target)
    pages["tutorial.md"], pictures = site_notebook.page(DOCS / "tutorial.ipynb")
    for name, picture in pictures.items():
        files.append(File.generated(config, name, content=picture))
    for path, content in pages.items():
        aside = path.startswith("source/") or path == site_reference.DATA
        shown = InclusionLevel.NOT_IN_NAV if aside else InclusionLevel.INCLUDED
        files.append(File.generated(config, path, content=content, inclusion=shown))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Lead links that leave docs/ to the pages that stand for their files; give wide tables the whole width."""
    if re.search(rf"^\|(?:[^|\n]*(?<!\\)\|){{{_WIDE},}}$", markdown, re.MULTILINE):
        page.meta["hide"] = ["navigation", "toc"]
    folder = posixpath.dirname(page.file.src_uri)
    if page.file.src_uri == posixpath.join(posixpath.dirname(site_reference.DATA), "index.md"):
        markdown += f"\n[All of them on one page]({posixpath.basename(site_reference.DATA)})\n"
    return inside(markdown, folder, DOCS / folder) if page.file.abs_src_path else markdown


def inside(markdown: str, folder: str, on_disk: Path) -> str:
    """Return a page whose links to files outside docs/ lead to pages of the site.

    Args:
        markdown: The text.
        folder: Where the page stands in the site.
        on_disk: The folder from which its links are written.
    """

    def lead(match: re.Match[str]) -> str:
        target = (on_disk / match[2]).resolve()
        if target.is_relative_to(DOCS):
            path = target.relative_to(DOCS).as_posix()
        elif target.parent == ROOT and target.name in AT_THE_ROOT:
            path = AT_THE_ROOT[target.name]
        else:
            path = source_page(target)
        return f"{match[1]}{posixpath.relpath(path, folder or '.')}{match[3] or ''})"

    return _outside_code(markdown, lambda text: _LINK.sub(lead, text))


def source_page(target: Path) -> str:
    """Return the page that shows a file outside docs/."""
    return f"source/{target.relative_to(ROOT).as_posix()}.md"


def _targets(markdown: str, on_disk: Path) -> set[Path]:
    found = set()
    for match in _LINK.finditer(_CODE.sub("", markdown)):
        target = (on_disk / match[2]).resolve()
        if target.exists() and not target.is_relative_to(DOCS) and target.name not in AT_THE_ROOT:
            found.add(target)
    return found


def _source(target: Path) -> str:
    title = f"{_UNSEARCHED}# `{target.relative_to(ROOT)}`\n\n"
    language = {".py": "python", ".json": "json"}.get(target.suffix, "text")
    return f"{title}~~~~~~ {{.{language} linenums=1}}\n{target.read_text(encoding='utf-8')}\n~~~~~~\n"


def _outside_code(markdown: str, change: Callable[[str], str]) -> str:
    parts, end = [], 0
    for code in _CODE.finditer(markdown):
        parts += [change(markdown[end : code.start()]), code.group()]
        end = code.end()
    return "".join([*parts, change(markdown[end:])])
