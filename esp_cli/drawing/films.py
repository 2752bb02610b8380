"""Frames of films with caption, axes and legend, and films and pictures as files, each written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from imageio.v2 import get_writer
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from esp_cli.drawing.recording import Episode
from esp_cli.files.writing import write_file
from esp_envs.drawing import TopPainter, font, grid_lines
from esp_envs.scene import DARK, Painter, Scene

Frame = NDArray[np.uint8]
LEAST_WIDTH = 200  # pixels; narrower pictures have no room for text
_PAPER, _TEXT, _FAINT = "#ffffff", "#202020", "#606060"
_FONT_SHARE, _LEAST_FONT = 1 / 37, 10  # height of letters against the width of a picture, and the smallest, pixels
_BAR, _TICKS, _SIDE = 2.0, 1.5, 2.6  # height of a bar of text, of the numbers below, width of those beside, in letters
_OVERSAMPLING = 3
_GAP = 8  # pixels between two pictures
GIF_FRAMES_PER_SECOND = 50  # players slow down a GIF that is faster


@dataclass(frozen=True)
class Mark:
    """An entry of a legend; bodies of several colours have two of them in their mark."""

    label: str
    shape: str
    colors: tuple[str, ...]


def marks(scene: Scene) -> tuple[Mark, ...]:
    """Return what the bodies of a scene are called, in their order."""
    by_label: dict[str, Mark] = {}
    for body in scene.bodies:
        if body.label is not None:
            known = by_label.get(body.label, Mark(body.label, body.shape, (body.color,)))
            colors = tuple(dict.fromkeys((*known.colors, body.color)))[:2]
            by_label[body.label] = Mark(body.label, known.shape, colors)
    return tuple(by_label.values())


def frame(painter: Painter, episodes: Sequence[Episode], left: str, time_s: float) -> Frame:
    """Draw one world, or two side by side, with axes, a legend, and a caption that ends with the time."""
    scene = episodes[0].scenes[-1]
    pictures = [painter.draw(episode.scenes[-1], episode.scenes[:-1]) for episode in episodes]
    width = pictures[0].shape[1]
    if width < LEAST_WIDTH:
        return beside(pictures, 0)
    size, flat = max(_LEAST_FONT, round(width * _FONT_SHARE)), isinstance(painter, TopPainter)
    flat = flat and scene.picture is None
    if flat:
        pictures = [_with_axes(picture, own.scenes[-1], size) for picture, own in zip(pictures, episodes, strict=True)]
    time, end = f"{time_s:.1f} s", ""
    if len(episodes) > 1:
        named = [_bar(p.shape[1], size, str(m.name), _total(m), m.end) for p, m in zip(pictures, episodes, strict=True)]
        pictures = [np.concatenate(parts) for parts in zip(named, pictures, strict=True)]
    else:
        time, end = f"{time}, {_total(episodes[0])}", episodes[0].end
    body = beside(pictures, _GAP)
    held = dict.fromkeys(Mark(body.held, "ring", (DARK,)) for body in scene.bodies if body.reach is not None)
    legend = _legend((*marks(scene), *(held if flat else ())), body.shape[1], size, _scale(scene, flat))
    return np.concatenate([_bar(body.shape[1], size, left, time, end), body, legend])


def beside(pictures: Sequence[Frame], gap: int) -> Frame:
    """Put pictures of any height side by side, with a gap in pixels between them."""
    height = max(map(len, pictures))
    margins = [(gap * (k > 0), height - len(picture)) for k, picture in enumerate(pictures)]
    padded = [
        np.pad(picture, ((0, below), (left, 0), (0, 0)), constant_values=255)
        for picture, (left, below) in zip(pictures, margins, strict=True)
    ]
    return np.concatenate(padded, axis=1)


def write_gif(path: Path, frames: Iterable[Frame], seconds: Sequence[float], sample: Sequence[Frame]) -> None:
    """Write frames [H, W, 3] of one size, each in view for some seconds, as an endless GIF in `sample`'s colours."""
    plain: dict[str, Any] = {"method": Image.Quantize.FASTOCTREE, "dither": Image.Dither.NONE}
    palette = Image.fromarray(np.concatenate(sample)).quantize(**plain)
    shown = (Image.fromarray(frame).quantize(palette=palette, **plain) for frame in frames)
    content = BytesIO()
    durations = _milliseconds(seconds)
    next(shown).save(content, "GIF", save_all=True, append_images=shown, duration=durations, loop=0)
    write_file(path, content.getvalue())


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


