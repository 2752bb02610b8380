"""Films and pictures as files: GIF, MP4 and PNG, each written whole or not at all.

imageio writes MP4 and PNG. The GIFs are made here: with one palette for a whole film, and without pixels that do not
change, they are smaller than imageio's at the same fidelity.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import imageio.v3 as iio
import numpy as np
from imageio.v2 import get_writer
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import cKDTree

from esp_cli.files.writing import write_file

Frame = NDArray[np.uint8]

GIF_FRAMES_PER_SECOND = 50  # players slow down a GIF that is faster
_GIF_TICK_S = 0.01
_COLORS = 255  # colours of a GIF; one more marks what has not changed since the frame before
_EXACT_COLORS = 64


def write_gif(path: Path, frames: Iterable[Frame], seconds: Sequence[float], sample: Sequence[Frame]) -> None:
    """Write frames as an endlessly repeated GIF.

    Args:
        path: where to.
        frames: [H, W, 3] each, all of one size; taken one after the other, so they need not all be in memory.
        seconds: how long each frame is in view.
        sample: some of the frames, which the one palette of the film is made for.
    """
    palette = _palette(sample)
    reduced = _reduced(frames, palette)
    content = BytesIO()
    next(reduced).save(
        content,
        "GIF",
        save_all=True,
        append_images=reduced,
        duration=_milliseconds(seconds),
        loop=0,
        optimize=True,
        transparency=_COLORS,
        palette=palette.tobytes().ljust(3 * 256, b"\0"),
    )
    write_file(path, content.getvalue())


def _milliseconds(seconds: Sequence[float]) -> list[int]:
    """Round to the hundredths that a GIF knows, so that the errors do not add up."""
    shortest = round(1 / (GIF_FRAMES_PER_SECOND * _GIF_TICK_S))
    ends = np.cumsum(seconds) / _GIF_TICK_S
    ticks, shown = [], 0
    for end in ends:
        ticks.append(max(shortest, round(end) - shown))
        shown += ticks[-1]
    return [round(tick * _GIF_TICK_S * 1000) for tick in ticks]


def _palette(sample: Sequence[Frame]) -> Frame:
    """Return up to 255 colours for some frames: the most frequent as they are, the others by how they differ.

    A small robot has few pixels, so the others count once each, however many pixels they have.
    """
    codes, counts = np.unique(np.concatenate([_codes(frame).ravel() for frame in sample]), return_counts=True)
    colors = _colors(codes[np.argsort(-counts, kind="stable")])
    frequent, others = colors[:_EXACT_COLORS], colors[_EXACT_COLORS:]
    if len(others):
        grouped = Image.fromarray(others[None]).quantize(_COLORS - _EXACT_COLORS).getpalette() or []
        others = np.array(grouped, dtype=np.uint8).reshape(-1, 3)[: _COLORS - _EXACT_COLORS]
    return np.concatenate([frequent, others])


def _reduced(frames: Iterable[Frame], palette: Frame) -> Iterator[Image.Image]:
    """Yield each frame in the nearest colours of the palette (Pillow's own search is off by some levels)."""
    nearest = cKDTree(palette.astype(np.float64))
    table = np.full(1 << 24, -1, dtype=np.int16)  # of all colours, filled as they are met
    for frame in frames:
        codes = _codes(frame)
        new = np.unique(codes[table[codes] < 0])
        if len(new):
            table[new] = nearest.query(_colors(new).astype(np.float64))[1]
        image = Image.fromarray(table[codes].astype(np.uint8))
        image.putpalette(palette.tobytes())
        yield image


def _codes(frame: Frame) -> NDArray[np.uint32]:
    """Return one number per pixel."""
    red, green, blue = np.moveaxis(frame.astype(np.uint32), -1, 0)
    return red << 16 | green << 8 | blue


def _colors(codes: NDArray[np.uint32]) -> Frame:
    """Return [K, 3] the colours behind numbers [K]."""
    return np.stack([codes >> 16, codes >> 8 & 255, codes & 255], -1).astype(np.uint8)


def write_mp4(path: Path, frames: Iterable[Frame], frames_per_second: float) -> None:
    """Write frames as an MP4."""
    with TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        options: dict[str, Any] = {"fps": frames_per_second, "macro_block_size": 2, "ffmpeg_log_level": "error"}
        writer: Any = get_writer(film, format="FFMPEG", mode="I", **options)
        with writer:
            for frame in frames:
                odd = [(0, size % 2) for size in frame.shape[:2]]  # the format asks for even sizes
                writer.append_data(np.pad(frame, (*odd, (0, 0)), mode="edge"))
        write_file(path, film.read_bytes())


def write_png(path: Path, picture: Frame) -> None:
    """Write one picture."""
    write_file(path, iio.imwrite("<bytes>", picture, extension=".png"))
