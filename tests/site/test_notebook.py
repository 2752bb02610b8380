"""The tutorial's notebook runs, and holds the outputs of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="the notebook is run with the extra 'notebook'")
pytest.importorskip("nbclient", reason="the notebook is run with the extra 'notebook'")


def outputs(notebook) -> set[str]:
    """Return the media types of everything that the cells show."""
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return {kind for output in shown for kind in output.get("data", {})}


@pytest.mark.slow
def test_the_notebook_runs_and_shows_a_curve_and_a_film(tmp_path: Path) -> None:
    from tests.site.notebook import NOTEBOOK, executed

    stored = nbformat.read(NOTEBOOK, as_version=4)
    assert outputs(stored) >= {"image/png", "image/gif"}, "run: python -m tests.site.notebook"
    for cell in stored.cells:
        cell.source = cell.source.replace("steps=50_000", "steps=5_000").replace("steps=20_000", "steps=5_000")
    done = executed(stored, tmp_path)
    assert outputs(done) >= {"image/png", "image/gif"}
    text = "".join(o.text for c in done.cells if c.cell_type == "code" for o in c.outputs if o.output_type == "stream")
    assert "largest difference" in " ".join(text.split()) or "policy.py" in text


def test_a_cell_that_fails_is_noticed(tmp_path: Path) -> None:
    from nbclient.exceptions import CellExecutionError

    from tests.site.notebook import executed

    cells = [nbformat.v4.new_code_cell("nothing.here()")]
    with pytest.raises(CellExecutionError, match="nothing"):
        executed(nbformat.v4.new_notebook(cells=cells), tmp_path)
