"""Small files that a person writes: one table of names and values, as JSON or TOML."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from esp_cli.files.documents import DocumentError, check_nesting, parse_object, shortened
from esp_cli.files.failures import attempting
from esp_cli.files.opening import read_regular

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_TABLE_BYTES = 2**20


def read_table(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file that holds one JSON object, or TOML where its name ends in .toml.

    Raises:
        DocumentError: it is missing, too large, or neither.
    """
    with attempting("read", path, DocumentError):
        text = read_regular(path, MAX_TABLE_BYTES)
    if text is None:
        raise DocumentError(f"{path} is larger than a file of settings can be")
    if Path(path).suffix.lower() != ".toml":
        try:
            return parse_object(text, "text")
        except DocumentError as error:
            raise DocumentError(f"{path} {error}; write TOML into a file whose name ends in .toml") from None
    try:
        table = tomllib.loads(text.decode("utf-8"))
        check_nesting(table)
    except (ValueError, RecursionError) as error:
        raise DocumentError(f"{path} is not valid TOML: {shortened(str(error))}") from None
    for name, value in flat(table):
        if isinstance(value, float) and not math.isfinite(value):
            raise DocumentError(f"{path} sets '{name}' to {value}; write a finite number")
        if not isinstance(value, bool | int | float | str | list):
            raise DocumentError(f"{path} sets '{name}' to a date or time; write a number, a text or a list")
    return table


def flat(table: Mapping[str, Any], whole: Collection[str] = (), prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of everything in nested tables: {"a": {"b": 1}} -> ("a.b", 1).

    Args:
        table: the outermost.
        whole: dotted names whose tables are values themselves.
        prefix: of all names.
    """
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and name not in whole:
            yield from flat(value, whole, f"{name}.")
        else:
            yield name, value
