"""Pictures of a scene, drawn with Pillow: no display and no graphics library needed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageColor, ImageDraw, ImageFont

from esp_envs.errors import UserError
from esp_envs.scene import DARK, Body, Scene, holders

_OVERSAMPLING = 3  # everything is drawn this much larger and averaged down, which smooths the edges
BACKGROUND = "#fafaf7"
GRID = "#e4e4de"
FRAME = "#c8c8c0"
_RIM_DARKENING = 0.7
TRAIL_WIDTH = 0.3  # width of a trail against the body's radius
_TRAIL_STRENGTH = 0.8  # how much of the body's colour the newest end of a trail has; the oldest has almost none
_LEAST_LETTER, _MOST_LETTER = 6.0, 18.0  # radius of a disc that a letter fits on, height of the largest letter, pixels
_SHAPES = ("disc", "ring", "cross", "square")

_Color = tuple[int, ...]
Point = tuple[float, float]


def draw(scene: Scene, size: int = 320, trail: Sequence[Scene] = ()) -> NDArray[np.uint8]:
    """Draw one scene as a picture [H, W, 3] uint8, red, green and blue; the first row is the top.

    Args:
        scene: what to draw.
        size: pixels of the longer side; the other follows from the scene's window.
        trail: earlier scenes of the same world, oldest first; bodies that leave a trail get one.
    """
    x_min, x_max, y_min, y_max = scene.window
    if size < 16 or x_max <= x_min or y_max <= y_min:
        raise UserError(f"cannot draw the window {scene.window} on {size} pixels; use a real window and 16 or more")
    if scene.picture is not None:
        whole = Image.fromarray(scene.picture)
        share = size / max(whole.size)
        return np.asarray(whole.resize((max(1, round(whole.width * share)), max(1, round(whole.height * share)))))
    canvas = _Canvas(scene.window, size)
    canvas.grid(*scene.grid)
    for body, path in trails(scene, trail):
        canvas.trail(path, body)
    for body in scene.bodies:
        canvas.body(body)
    for index in holders(scene):
        canvas.ring(scene.bodies[index])
    for body in scene.bodies:
        canvas.letter(body)
    return canvas.pixels()


class TopPainter:
    """Draws scenes from above, `size` pixels on the longer side; `note` tells the user why it draws."""

    def __init__(self, size: int, note: str | None = None) -> None:
        self._size, self.note = size, note

    def draw(self, scene: Scene, trail: Sequence[Scene] = ()) -> NDArray[np.uint8]:
        return draw(scene, self._size, trail)


def trails(scene: Scene, earlier: Sequence[Scene]) -> Iterator[tuple[Body, list[Point]]]:
    """Yield every body that leaves a trail with the way it has come: its position in each earlier scene and in this."""
    for index, body in enumerate(scene.bodies):
        if body.trail and earlier:
            path = [past.bodies[index].position for past in earlier if index < len(past.bodies)]
            yield body, [*path, body.position]


@lru_cache(maxsize=8)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the font of all pictures at a height of letters in pixels."""
    return ImageFont.load_default(size)


def ink(color: str) -> str:
    """Return the colour of letters that are read on a colour: white or dark."""
    red, green, blue = ImageColor.getrgb(color)[:3]
    return "white" if 0.3 * red + 0.59 * green + 0.11 * blue < 140 else DARK


def fade(color: str, share: float) -> tuple[int, ...]:
    """Return red, green and blue, 0 to 255, of a piece of trail: `share` is 0 at its oldest end, 1 at its newest."""
    return _mix(ImageColor.getrgb(BACKGROUND), ImageColor.getrgb(color), _TRAIL_STRENGTH * share)


