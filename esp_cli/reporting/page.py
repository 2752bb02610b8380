"""The report of a study or of some runs: Markdown with pictures, and one page that needs nothing but a browser."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from jinja2 import Environment, FileSystemLoader

from esp_cli.defaults import __version__
from esp_cli.drawing.draw import Request, draw
from esp_cli.files.documents import encode
from esp_cli.files.formatting import escaped
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import replace_file
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.reporting.collect import Material
from esp_cli.reporting.exports import marl_eval
from esp_cli.reporting.results import RESULTS_FORMAT
from esp_cli.reporting.study_figures import draw_curves, draw_variants
from esp_cli.reporting.tables import Table, all_tables, markdown_text
from esp_cli.training.folder_names import POLICY
from esp_envs.errors import UserError

PAGE, MARKDOWN, RESULTS, MARL_EVAL, FILM = "report.html", "report.md", "results.json", "marl-eval.json", "film.gif"
CURVES = "curves"
_TEMPLATES = Path(__file__).with_name("templates")
_FILM_PIXELS, _FILM_FRAMES_PER_SECOND = 240, 12.0
_FILM_SECONDS = 15.0  # A film is sped up to last no longer
_MAX_FILM_BYTES = 2**26


class RunText(NamedTuple):
    """A run by itself: its name, the command that trains it, and its configuration as JSON."""

    name: str
    command: str
    config: str


def write_report(material: Material, out: Path) -> list[Path]:
    """Write a report.

    Args:
        material: what it is made from.
        out: folder; missing ones are made.

    Returns:
        The files: the page, the Markdown, the pictures, the results and the form for marl-eval.

    Raises:
        UserError: no run has an evaluation yet, the folder has a report of something else, or a file cannot be
            written.
    """
    if not material.curves:
        raise UserError("no run of this study has an evaluation yet; run it first, or wait a little")
    _refuse_foreign(out)
    out.mkdir(parents=True, exist_ok=True)
    # Names in this folder are the program's own: links there are replaced, where drawing would follow them.
    with TemporaryDirectory() as scratch:
        curves, hovers = draw_curves(material, Path(scratch) / CURVES)
        pictures = [curves, *draw_variants(material.results, Path(scratch))]
        images = [(picture.png.stem, _data_uri(picture.svg.read_bytes(), "image/svg+xml")) for picture in pictures]
        for file in (file for picture in pictures for file in (picture.png, picture.svg)):
            replace_file(out / file.name, file.read_bytes())
    tables, runs = all_tables(material.results), _runs(material)
    content = {
        "title": material.study.title,
        "version": __version__,
        "command": material.study.command,
        "tables": tables,
        "size": curves.size,
        "hovers": [asdict(hover) for hover in hovers],
        "curves": images[0][1],
        "pictures": images[1:],
        "films": _films(material),
        "runs": runs,
    }
    templates = Environment(loader=FileSystemLoader(_TEMPLATES), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    names = [picture.png.stem for picture in pictures]
    files = {
        PAGE: escaped(templates.get_template("report.html").render(content)).encode(),
        MARKDOWN: escaped(_markdown(material, tables, names, runs)).encode(),
        RESULTS: encode(material.results.document(), out / RESULTS),
        MARL_EVAL: encode(marl_eval(material), out / MARL_EVAL),
    }
    for name, text in files.items():
        replace_file(out / name, text)
    return [out / name for name in (PAGE, MARKDOWN, *(f"{stem}.png" for stem in names), RESULTS, MARL_EVAL)]


def draw_films(runs: Mapping[str, Path], watch: Callable[[int], None]) -> None:
    """Draw the policy of each trained run that has no film yet, into its folder.

    Args:
        runs: run folders by name.
        watch: told how many are done.
    """
    for count, run in enumerate(runs.values(), start=1):
        if (run / POLICY).is_file() and not _film(run / FILM):
            trained = TrainedPolicy.read(run / POLICY)
            speed = max(1.0, trained.spec.horizon * trained.spec.control_period_s / _FILM_SECONDS)
            with TemporaryDirectory() as scratch:
                film = Path(scratch) / FILM
                draw(Request(film, view="top", size=_FILM_PIXELS, speed=speed, fps=_FILM_FRAMES_PER_SECOND), [trained])
                replace_file(run / FILM, film.read_bytes())
        watch(count)


def _refuse_foreign(out: Path) -> None:
    """Refuse a folder whose files of these names are not of a report."""
    own = (MARKDOWN, RESULTS, PAGE, MARL_EVAL, f"{CURVES}.png", f"{CURVES}.svg")
    foreign = next((out / name for name in own if os.path.lexists(out / name)), None)
    if foreign is not None and not RESULTS_FORMAT.is_one(out / RESULTS):
        raise UserError(f"{foreign} is not of a report by esp; move it away, or write the report to another folder")


def _films(material: Material) -> list[tuple[str, str]]:
    """Return the films that are drawn: what they show, and the film for a page."""
    titles = {material.runs[cell.name]: f"{cell.panel}: {cell.variant}" for cell in material.study.cells}
    films = [(title, _film(run / FILM)) for run, title in titles.items()]
    return [(title, _data_uri(film, "image/gif")) for title, film in films if film]


def _film(path: Path) -> bytes:
    """Return a film that was drawn before; empty where there is none. A link is not followed."""
    content = None
    if not path.is_symlink():
        with contextlib.suppress(OSError):
            content = read_regular(path, _MAX_FILM_BYTES)
    return content if content and content.startswith(b"GIF8") else b""


def _runs(material: Material) -> list[RunText]:
    """Return every run once, whatever the number of steps at which it is compared."""
    cells = {material.runs.get(cell.name, cell.name): cell for cell in material.study.cells}
    return [
        RunText(
            f"{cell.panel}: {cell.variant}",
            cell.config.command(),
            json.dumps(cell.config.model_dump(mode="json"), indent=1),
        )
        for cell in cells.values()
    ]


def _data_uri(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _markdown(material: Material, tables: Sequence[Table], pictures: Sequence[str], runs: Sequence[RunText]) -> str:
    parts = [f"# {markdown_text(material.study.title)}", _fenced(material.study.command)]
    parts += [f"## {markdown_text(table.title)}\n\n{table.markdown()}" for table in tables]
    parts += [f"![{name}]({name}.png)" for name in pictures]
    return "\n\n".join([*parts, "## Each run by itself", _fenced("\n".join(run.command for run in runs))]) + "\n"


def _fenced(command: str) -> str:
    """Return a block of shell commands, in a fence that is longer than any row of backticks in it."""
    fence = "`" * max(3, *(len(row) + 1 for row in re.findall("`+", command)), 0)
    return f"{fence}sh\n{command}\n{fence}"
