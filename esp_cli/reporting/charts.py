"""Learning curves as inline SVG for a page: what its template draws, and the numbers that its script shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from esp_cli.evaluation.curve_statistics import curve_band
from esp_cli.formatting import format_count
from esp_cli.reporting.panels import Panel
from esp_cli.reporting.plots import appearance

WIDTH, HEIGHT = 640, 320
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 12, 12, 36
_DASHES = {"-": "", "--": "7 4", "-.": "7 3 2 3"}
Floats = NDArray[np.float64]
_MAX_POINTS = 200
"""Of a curve on a page; longer ones are thinned out."""


@dataclass(frozen=True)
class _Scale:
    """Where a number of the data stands in the picture."""

    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        share = (value - self.low) / (self.high - self.low or 1.0)
        return round(self.start + share * (self.end - self.start), 2)


def chart(panel: Panel, labels: Sequence[str]) -> dict[str, Any]:
    """Return one panel as the template wants it.

    Args:
        panel: at least one curve with a finite value.
        labels: of all panels; the place of a label is its colour.

    Returns:
        title, size, ticks of both axes, and by curve its colour, dashes, line and band as SVG paths, and points for
        the script: [x, mean, low, high, step, y] each.
    """
    drawn = [(curve.label, _thinned(curve.steps, curve.values)) for curve in panel.curves]
    edges = np.concatenate([np.concatenate([low, high]) for _, (_, _, low, high) in drawn])
    edges = edges[np.isfinite(edges)]
    bottom, top = (float(edges.min()), float(edges.max())) if edges.size else (0.0, 1.0)
    margin = 0.04 * (top - bottom or 1.0)
    last = max(float(steps[-1]) for _, (steps, _, _, _) in drawn) or 1.0
    x = _Scale(0.0, last, _LEFT, WIDTH - _RIGHT)
    y = _Scale(bottom - margin, top + margin, HEIGHT - _BOTTOM, _TOP)
    curves = []
    for label, (steps, mean, low, high) in drawn:
        colour, style = appearance(labels.index(label))
        places = [(x(s), y(m), y(a), y(b)) for s, m, a, b in zip(steps, mean, low, high, strict=True)]
        whole = [place for place in places if all(map(math.isfinite, place))]
        curves.append(
            {
                "label": label,
                "colour": colour,
                "dashes": _DASHES.get(style, "7 3 2 3 2 3") if isinstance(style, str) else "7 3 2 3 2 3",
                "line": _path([(px, py) for px, py, _, _ in whole]),
                "band": _path([(px, b) for px, _, _, b in whole] + [(px, a) for px, _, a, _ in reversed(whole)]),
                "points": [
                    [x(s), y(m), int(s), round(float(m), 2), round(float(a), 2), round(float(b), 2)]
                    for s, m, a, b in zip(steps, mean, low, high, strict=True)
                    if math.isfinite(m)
                ],
            }
        )
    return {
        "title": panel.title,
        "width": WIDTH,
        "height": HEIGHT,
        "left": _LEFT,
        "right": WIDTH - _RIGHT,
        "top": _TOP,
        "bottom": HEIGHT - _BOTTOM,
        "x_ticks": [(x(tick), format_count(tick)) for tick in _ticks(0.0, last)],
        "y_ticks": [(y(tick), f"{tick:g}") for tick in _ticks(bottom - margin, top + margin)],
        "anchors": [
            {"name": name, "y": y(value), "value": round(value, 2)}
            for name, value in panel.anchors.items()
            if bottom - margin <= value <= top + margin
        ],
        "curves": curves,
    }


def _thinned(steps: Any, values: Any) -> tuple[Floats, Floats, Floats, Floats]:
    """Return steps, means and band of a curve, every so-many-th with the last among them."""
    at, numbers = np.asarray(steps, dtype=np.float64), np.asarray(values, dtype=np.float64)
    every = math.ceil(len(at) / _MAX_POINTS)
    kept = sorted({*range(0, len(at), every), len(at) - 1})
    return (at[kept], *curve_band(numbers[kept]))


def _path(points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{px:g} {py:g}" for px, py in points) if points else ""


def _ticks(low: float, high: float) -> list[float]:
    ticks = MaxNLocator(nbins=6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high)
    return [float(tick) for tick in ticks if low <= tick <= high]
