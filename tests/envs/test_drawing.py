"""Pictures: colours where bodies are, y upwards, trails that fade, and a real format."""

import numpy as np
import pytest

from esp_envs import Body, Scene
from esp_envs.drawing import BACKGROUND, TopPainter, draw, fade, trails

WINDOW = (-1.0, 1.0, -1.0, 1.0)
RED, BLUE = "#ff0000", "#0000ff"


def pixel(picture: np.ndarray, x: float, y: float) -> list[int]:
    """Return the colour at a world point of a 2 x 2 window."""
    size = len(picture)
    return picture[round((1 - y) / 2 * (size - 1)), round((x + 1) / 2 * (size - 1))].tolist()


def test_bodies_lie_where_they_should_and_y_points_up() -> None:
    scene = Scene((Body((0.5, 0.5), 0.2, RED), Body((-0.5, -0.5), 0.2, BLUE, shape="square")), WINDOW)
    picture = draw(scene, 200)
    assert picture.shape == (200, 200, 3)
    assert picture.dtype == np.uint8
    assert pixel(picture, 0.5, 0.5) == [255, 0, 0]
    assert pixel(picture, -0.5, -0.5) == [0, 0, 255]
    assert pixel(picture, -0.55, 0.6) == pixel(draw(Scene((), WINDOW), 200), -0.55, 0.6)
    picture[:] = 0
    assert pixel(draw(scene, 200), 0.5, 0.5) == [255, 0, 0], "the picture is the caller's own"
    assert draw(Scene((), (0.0, 4.0, 0.0, 1.0)), 200).shape == (50, 200, 3)
    round_body = draw(Scene((Body((0.0, 0.0), 0.7, "#000000"),), WINDOW), 100)
    assert len(np.unique(round_body[:, 20], axis=0)) > 8, "edges are smooth"


def test_shapes_differ() -> None:
    pictures = [draw(Scene((Body((0.0, 0.0), 0.4, RED, shape=shape),), WINDOW)) for shape in ("disc", "ring", "cross")]
    assert [pixel(p, 0.0, 0.3) == [255, 0, 0] for p in pictures] == [True, True, False]
    assert [pixel(p, 0.0, 0.02) == [255, 0, 0] for p in pictures] == [True, False, True]
    with pytest.raises(ValueError, match="blob"):
        draw(Scene((Body((0.0, 0.0), 0.4, RED, shape="blob"),), WINDOW))


def test_the_nose_points_along_the_heading() -> None:
    picture = draw(Scene((Body((0.0, 0.0), 0.4, RED, heading=np.pi / 2),), WINDOW))
    assert pixel(picture, 0.0, 0.25) != [255, 0, 0]
    assert pixel(picture, 0.25, 0.0) == [255, 0, 0]


def test_trails_fade_towards_their_beginning() -> None:
    path = [(-0.8, 0.1), (-0.4, 0.1), (0.0, 0.1), (0.4, 0.1), (0.8, 0.1)]
    scenes = [Scene((Body(p, 0.1, RED, trail=True),), WINDOW) for p in path]
    picture = draw(scenes[-1], trail=scenes[:-1])
    old, new = pixel(picture, -0.6, 0.1), pixel(picture, 0.6, 0.1)
    assert new[1] < old[1] < 240, "red grows at the cost of green"
    plain = draw(Scene((Body(path[-1], 0.1, RED),), WINDOW), trail=scenes[:-1])
    assert pixel(plain, 0.6, 0.1)[1] > 240, "a body that leaves no trail has none"


def test_trails_are_the_ways_of_the_bodies_that_leave_one() -> None:
    still = Body((0.5, 0.5), 0.1, BLUE)
    scenes = [Scene((still, Body((0.1 * k, 0.0), 0.1, RED, trail=True)), WINDOW) for k in range(3)]
    assert list(trails(scenes[-1], scenes[:-1])) == [(scenes[-1].bodies[1], [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)])]
    assert list(trails(scenes[-1], ())) == []
    assert BACKGROUND == "#fafaf7"
    assert fade(RED, 0.0) == (0xFA, 0xFA, 0xF7)
    assert fade(RED, 0.5) == (252, 150, 148)
    assert fade(RED, 1.0) == (254, 50, 49)  # 250 + 0.8 (255 - 250), 250 - 0.8 x 250, 247 - 0.8 x 247


def test_the_painter_draws_the_same_as_the_function() -> None:
    scenes = [Scene((Body((0.1 * k, 0.0), 0.1, RED, trail=True),), WINDOW) for k in range(3)]
    painter = TopPainter(100, note="no space here")
    assert np.array_equal(painter.draw(scenes[2], scenes[:2]), draw(scenes[2], 100, scenes[:2]))
    assert np.array_equal(painter.draw(scenes[2]), draw(scenes[2], 100))
    assert (painter.note, TopPainter(100).note) == ("no space here", None)


@pytest.mark.parametrize(("window", "size"), [((0.0, 0.0, 0.0, 1.0), 100), (WINDOW, 3)])
def test_nothing_to_draw_on_is_refused(window: tuple[float, float, float, float], size: int) -> None:
    with pytest.raises(ValueError, match="cannot draw"):
        draw(Scene((), window), size)


@pytest.mark.parametrize(
    ("shape", "drawn"), [((1, 1000, 3), (1, 64, 3)), ((1000, 1, 3), (64, 1, 3)), ((48, 64, 3), (48, 64, 3))]
)
def test_a_foreign_picture_keeps_its_shape_and_at_least_a_pixel(shape, drawn):
    picture = np.zeros(shape, np.uint8)
    assert draw(Scene((), (0, shape[1], 0, shape[0]), picture=picture), 64).shape == drawn
