"""Learning curves as inline SVG for a page: what its template draws, and the numbers that its script shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from esp_cli.files.formatting import format_count
from esp_cli.policies.curve_statistics import curve_band
from esp_cli.reporting.panels import Panel
from esp_cli.reporting.plots import appearance

WIDTH, HEIGHT = 640, 320
_LEFT, _RIGHT, _TOP, _BOTTOM = 72, 12, 12, 46
_DASHES, _LONG_DASHES = {"-": "", "--": "7 4", "-.": "7 3 2 3"}, "7 3 2 3 2 3"
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


@dataclass(frozen=True)
class ChartCurve:
    """One curve: its line and band as SVG paths, and points [x, mean, low, high, step, y] for the script."""

    label: str
    colour: str
    dashes: str
    line: str
    band: str
    points: list[tuple[float, float, int, float, float, float]]


@dataclass(frozen=True)
class Tick:
    """A line across the picture at a place, with its text."""

    at: float
    text: str


@dataclass(frozen=True)
class Chart:
    """One panel as the template draws it."""

    title: str
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    anchors: list[Tick]
    curves: list[ChartCurve]
    y_title: str
    x_title: str = "environment steps per seed"
    width: int = WIDTH
    height: int = HEIGHT
    left: int = _LEFT
    right: int = WIDTH - _RIGHT
    top: int = _TOP
    bottom: int = HEIGHT - _BOTTOM


def chart(panel: Panel, labels: Sequence[str], y_title: str) -> Chart:
    """Return one panel as the template draws it.

    Args:
        panel: at least one curve with a finite value.
        labels: of all panels; the place of a label is its colour.
        y_title: what is plotted.
    """
    drawn = [(curve.label, _thinned(curve.steps, curve.values)) for curve in panel.curves]
    edges = np.concatenate([np.concatenate([low, high]) for _, (_, _, low, high) in drawn])
    edges = edges[np.isfinite(edges)]
    bottom, top = (float(edges.min()), float(edges.max())) if edges.size else (0.0, 1.0)
    margin = 0.04 * (top - bottom or 1.0)
    bottom, top = bottom - margin, top + margin
    last = max(float(steps[-1]) for _, (steps, _, _, _) in drawn) or 1.0
    x = _Scale(0.0, last, _LEFT, WIDTH - _RIGHT)
    y = _Scale(bottom, top, HEIGHT - _BOTTOM, _TOP)
    return Chart(
        panel.title,
        x_ticks=[Tick(x(tick), format_count(tick)) for tick in _ticks(0.0, last)],
        y_ticks=[Tick(y(tick), f"{tick:g}") for tick in _ticks(bottom, top)],
        anchors=[
            Tick(y(value), f"{name} {round(value, 2)}")
            for name, value in panel.anchors.items()
            if bottom <= value <= top
        ],
        curves=[_curve(label, labels.index(label), numbers, x, y) for label, numbers in drawn],
        y_title=y_title,
    )


def stroke(index: int) -> tuple[str, str]:
    """Return the colour and the dashes of the curve with this index."""
    colour, style = appearance(index)
    return colour, _DASHES.get(style, _LONG_DASHES) if isinstance(style, str) else _LONG_DASHES


def _curve(label: str, index: int, numbers: tuple[Floats, Floats, Floats, Floats], x: _Scale, y: _Scale) -> ChartCurve:
    whole = [row for row in zip(*map(np.ndarray.tolist, numbers), strict=True) if all(map(math.isfinite, row))]
    upper, lower = [(x(s), y(high)) for s, _, _, high in whole], [(x(s), y(low)) for s, _, low, _ in whole]
    return ChartCurve(
        label,
        *stroke(index),
        line=_path([(x(s), y(mean)) for s, mean, _, _ in whole]),
        band=_path([*upper, *reversed(lower)]),
        points=[(x(s), y(m), int(s), round(m, 2), round(low, 2), round(high, 2)) for s, m, low, high in whole],
    )


def _thinned(steps: ArrayLike, values: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
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
