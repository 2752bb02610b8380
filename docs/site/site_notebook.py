"""A notebook as a page: its text, its code, and what its cells printed and drew."""

from __future__ import annotations

import base64
import json
from pathlib import Path

_PICTURES = {"image/png": "png", "image/gif": "gif"}


def page(notebook: Path) -> tuple[str, dict[str, bytes]]:
    """Return the Markdown of a notebook, and its pictures by the names under which the page shows them."""
    text, pictures = "", {}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            text += f"{source}\n\n"
            continue
        text += f"```python\n{source}\n```\n\n"
        for output in cell["outputs"]:
            if "text" in output:
                text += f"```text\n{''.join(output['text']).rstrip()}\n```\n\n"
            for kind, ending in _PICTURES.items():
                if kind in output.get("data", {}):
                    name = f"{notebook.stem}-{len(pictures) + 1}.{ending}"
                    pictures[name] = base64.b64decode("".join(output["data"][kind]))
                    text += f"![What the code above shows]({name})\n\n"
    download = f"The page is a notebook: [{notebook.name}]({notebook.name}) runs it.\n\n"
    head, _, rest = text.partition("\n\n")
    return f"{head}\n\n{download}{rest}", pictures
