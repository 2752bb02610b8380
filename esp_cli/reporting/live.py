"""The page of `esp train --watch`: the learning curve and the present policy at work, written anew as a run goes on."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

from esp_cli.files.formatting import format_count
from esp_cli.files.writing import replace_file
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.reporting.collect import read_curve
from esp_cli.reporting.page import data_uri, draw_film, template
from esp_cli.reporting.study_figures import Panel, learning_curves
from esp_cli.training.metrics import RETURN
from esp_cli.training.trackers import Row
from esp_cli.training.trainer import Trainer

LIVE = "live.html"
SHARE = 0.1  # most of a run's time that drawing takes
_REFRESH_S, _FILM_PIXELS = 5, 320


class LivePage:
    """A tracker that draws a page into the run folder at evaluations; a browser loads it again every few seconds."""

    def __init__(self, trainer: Trainer) -> None:
        self._trainer, self._begun, self._spent = trainer, time.monotonic(), 0.0
        self.path = trainer.folder.path / LIVE

    def write(self, step: int, values: Row) -> None:
        begun, complete = time.monotonic(), self._trainer.is_complete
        if RETURN in values and (complete or self._spent <= SHARE * (begun - self._begun)):
            replace_file(self.path, self._page(step, complete).encode())
            self._spent += time.monotonic() - begun

    def close(self) -> None:
        """Leave the page as it is."""

    def _page(self, step: int, complete: bool) -> str:
        trainer, film = self._trainer, b""
        config, spec = trainer.config, trainer.learner.spec
        done = min(step, config.steps)  # the last update may go beyond
        curve = read_curve(trainer.folder.path, None, "greedy")
        with TemporaryDirectory() as scratch:
            ylabel = f"greedy return ({spec.convention})"
            png = learning_curves([Panel(spec.name, [curve])], Path(scratch) / "curve", ylabel)
            svg = png.with_suffix(".svg").read_bytes()
        if trainer.evaluation_worlds.has("scene"):
            trained = TrainedPolicy(config, trainer.learner.policy, spec, step, trainer.folder.path)
            film = draw_film(trained, _FILM_PIXELS, episodes=1)
        return template("live.html").render(
            title=f"{config.algorithm} on {config.task}, {format_count(done)} of {format_count(config.steps)} steps",
            refresh=None if complete else _REFRESH_S,
            curve=data_uri(svg, "image/svg+xml"),
            film=data_uri(film, "image/gif") if film else "",
            seed=config.seeds[0],
        )
