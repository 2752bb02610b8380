"""Learning curves as text, for a terminal that shows them while runs train."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from rich.text import Text

from esp_cli.files.formatting import format_count

MARKS, _STYLES = ("○", "●"), ("dodger_blue2", "dark_orange")  # of the curves in turn
_HEIGHT, _WIDEST, _LABEL = 12, 64, 8  # rows and columns of the drawing, columns of a number beside it


def draw_curves(curves: Mapping[str, Sequence[tuple[float, float]]], steps: int, width: int) -> Text:
    """Draw two curves in one pair of axes, with the lowest and the highest value beside them and a legend below.

    Args:
        curves: by name the points (step, value), in the order of their steps; those without a point are left out.
        steps: at the right edge.
        width: columns of the terminal.
    """
    columns = max(10, min(_WIDEST, width - _LABEL - 2))
    values = [value for points in curves.values() for _, value in points]
    low, high = (min(values), max(values)) if values else (0.0, 0.0)
    grid = np.full((_HEIGHT, columns), -1)
    for index, points in enumerate(curves.values()):
        if points:
            at, means = np.array(points).T
            shown = np.arange(columns) * steps / (columns - 1)
            shown = shown[(shown >= at[0]) & (shown <= max(at[-1], steps / columns))]
            share = (np.interp(shown, at, means) - low) / max(high - low, 1e-9)
            rows = np.round((1 - share) * (_HEIGHT - 1)).astype(int)
            grid[rows, np.round(shown / steps * (columns - 1)).astype(int)] = index
    text = Text()
    for number, row in enumerate(grid):
        level = {0: high, _HEIGHT - 1: low}.get(number) if values else None
        text.append(f"{'' if level is None else f'{level:.4g}':>{_LABEL}} │")
        for index in row:
            text.append(" " if index < 0 else MARKS[index], "" if index < 0 else _STYLES[index])
        text.append("\n")
    text.append(f"{'':{_LABEL}} └{'─' * columns}\n{'':{_LABEL}}  0{format_count(steps) + ' steps':>{columns - 1}}\n")
    for index, (name, points) in enumerate(curves.items()):
        newest = f" {points[-1][1]:.1f}" if points else ""
        text.append(f"{'':{_LABEL}}  {MARKS[index]} {name}{newest}", _STYLES[index])
    return text.append("\n")
