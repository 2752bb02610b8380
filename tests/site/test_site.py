"""The built site: every link leads somewhere, and nothing is loaded from elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.site.built import faults

ROOT = Path(__file__).parents[2]


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


def test_the_reference_pages_name_every_command_setting_and_task(site: Path) -> None:
    from esp_cli.algorithms.mappo import MappoConfig
    from esp_cli.commands import COMMANDS
    from esp_envs.registry import task_names

    commands, settings, tasks = (
        (site / "reference" / f"{name}.html").read_text(encoding="utf-8") for name in ("commands", "settings", "tasks")
    )
    assert [name for name in COMMANDS if f'id="esp-{name}"' not in commands] == []
    assert "<code>--consistency-coef</code>" in commands
    assert [name for name in MappoConfig.model_fields if f"<code>mappo.{name}</code>" not in settings] == []
    assert [name for name in task_names() if f'id="{name}"' not in tasks] == []
