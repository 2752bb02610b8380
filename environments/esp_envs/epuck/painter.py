"""The way to the view in space: it imports MuJoCo when the first picture is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from esp_envs.epuck.gl import NoGraphicsError, forget_missing_backend
from esp_envs.scene import Painter


@contextmanager
def open_painter(size: int) -> Iterator[Painter]:
    """Open a painter of scenes in space; see `esp_envs.epuck.view`.

    Args:
        size: width of a picture, pixels.

    Raises:
        NoGraphicsError: MuJoCo is not installed, or no library here can draw.
    """
    forget_missing_backend()
    try:
        from esp_envs.epuck.view import space_painter  # noqa: PLC0415
    except ImportError as error:
        raise NoGraphicsError(f"a view in space needs the package {error.name}; pip install {error.name}") from None
    with space_painter(size) as painter:
        yield painter
