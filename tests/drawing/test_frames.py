"""Frames: caption, axes and legend stand around the picture, which stays as it is."""

import numpy as np
import pytest

from esp_cli.drawing import films as frames
from esp_cli.drawing.films import Mark, frame, marks
from esp_cli.drawing.recording import Episode
from esp_envs import Body, Scene
from esp_envs.drawing import TopPainter, draw
from tests.drawing.scenes import BLUE, GREEN, RED, WINDOW


def scene(*bodies: Body, unit: str = "m") -> Scene:
    return Scene(bodies, WINDOW, unit=unit)


TEAM = scene(Body((0.0, 0.5), 0.1, RED, label="robot"), Body((0.5, 0.0), 0.1, GREEN, "ring", label="goal"))


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    texts: list[str] = []
    write = frames.ImageDraw.ImageDraw.text
    frames._legend.cache_clear()

    def remember(self, place, said, *rest, **options) -> None:
        texts.append(said)
        write(self, place, said, *rest, **options)

    monkeypatch.setattr(frames.ImageDraw.ImageDraw, "text", remember)
    return texts


def test_the_caption_says_task_episode_time_and_return(written: list[str]) -> None:
    frame(TopPainter(240), [Episode([TEAM], [-3.14])], "task, episode 1 of 2", 1.25)
    assert "task, episode 1 of 2" in written
    assert "1.2 s, return -3.1" in written


def test_the_legend_names_what_has_a_label_and_the_axes_their_unit(written: list[str]) -> None:
    frame(TopPainter(240), [Episode([TEAM], [0.0])], "", 0.0)
    assert {"robot", "goal", "axes in m"} <= set(written)
    assert {"-1", "-0.5", "0", "0.5", "1"} <= set(written)
    written.clear()
    frames._legend.cache_clear()
    frame(TopPainter(240), [Episode([scene(Body((0.0, 0.0), 0.1, RED), unit="")], [0.0])], "", 0.0)
    assert "robot" not in written
    assert not [text for text in written if text.startswith("axes")]


def test_the_picture_itself_stays_as_it_is() -> None:
    shown = frame(TopPainter(240), [Episode([TEAM], [0.0])], "task", 0.0)
    picture = draw(TEAM, 240)
    assert shown.shape[0] > 240 + 30
    assert shown.shape[1] > 240
    corners = [
        (row, column)
        for row in range(shown.shape[0] - 239)
        for column in range(shown.shape[1] - 239)
        if np.array_equal(shown[row : row + 240, column : column + 240], picture)
    ]
    assert len(corners) == 1


def test_two_worlds_stand_side_by_side_with_their_names(written: list[str]) -> None:
    other = scene(Body((-0.5, -0.5), 0.1, BLUE, label="robot"))
    episodes = [Episode([TEAM], [1.0], name="plain"), Episode([other], [2.0], name="esp")]
    shown = frame(TopPainter(240), episodes, "task", 0.5)
    assert {"plain", "esp", "return 1.0", "return 2.0", "0.5 s"} <= set(written)
    alone = frame(TopPainter(240), episodes[:1], "task", 0.5)
    assert shown.shape[1] == 2 * alone.shape[1] + 8


def test_a_view_in_space_tells_the_size_of_its_floor(written: list[str]) -> None:
    class Space:
        note = None

        def draw(self, scene, trail=()):
            return np.full((180, 240, 3), 100, dtype=np.uint8)

    shown = frame(Space(), [Episode([TEAM], [0.0])], "task", 0.0)
    assert "floor 2 x 2 m" in written
    assert "0.5" not in written, "perspective has no axes"
    assert shown.shape[1] == 240


def test_a_picture_too_narrow_for_text_has_none(written: list[str]) -> None:
    shown = frame(TopPainter(100), [Episode([TEAM], [0.0])], "task", 0.0)
    assert np.array_equal(shown, draw(TEAM, 100))
    assert written == []


