"""What a study is: a named list of runs, each of which is compared with another one and with the paper."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from esp_cli.defaults import __version__
from esp_cli.files.documents import DocumentFormat, Strict
from esp_cli.training.config import RunConfig


class Cell(Strict):
    """One run of a study, and where it stands in tables and pictures."""

    name: str  # of its folder
    panel: str  # the picture that its curve is in, and one axis of the table
    variant: str  # its name in that picture, and the other axis
    config: RunConfig  # what is run
    reference: str | None = None  # name of the cell that it is compared with; None for such a cell itself
    # place of the paper's number, see `paper.reported`; None where there is none that compares
    paper: tuple[str, ...] | None = None
    given: tuple[str, ...] | None = None  # dotted names of the settings that the user gave for it; None: unknown


class Study(Strict):
    """A named list of runs."""

    kind: str  # what it reproduces, such as "table1" or "ablate-transforms"; "runs" for runs put together by hand
    title: str  # one line for people
    command: str  # the command that plans it again; one a line where several added to it
    episodes: int = Field(ge=1)  # per seed, of the final evaluation of a trained policy
    esp_version: str = __version__  # of the program that planned it
    rows: Literal["panels", "variants"] = Field(description="what the rows of the table are; the other are columns")
    cells: tuple[Cell, ...]  # in the order in which they are run and shown
    left_out: dict[str, str] = Field({})  # by "TASK: METHOD" why there is no such cell


STUDY_FORMAT = DocumentFormat("esp-study", 1, "a study")
