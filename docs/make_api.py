"""The site's API page, made of the docstrings; and the signatures that its test holds: python docs/make_api.py."""

from __future__ import annotations

import hashlib
import inspect
import json
import re
import textwrap
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import esp_cli

SIGNATURES = Path(__file__).parents[1] / "tests" / "library" / "signatures.json"
_HEAD = """# API reference

What `esp_cli.__all__` lists is public: `from esp_cli import Symmetry, train`. A change of a signature stands in the
[changelog](../changelog.md). `make site` makes this page from the docstrings, which `help(esp_cli.train)` shows too;
[the library page](../library.md) shows how the parts work together.
"""
_GROUPS = {
    "Train and use a policy": ("train", "Run", "Metrics", "Progress", "load_policy", "LoadedPolicy"),
    "A training loop of your own": (
        *("Symmetry", "layout", "discrete_moves", "Field", "Kind", "Items", "Layout", "Discrete", "Continuous"),
        "Transitions",
    ),
    "Robots": ("Body",),
}
_SECTIONS = ("Args", "Attributes", "Raises", "Returns", "Shape", "Yields")


def members() -> Iterator[tuple[str, Any]]:
    """Yield (name, object) of all that is public: functions, classes and their methods and properties."""
    for name in esp_cli.__all__:
        thing = getattr(esp_cli, name)
        if name.startswith("__"):
            continue
        yield name, thing
        if inspect.isclass(thing):
            for own, value in vars(thing).items():
                if not own.startswith("_") and (inspect.isfunction(value) or isinstance(value, property | classmethod)):
                    yield f"{name}.{own}", value


def signature(thing: Any) -> str:
    """Return the signature of a function, class or property as text; the members of an enumeration."""
    if inspect.isclass(thing) and issubclass(thing, Enum):
        return f"({', '.join(member.name for member in thing)})"
    thing = thing.fget if isinstance(thing, property) else getattr(thing, "__func__", thing)
    return re.sub(r"(: |-> )(?:'([^']*)'|\"([^\"]*)\")", r"\1\2\3", str(inspect.signature(thing)))


def signatures() -> dict[str, str]:
    """Return the signature of all that is public."""
    return {name: signature(thing) for name, thing in members()}


def digest(found: dict[str, str]) -> str:
    """Return a short digest of signatures."""
    return hashlib.sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()[:16]


def page() -> str:
    """Return the page."""
    found = dict(members())
    text = _HEAD
    for title, names in _GROUPS.items():
        own = [name for top in names for name in found if name.partition(".")[0] == top]
        text += f"\n## {title}\n" + "".join(_entry(name, found.pop(name)) for name in own)
    if found:
        raise ValueError(f"no group of docs/make_api.py has {', '.join(found)}")
    return text


def _entry(name: str, thing: Any) -> str:
    text = inspect.getdoc(thing) or ""
    if isinstance(thing, property):
        return f"\n`{name}`: {_markdown(text)}\n"
    level = "####" if "." in name else "###"
    return f"\n{level} {name}\n\n```text\n{_wrapped(name, signature(thing))}\n```\n\n{_markdown(text)}\n"


def _wrapped(name: str, text: str) -> str:
    """Return a signature in lines of at most 88 characters."""
    return "\n".join(textwrap.wrap(name + text, 88, subsequent_indent="    ", break_long_words=False))


def _markdown(text: str) -> str:
    """Return a Google-style docstring as Markdown: its sections become lists, indented code becomes a block."""
    blocks = []
    for block in re.split(r"\n\s*\n", text):
        lines = block.splitlines()
        head = lines[0].rstrip(":") if lines else ""
        if lines and lines[0].endswith(":") and head in _SECTIONS:
            items = re.split(r"\n(?=\S)", textwrap.dedent("\n".join(lines[1:])))
            blocks.append(f"**{head}**\n\n" + "\n".join(_item(item) for item in items))
        elif any(re.match(r"( {4,}|[A-Z]+ {2,})", line) for line in lines) or " = " in lines[0]:
            blocks.append("```text\n" + "\n".join(lines) + "\n```")
        else:
            blocks.append(" ".join(lines).replace("[", "\\["))
    return "\n\n".join(blocks)


def _item(item: str) -> str:
    flat = " ".join(line.strip() for line in item.splitlines()).replace("[", "\\[")
    named = re.match(r"([\w*]+): (.*)", flat)
    return f"- `{named[1]}`: {named[2]}" if named else f"- {flat}"


def main() -> None:
    """Write the signatures; a changed one needs a line of the changelog that no earlier one used."""
    found, held = signatures(), json.loads(SIGNATURES.read_text(encoding="utf-8"))
    if held["changes"][-1]["digest"] != digest(found):
        line = input("a signature changed; the line of CHANGELOG.md that says so: ")
        held["changes"].append({"digest": digest(found), "line": line})
    held["signatures"] = found
    SIGNATURES.write_text(json.dumps(held, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
