"""Write docs/dependencies.md, the audit of what a user installs: versions, and when each was released.

    uv pip compile pyproject.toml -c constraints.txt --python-version 3.11 --format pylock.toml -o pylock.toml
    python docs/make_dependencies.py pylock.toml

The dates are those of the upload of the release, which the package index tells and the lock file keeps.
"""

from __future__ import annotations

import re
import sys
import tomllib
from datetime import datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "dependencies.md"
_BEGIN = """# Dependencies

This is what `pip install .` in a checkout brings on Linux with Python 3.11, at the versions of
[constraints.txt](../constraints.txt), and when each release was uploaded. The parts of CUDA that `torch` may bring are
left out, since the tests do not install them. `docs/make_dependencies.py` writes this page.

`pip-audit -r constraints.txt` compares these versions with the database of known vulnerabilities. The project's own
checks run where this database cannot be reached. This page does not say that a version has no vulnerability.

"""
_TABLE = """## {title}

| package | version | released |
|---|---|---|
"""


def normal(name: str) -> str:
    """Return a package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pinned() -> set[tuple[str, str]]:
    """Return name and version of every line of constraints.txt."""
    lines = re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    return {(normal(name), version) for name, version in lines}


def direct() -> set[str]:
    """Return the names of the packages that the project itself names, but for those of an older Python."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return {normal(re.split(r"[\[<>=]", need)[0]) for need in project["dependencies"] if "python_version <" not in need}


def released(package: dict[str, Any]) -> datetime:
    """Return when the first file of a release was uploaded."""
    files = [*package.get("wheels", []), *filter(None, [package.get("sdist")])]
    uploaded: datetime = min(file["upload-time"] for file in files)
    return uploaded


def page(lock: dict[str, Any]) -> str:
    """Return the page, the project's own dependencies first."""
    known, own = pinned(), direct()
    text = _BEGIN
    for title, named in (("Named by the project", True), ("Needed by these", False)):
        rows = sorted(
            (p["name"], p["version"], f"{released(p):%Y-%m-%d}")
            for p in lock["packages"]
            if (p["name"], p["version"]) in known and (p["name"] in own) == named
        )
        text += _TABLE.format(title=title) + "".join(f"| {' | '.join(row)} |\n" for row in rows) + "\n"
    return text.rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(tomllib.loads(Path(sys.argv[1]).read_text())), encoding="utf-8")
    print(f"{PAGE} is written")