class _Canvas:
    """An oversampled picture with world coordinates."""

    def __init__(self, window: tuple[float, float, float, float], size: int) -> None:
        self._window = window
        x_min, x_max, y_min, y_max = window
        per_unit = size / max(x_max - x_min, y_max - y_min)
        self._size = (max(1, round((x_max - x_min) * per_unit)), max(1, round((y_max - y_min) * per_unit)))
        self._scale = per_unit * _OVERSAMPLING
        width, height = (side * _OVERSAMPLING for side in self._size)
        self._image = Image.new("RGB", (width, height), BACKGROUND)
        self._draw = ImageDraw.Draw(self._image)

    def grid(self, spacing: float, offset: float) -> None:
        x_min, x_max, y_min, y_max = self._window
        lines = [((x, y_min), (x, y_max)) for x in grid_lines(x_min, x_max, spacing, offset)]
        for line in (*lines, *(((x_min, y), (x_max, y)) for y in grid_lines(y_min, y_max, spacing, offset))):
            self._line(line, GRID, _OVERSAMPLING)
        width, height = self._image.size
        self._draw.rectangle((0, 0, width - 1, height - 1), outline=FRAME, width=_OVERSAMPLING)

    def trail(self, path: Sequence[Point], body: Body) -> None:
        width = max(1, round(body.radius * TRAIL_WIDTH * self._scale))
        pieces = len(path) - 1
        for k in range(pieces):
            color = fade(body.color, (k + 1) / pieces)
            self._line([path[k], path[k + 1]], color, width)
            x, y = self._at(path[k + 1])
            self._draw.ellipse(_box(x, y, width / 2), fill=color)

    def body(self, body: Body) -> None:
        if body.shape not in _SHAPES:
            raise UserError(f"cannot draw a body of shape '{body.shape}'; the shapes are {', '.join(_SHAPES)}")
        x, y = self._at(body.position)
        radius = body.radius * self._scale
        color = ImageColor.getrgb(body.color)
        rim, thin = _mix((0, 0, 0), color, _RIM_DARKENING), _OVERSAMPLING
        thick = max(thin, round(radius * 0.35))
        if body.shape == "disc":
            self._draw.ellipse(_box(x, y, radius), fill=color, outline=rim, width=thin)
        elif body.shape == "ring":
            self._draw.ellipse(_box(x, y, radius), outline=color, width=thick)
        elif body.shape == "square":
            self._draw.rectangle(_box(x, y, radius), fill=color, outline=rim, width=thin)
        else:
            for dy in (-radius, radius):
                self._draw.line([(x - radius, y - dy), (x + radius, y + dy)], fill=color, width=thick)
        if body.heading is not None:
            tip = (x + radius * math.cos(body.heading), y - radius * math.sin(body.heading))
            self._draw.line([(x, y), tip], fill=rim, width=thick)

    def ring(self, body: Body) -> None:
        """Ring a body in black and white, which shows on every colour."""
        (x, y), thin = self._at(body.position), _OVERSAMPLING
        radius = max(2 * body.radius * self._scale, 3 * thin)
        self._draw.ellipse(_box(x, y, radius), outline=DARK, width=2 * thin)
        self._draw.ellipse(_box(x, y, radius - 2 * thin), outline="white", width=thin)

    def letter(self, body: Body) -> None:
        """Write the letter of a body on it, or beside it where it would not be read there."""
        (x, y), radius = self._at(body.position), body.radius * self._scale
        if not body.name:
            return
        if body.shape == "disc" and body.heading is None and radius >= _LEAST_LETTER * _OVERSAMPLING:
            size = min(1.2 * radius, _MOST_LETTER * _OVERSAMPLING)
            self._draw.text((x, y), body.name, ink(body.color), font(round(size)), anchor="mm")
        else:
            beside, edge = 0.8 * radius + 5 * _OVERSAMPLING, 7 * _OVERSAMPLING
            width, height = self._image.size
            x += -beside if body.shape == "ring" else beside
            at = (min(max(x, edge), width - edge), min(max(y - beside, edge), height - edge))
            self._draw.text(at, body.name, DARK, font(11 * _OVERSAMPLING), anchor="mm")

    def pixels(self) -> NDArray[np.uint8]:
        return np.asarray(self._image.resize(self._size, Image.Resampling.BOX), dtype=np.uint8).copy()

    def _line(self, points: Sequence[Point], color: str | _Color, width: int) -> None:
        self._draw.line([self._at(point) for point in points], fill=color, width=width)

    def _at(self, point: Point) -> Point:
        """Return the pixel of a world point; y points up in the world and down in the picture."""
        return (point[0] - self._window[0]) * self._scale, (self._window[3] - point[1]) * self._scale


def grid_lines(low: float, high: float, spacing: float, offset: float = 0.0) -> list[float]:
    """Return where lines of a grid lie between two bounds, one of them at an offset."""
    first, last = math.ceil((low - offset) / spacing - 1e-9), math.floor((high - offset) / spacing + 1e-9)
    return [k * spacing + offset for k in range(first, last + 1)]


def _box(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
    return x - radius, y - radius, x + radius, y + radius


def _mix(first: _Color, second: _Color, share: float) -> _Color:
    return tuple(round(a + (b - a) * share) for a, b in zip(first[:3], second[:3], strict=True))
