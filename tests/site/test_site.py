"""The built site: links lead somewhere, nothing is loaded from elsewhere, and a browser shows every page whole."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.site.browser import BROWSER, DESKTOP, PHONE, complaints, opened
from tests.site.built import faults

ROOT = Path(__file__).parents[2]
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium here: .ci/install-chromium, or apt-get")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built as `make site` does."""
    pytest.importorskip("material", reason="the site is built with the extra 'site'")
    path = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300, env=os.environ)
    assert done.returncode == 0, done.stderr
    return path


def test_every_link_leads_somewhere_and_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    assert len(list(site.rglob("*.html"))) > 50
    assert faults(site) == []


def test_a_broken_link_a_missing_anchor_and_a_foreign_script_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<h1 id="top"></h1><a href="b.html">1</a><a href="#top">2</a><a href="#gone">3</a><a href="https://x.y">4</a>'
        '<script src="https://x.y/z.js"></script><img src="lost.png"><a href="b.html#there">5</a>'
    )
    (tmp_path / "b.html").write_text('<a href="gone.html">1</a><h2 id="there"></h2>')
    assert faults(tmp_path) == [
        "a.html loads https://x.y/z.js",
        "a.html links to #gone, which has no such anchor",
        "a.html links to lost.png",
        "b.html links to gone.html",
    ]


def test_the_search_finds_pages_without_a_server(site: Path) -> None:
    index = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    assert index.startswith("var __index = ")
    assert '"location":"own-tasks.html"' in index
    assert "source/esp_cli" not in index, "the search finds pages, not sources"


@needs_browser
def test_a_browser_searches_pages_that_are_opened_from_the_disk(site: Path, tmp_path: Path) -> None:
    found = opened(f"{(site / 'index.html').as_uri()}?q=risky", tmp_path)
    assert re.search(r"<mark[^>]*>Risky</mark> state", found.stdout)
    assert "CONSOLE" not in found.stderr


def test_the_reference_pages_name_every_command_setting_and_task(site: Path) -> None:
    from esp_cli.algorithms.mappo import MappoConfig
    from esp_cli.commands import COMMANDS
    from esp_envs.registry import task_names

    commands, settings, tasks = (
        (site / "reference" / f"{name}.html").read_text(encoding="utf-8") for name in ("commands", "settings", "tasks")
    )
    assert [name for name in COMMANDS if f'id="esp-{name}"' not in commands] == []
    assert "<code>--transforms</code>" in commands
    assert [name for name in MappoConfig.model_fields if f"<code>mappo.{name}</code>" not in settings] == []
    built_in = [name for name in task_names() if ":" not in name]  # other tests register their own
    assert {"navigation", "wildlife", "ant", "quadruped"} < set(built_in)
    assert [name for name in built_in if f'id="{name}"' not in tasks] == []


@needs_browser
@pytest.mark.parametrize("width", [DESKTOP, PHONE])
def test_a_browser_shows_every_page_whole_and_says_nothing(site: Path, width: int, tmp_path: Path) -> None:
    pages = [page for page in sorted(site.rglob("*.html")) if "source" not in page.parts and page.name != "404.html"]
    assert len(pages) > 40
    assert complaints(pages, width, tmp_path) == []


@needs_browser
def test_a_browser_notices_a_wide_page_a_cut_table_a_lost_picture_and_a_failing_script(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text(
        "<h1>Bad</h1><article><table><tr><td style='min-width: 2000px'>x<th>ahead</table>"
        "<pre><code style='display: block; overflow: auto; width: 9em'>a line that is too long</code></pre></article>"
        "<img src='lost.png'>"
        "<script>nothing.here()</script>"
    )
    (tmp_path / "scratch").mkdir()
    found = "\n".join(complaints([page], PHONE, tmp_path / "scratch"))
    assert "nothing is not defined" in found
    for part in ("px too wide", "cuts a table", "does not show lost.png", "hides who is ahead", "cuts a line"):
        assert part in found
    assert "hides the last column" in "\n".join(complaints([page], DESKTOP, tmp_path / "scratch"))
