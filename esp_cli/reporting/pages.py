"""Tables of a documentation page that are computed from results files: each stands between two comments.

    <!-- results: measured/table1.json paper -->
    ... written by `esp report --fill PAGE`, never by hand ...
    <!-- end of results -->

The file is found from the page's own folder; the word behind it is a name of `tables.TABLES`. Several files of one kind
of study, with spaces between, give one table. A last word, `greedy` or `stochastic`, says which final returns it takes.
A comment that does not begin its line is none of these, as this example.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

from esp_cli.defaults import Mode
from esp_cli.files.opening import read_regular
from esp_cli.reporting.results import join, read_results
from esp_cli.reporting.tables import TABLES
from esp_envs.errors import UserError

_MOST_BYTES = 1 << 24
_OF_EITHER_MODE = ("returns", "paper", "comparison")
"""Tables of final returns, which files keep of greedy and of drawn actions; of curves they keep one."""
_BLOCK = re.compile(
    rf"^(<!-- results: (?P<files>\S+(?: \S+)*?) (?P<table>\S+)(?: (?P<mode>{'|'.join(get_args(Mode))}))? -->\n)"
    r".*?^(?P<end><!-- end of results -->)",
    re.DOTALL | re.MULTILINE,
)


def filled(page: Path) -> str:
    """Return the text of a page with every such table recomputed.

    Raises:
        UserError: the page, a file or a table is not there, a file is damaged, or the page has no such comments.
    """
    try:
        content = read_regular(page, _MOST_BYTES)
        text = (content or b"").decode()
    except OSError as error:
        raise UserError(f"cannot read {page}: {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise UserError(f"{page} is no text in UTF-8; give a page of Markdown") from None

    def compute(match: re.Match[str]) -> str:
        name = match["table"]
        if name not in TABLES:
            raise UserError(f"{page} asks for the table '{name}'; the tables are {', '.join(TABLES)}")
        results = join([read_results(page.parent / file) for file in match["files"].split()])
        if match["mode"]:
            if name not in _OF_EITHER_MODE:
                raise UserError(f"{page} asks for '{name} {match['mode']}'; {', '.join(_OF_EITHER_MODE)} take a mode")
            results = results.model_copy(update={"mode": match["mode"]})
        table = TABLES[name](results)
        content = "Nothing yet." if table is None else table.markdown()
        return f"{match[1]}\n{content}\n\n{match['end']}"

    page_text, count = _BLOCK.subn(compute, text)
    if not count:
        raise UserError(
            f"{page} has no table to compute; write '<!-- results: FILE TABLE -->' and '<!-- end of results -->', "
            "each on a line of its own"
        )
    return page_text


def files_of(page: Path) -> list[str]:
    """Return the results files that a page's tables come from, each once."""
    blocks = _BLOCK.finditer(page.read_text(encoding="utf-8"))
    return list(dict.fromkeys(file for match in blocks for file in match["files"].split()))
