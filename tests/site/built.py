"""What is wrong with a built site: links that lead nowhere, and what a page would load from elsewhere."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADING = {"script": "src", "img": "src", "iframe": "src", "video": "src", "source": "src", "link": "href"}


class Seen(HTMLParser):
    """Collects the links, the loaded files and the anchors of a page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value for name, value in attributes if value is not None}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in LOADING and LOADING[tag] in values:
            self.loaded.append(values[LOADING[tag]])


def faults(site: Path) -> list[str]:
    """Return one line for every link of a site that leads nowhere and every file that it would load from elsewhere."""
    seen = {page: Seen(page) for page in sorted(site.rglob("*.html"))}
    found = []
    for page, content in seen.items():
        where = page.relative_to(site)
        found += [f"{where} loads {url}" for url in content.loaded if urlsplit(url).scheme or url.startswith("//")]
        for url in [*content.links, *content.loaded]:
            parts = urlsplit(url)
            if parts.scheme or url.startswith("//") or (page.name == "404.html" and parts.path.startswith("/")):
                continue
            target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            if not target.is_file():
                found.append(f"{where} links to {url}")
            elif parts.fragment and target in seen and unquote(parts.fragment) not in seen[target].anchors:
                found.append(f"{where} links to {url}, which has no such anchor")
    return found