def _total(episode: Episode) -> str:
    return f"return {episode.returns[-1]:.1f}"


def _scale(scene: Scene, flat: bool) -> str:
    if flat:
        return f"axes in {scene.unit}" if scene.unit else ""
    if scene.picture is not None:  # whose window is counted in pixels
        return ""
    x_min, x_max, y_min, y_max = scene.window
    return f"floor {x_max - x_min:g} x {y_max - y_min:g} {scene.unit}"


def _bar(width: int, size: int, left: str, right: str, end: str = "") -> Frame:
    """Write a line of text; at an end it is white on dark and says so."""
    paper, text = (_TEXT, _PAPER) if end else (_PAPER, _TEXT)
    image = Image.new("RGB", (width, round(_BAR * size)), paper)
    draw, middle = ImageDraw.Draw(image), image.height / 2
    draw.text((size / 2, middle), left, text, font(size), anchor="lm")
    draw.text((width - size / 2, middle), ", ".join(filter(None, (right, end))), text, font(size), anchor="rm")
    return np.asarray(image)


@lru_cache(maxsize=8)
def _legend(entries: tuple[Mark, ...], width: int, size: int, note: str) -> Frame:
    fine = size * _OVERSAMPLING
    image = Image.new("RGB", (width * _OVERSAMPLING, round(_BAR * size) * _OVERSAMPLING), _PAPER)
    draw, letters = ImageDraw.Draw(image), font(fine)
    x, y, r = fine / 2, image.height / 2, 0.4 * fine
    for mark in entries:
        _draw_mark(draw, mark, (x, y - r, x + 2 * r, y + r))
        draw.text((x + 2.6 * r, y), mark.label, _TEXT, letters, anchor="lm")
        x += 2.6 * r + draw.textlength(mark.label, letters) + fine
    draw.text((image.width - fine / 2, y), note, _FAINT, letters, anchor="rm")
    return np.asarray(image.resize((width, image.height // _OVERSAMPLING), Image.Resampling.BOX))


def _draw_mark(draw: ImageDraw.ImageDraw, mark: Mark, box: tuple[float, float, float, float]) -> None:
    """Draw a mark into a box; two colours share a disc or a ring."""
    left, top, right, bottom = box
    first, second, thick = mark.colors[0], mark.colors[-1], round(0.18 * (right - left))
    if mark.shape == "disc":
        draw.pieslice(box, 90, 270, fill=first)
        draw.pieslice(box, -90, 90, fill=second)
    elif mark.shape == "ring":
        draw.arc(box, 90, 270, fill=first, width=thick)
        draw.arc(box, -90, 90, fill=second, width=thick)
    elif mark.shape == "square":
        draw.rectangle(box, fill=first)
    else:
        draw.line([(left, top), (right, bottom)], fill=first, width=thick)
        draw.line([(left, bottom), (right, top)], fill=first, width=thick)


def _with_axes(picture: Frame, scene: Scene, size: int) -> Frame:
    """Add numbers at the left and below, where lines of the grid are or, of cells, their middles."""
    x_min, x_max, y_min, y_max = scene.window
    height, width = picture.shape[:2]
    side, below = round(_SIDE * size), round(_TICKS * size)
    image = Image.new("RGB", (width + side, height + below), _PAPER)
    image.paste(Image.fromarray(picture), (side, 0))
    draw, letters, scale = ImageDraw.Draw(image), font(size), width / (x_max - x_min)
    for x in _ticks(x_min, x_max, scene.grid[0], scale, size):
        place = min(side + (x - x_min) * scale, side + width - 0.8 * size)
        draw.text((place, height + below / 2), f"{x:g}", _FAINT, letters, anchor="mm")
    for y in _ticks(y_min, y_max, scene.grid[0], scale, size):
        place = min(max((y_max - y) * scale, 0.6 * size), height - 0.6 * size)
        draw.text((side - 0.4 * size, place), f"{y:g}", _FAINT, letters, anchor="rm")
    return np.asarray(image)


def _ticks(low: float, high: float, spacing: float, scale: float, size: int) -> list[float]:
    step = spacing
    while step * scale < 3 * size:
        step *= 2
    return grid_lines(low, high, step)


def _milliseconds(seconds: Sequence[float]) -> list[int]:
    """Round to the hundredths that a GIF knows, so that the errors do not add up."""
    hundredths = np.diff(np.rint(100 * np.cumsum(seconds)), prepend=0)
    return [10 * int(count) for count in np.maximum(hundredths, 100 // GIF_FRAMES_PER_SECOND)]
