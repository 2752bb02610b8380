"""What a drone sees: a picture of the whole torus with itself in the middle, three by three pixels a cell."""

from __future__ import annotations

import torch
from torch import Tensor

PIXELS = 3
"""Pixels along a side of a cell."""
DRONE = ((0.0, 1.0, 0.0), (1.0, 1.0, 1.0), (0.0, 1.0, 0.0))
POACHER = ((1.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 1.0))
"""A plus and a cross: both are the same after every turn and mirror of the square."""


def all_pictures(width: int, height: int) -> Tensor:
    """Return every picture that a drone can see, one for each cell that the poacher may be in.

    Args:
        width: odd number of columns of cells.
        height: odd number of rows.

    Returns:
        [height * width, 9 * height * width]: picture k has the poacher in the cell k of `cell_index`. A poacher below
        the drone hides it.
    """
    pictures = torch.zeros(height, width, PIXELS * height, PIXELS * width)
    _stamp(pictures, (height // 2, width // 2), DRONE)
    for row in range(height):
        for column in range(width):
            _stamp(pictures[row, column], (row, column), POACHER)
    return pictures.flatten(2).flatten(0, 1)


def cell_index(offset: Tensor, width: int, height: int) -> Tensor:
    """Return which picture shows the poacher at an offset.

    Args:
        offset: [..., 2] int64, x and y of the poacher minus the drone's, within half the grid to either side.
        width: of the grid.
        height: likewise; the picture's first row shows the largest y.

    Returns:
        [...] int64.
    """
    column, row = offset[..., 0] + width // 2, height // 2 - offset[..., 1]
    return row * width + column


def _stamp(picture: Tensor, cell: tuple[int, int], stamp: tuple[tuple[float, ...], ...]) -> None:
    row, column = (PIXELS * k for k in cell)
    picture[..., row : row + PIXELS, column : column + PIXELS] = torch.tensor(stamp)
