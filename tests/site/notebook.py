"""The tutorial's notebook, run from its first cell to its last: python -m tests.site.notebook writes its outputs."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "docs" / "tutorial.ipynb"


def executed(notebook: nbformat.NotebookNode, folder: Path) -> nbformat.NotebookNode:
    """Run all cells in a kernel of this environment, and return the notebook with their outputs.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails.
    """
    # tests draw without a window; a notebook shows what it draws
    env = os.environ | {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    env["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{env['PATH']}"
    patience = {"timeout": 400, "startup_timeout": 300}
    client = NotebookClient(notebook, kernel_name="python3", resources={"metadata": {"path": str(folder)}}, **patience)
    done = client.execute(env=env)
    for cell in done.cells:
        cell.metadata.pop("execution", None)  # times of day
        for output in cell.get("outputs", []):
            if "text" in output:
                output["text"] = re.sub(r"\x1b\[[0-9;]*m", "", output["text"])
    return done


if __name__ == "__main__":
    nbformat.write(executed(nbformat.read(NOTEBOOK, as_version=4), NOTEBOOK.parent), NOTEBOOK)