def test_marks_have_the_colours_of_their_bodies() -> None:
    bodies = [Body((0.0, 0.1 * k), 0.1, color, label="robot") for k, color in enumerate((RED, BLUE, GREEN))]
    found = marks(scene(*bodies, Body((0.5, 0.5), 0.1, BLUE, "cross", label="landmark"), Body((0.9, 0.9), 0.1, RED)))
    assert found == (Mark("robot", "disc", (RED, BLUE)), Mark("landmark", "cross", (BLUE,)))


def test_marks_in_the_legend_have_their_shapes_and_colours() -> None:
    def shades(shape: str, *colors: str) -> set[tuple[int, ...]]:
        legend = frames._legend((Mark("", shape, colors),), 120, 20, "")
        return {tuple(color) for color in legend.reshape(-1, 3).tolist()}

    assert {(255, 0, 0), (0, 0, 255)} <= shades("disc", RED, BLUE)
    assert (0, 0, 255) not in shades("disc", RED)
    disc, ring = (frames._legend((Mark("", shape, (RED,)),), 120, 20, "") for shape in ("disc", "ring"))
    assert (ring == (255, 0, 0)).all(-1).sum() < (disc == (255, 0, 0)).all(-1).sum()
    for shape in ("square", "cross"):
        assert (255, 0, 0) in shades(shape, RED)


def test_numbers_along_an_axis_keep_apart() -> None:
    assert frames._ticks(-1.0, 1.0, 0.5, 100, 13) == [-1, -0.5, 0, 0.5, 1]
    assert frames._ticks(-1.0, 1.0, 0.5, 40, 13) == [-1, 0, 1]
    assert frames._ticks(-3.5, 3.5, 1.0, 60, 13) == [-3, -2, -1, 0, 1, 2, 3]


def test_the_end_of_an_episode_is_white_on_dark_and_says_how_it_ended(written: list[str]) -> None:
    going, ended = (frame(TopPainter(240), [Episode([TEAM], [1.0], end)], "task", 0.5) for end in ("", "end: captured"))
    assert {"0.5 s, return 1.0", "0.5 s, return 1.0, end: captured"} <= set(written)
    assert (going[1, 1] > 250).all()
    assert (ended[1, 1] < 50).all()


def test_what_is_covered_is_ringed_and_named(written: list[str]) -> None:
    landmark = Body((0.0, 0.0), 0.1, BLUE, "cross", reach=0.2, held="covered")
    near, far = (scene(Body((0.0, y), 0.1, RED, trail=True), landmark) for y in (0.19, 0.2))
    rings = [(draw(one, 240)[120, 140:150] < 60).all(-1).sum() for one in (near, far)]  # to the right of the cross
    assert rings[0] > 0
    assert rings[1] == 0
    frame(TopPainter(240), [Episode([near], [0.0])], "", 0.0)
    assert "covered" in written


def test_agents_have_letters_on_them_or_beside_them() -> None:
    def letters(radius: float, name: str = "A", **nose: float) -> set[tuple[int, int]]:
        pictures = (draw(scene(Body((0.0, 0.0), radius, BLUE, name=n, **nose)), 240) for n in (name, ""))
        rows, columns = np.nonzero(np.not_equal(*pictures).any(-1))
        return set(zip((rows - 120).tolist(), (columns - 120).tolist(), strict=True))

    on, small, nose = letters(0.2), letters(0.02), letters(0.2, heading=0.0)
    assert on
    assert all(max(abs(row), abs(column)) < 0.2 * 120 for row, column in on)
    for beside in (small, nose):
        assert beside
        assert all(row < 0 < column for row, column in beside)
    assert not letters(0.2, "")


def test_the_size_of_the_floor_is_told_where_it_is_known() -> None:
    pixels = np.zeros((48, 64, 3), np.uint8)
    assert frames._scale(Scene((), (-1, 1, -2, 2), unit="m"), flat=False) == "floor 2 x 4 m"
    assert frames._scale(Scene((), (0, 64, 0, 48), picture=pixels), flat=False) == ""
