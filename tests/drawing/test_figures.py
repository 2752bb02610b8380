"""Still pictures: paths where they went, who covers what when, and the last steps side by side."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from esp_cli.drawing.figures import coverage, paths, strip, summary
from esp_envs import Body, Scene
from tests.drawing.scenes import BLUE, GREEN, RED, WINDOW, episode, line


def figure_of(way, scenes, period_s=0.1):
    """Return an episode drawn in one way, 600 pixels wide and high."""
    figure = Figure(figsize=(4.8, 4.8), dpi=125, layout="constrained")
    way(figure.subfigures(), episode(scenes), "title", period_s)
    return figure


def drawn(figure):
    """Return the picture of a figure and a function from a point of the world to its colour."""
    content = BytesIO()
    figure.savefig(content, format="png", dpi=125)
    picture = np.asarray(Image.open(content).convert("RGB")).astype(int)

    def color(x, y):
        column, above = figure.axes[0].transData.transform((x, y))
        return picture[len(picture) - 1 - int(above), int(column)].tolist()

    return picture, color


def test_paths_are_drawn_where_they_went_more_opaque_with_time():
    picture, color = drawn(figure_of(paths, line()))
    assert picture.shape == (600, 600, 3)
    early, middle, late = (color(x, -0.6) for x in (-0.65, 0.05, 0.62))
    assert all(found[0] == 255 and found[1] == found[2] for found in (early, middle, late)), "red on white"
    assert 235 > early[1] > middle[1] + 40 > late[1] + 80
    assert color(0.1, -0.3) == [255, 255, 255]
    _, color = drawn(figure_of(paths, line(trail=False)))
    assert color(0.05, -0.6) == [255, 255, 255], "a body that leaves no trail has none"


def test_a_strip_takes_bodies_that_come_and_go():
    start, *others, end = line(4, trail=False)
    more = replace(end, bodies=(*end.bodies, Body((0.0, 0.0), 0.2, GREEN)))
    figure = figure_of(strip, [start, *others, more, end])
    patches = [len(axes.patches) for axes in figure.axes if axes.axison]
    assert patches == [2, 2, 2, 3, 2]


def test_paths_show_the_start_the_end_and_what_stands():
    _, color = drawn(figure_of(paths, line()))
    assert color(-0.8, -0.6) == [255, 0, 0], "the mark of the start is opaque"
    assert color(0.87, -0.6) == [255, 0, 0], "the end is as large as the body"
    assert color(0.07, 0.5) == [0, 0, 255]
    shapes = [Body((-0.5, 0.0), 0.2, RED, "ring", label="goal"), Body((0.5, 0.0), 0.2, BLUE, "cross", label="mark")]
    shapes.append(Body((0.0, 0.6), 0.2, RED, "square"))
    figure = figure_of(paths, [Scene(tuple(shapes), WINDOW, unit="m")])
    _, color = drawn(figure)
    assert color(-0.3, 0.0) == [255, 0, 0]
    assert color(-0.5, 0.01) != [255, 0, 0]
    assert color(0.5, 0.0) == color(0.6, 0.1) == [0, 0, 255]
    assert color(0.6, 0.02) != [0, 0, 255]
    assert color(0.15, 0.75) == [255, 0, 0]
    assert [text.get_text() for text in figure.subfigs[0].legends[0].get_texts()] == ["goal", "mark", "start"]
    assert figure.axes[0].get_title(loc="left") == "title"
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("x (m)", "y (m)")


def test_landmarks_lie_above_the_bodies_that_cover_them():
    cross = Body((0.0, 0.0), 0.05, BLUE, "cross")
    _, color = drawn(figure_of(paths, [Scene((Body((0.0, 0.0), 0.3, RED), cross), WINDOW)]))
    assert color(0.0, 0.0) == [0, 0, 255]
    assert color(0.2, 0.0) == [255, 0, 0]
    _, color = drawn(figure_of(paths, [Scene((cross, Body((0.0, 0.0), 0.3, RED)), WINDOW)]))
    assert color(0.0, 0.0) == [0, 0, 255], "in whatever order they are listed"


def covered(*distances):
    """A landmark that a red agent is so far from in each scene, and a green one that is always farther."""
    landmark = Body((0.0, 0.0), 0.05, BLUE, "cross", label="landmark", reach=0.1)
    return [
        Scene(
            (Body((d, 0.0), 0.1, RED, trail=True, name="A"), Body((0.0, d + 0.3), 0.1, GREEN, trail=True), landmark),
            WINDOW,
        )
        for d in distances
    ]


def test_a_coverage_map_says_when_and_by_whom_a_landmark_is_covered():
    figure = figure_of(coverage, covered(0.0, 0.5, 0.05, 0.05, 0.5, 0.09, 0.1), 0.5)
    below = figure.axes[1]
    spans = [(bar.get_x(), bar.get_width(), to_hex(bar.get_facecolor())) for bar in below.patches]
    assert spans == [(0.5, 1.0, RED), (2.0, 0.5, RED)], "the start is not a step, and 0.1 is not within 0.1"
    assert [label.get_text() for label in below.get_yticklabels()] == ["landmark: 50%"]
    assert below.get_xlim() == (0.0, 3.0)
    assert [text.get_text() for text in below.texts] == ["A", "A"], "the letter of who covers it"
    both = [
        replace(scene, bodies=(*scene.bodies, replace(scene.bodies[-1], position=(0.9, 0.9))))
        for scene in covered(0.5, 0.0)
    ]
    labels = figure_of(coverage, both).axes[1].get_yticklabels()
    assert [label.get_text() for label in labels] == ["landmark 1: 100%", "landmark 2: 0%"]
    nobody = figure_of(coverage, covered(0.5, 0.5, 0.5), 0.5)
    assert list(nobody.axes[1].patches) == []


def cells(steps):
    """A drone that flies a cell to the right each step, round a torus of five cells."""
    return [
        Scene((Body(((k + 2) % 5 - 2.0, 0.0), 0.4, RED),), (-2.5, 2.5, -2.5, 2.5), grid=(1.0, 0.5))
        for k in range(steps + 1)
    ]


@pytest.mark.parametrize(("steps", "times"), [(2, ["0 s", "0.5 s", "1 s, end"]), (8, None)])
def test_a_strip_has_the_last_steps_of_an_episode(steps, times):
    figure = figure_of(strip, cells(steps), 0.5)
    shown = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert shown == (times or ["1.5 s", "2 s", "2.5 s", "3 s", "3.5 s", "4 s, end"])


def test_arrows_of_a_strip_do_not_cross_the_torus():
    arrows = [len(axes.texts) for axes in figure_of(strip, cells(5), 0.5).axes]
    assert arrows == [0, 1, 1, 0, 1, 1], "the first panel is the start; in the fourth the drone leaves to the right"


def test_a_summary_is_what_fits_the_bodies():
    tall, square, wide = (covered(0.5, 0.05), line(), cells(2))
    sizes = [tuple(summary([(episode(scenes), "task")], 0.1, 3.5).get_size_inches()) for scenes in (tall, square, wide)]
    assert sizes[1] == (3.5, 3.5)
    assert sizes[0][1] > 4
    assert sizes[2][1] < 3
    both = summary([(episode(tall), "plain"), (episode(square), "esp")], 0.1, 3.5)
    assert tuple(both.get_size_inches()) == (7.0, sizes[0][1])
    assert [part.axes[0].get_title(loc="left") for part in both.subfigs] == ["plain, return 1.0", "esp, return 8.0"]
