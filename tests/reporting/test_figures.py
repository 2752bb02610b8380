"""Figures: both files, the same bytes every time, what they show, and what a page shows beside the pointer."""

import math
from collections import namedtuple
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from esp_cli.policies.statistics import curve_band
from esp_cli.reporting.figures import dots, over_setting
from esp_cli.reporting.study_figures import Panel, _draw_levels, learning_curves
from esp_envs.scene import COLORS

Curve = namedtuple("Curve", ("label", "steps", "values"))

STEPS = [0, 100_000, 200_000]
VALUES = np.array([[-220.0, -210.0, -215.0], [-150.0, -140.0, -148.0], [-120.0, -118.0, -125.0]])
CURVES = [Curve("MAPPO", STEPS, VALUES - 10), Curve("MAPPO-ESP", STEPS, VALUES)]
GROUPS = {"rot90": [-121.0, -123.0, -122.0], "d4": [-118.0]}
RISING = Curve("MAPPO", [0, 100, 200], [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
FLAT = Curve("MAPPO-ESP", [0, 100], [[3.0], [3.0]])


@pytest.fixture
def drawn(monkeypatch):
    figures = []
    save = Figure.savefig

    def remember(self, *args, **kwargs):
        figures.append(self)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", remember)
    return figures


def draw(curves, path, **lines):
    picture = learning_curves([Panel("a panel", curves, **lines)], path, "return")
    return picture, picture.with_suffix(".svg")


def draw_curves(path, lines=None):
    panel = Panel("navigation", CURVES, lines or {"random": -200.4, "heuristic": -129.0, "paper": -130.22})
    picture = learning_curves([panel], path, "return, convention esp")
    return picture, picture.with_suffix(".svg")


def draw_dots(path, lines=None):
    anchors = {"random": -221.4, "heuristic": -119.0} if lines is None else lines
    picture = dots(GROUPS, path, "transforms", "return, convention esp", anchors)
    return picture, picture.with_suffix(".svg")


@pytest.mark.parametrize("draw", [draw_curves, draw_dots])
def test_figures_are_the_same_bytes_every_time_and_carry_no_date(tmp_path, draw):
    first, second = draw(tmp_path / "a"), draw(tmp_path / "b.svg")
    assert [file.name for file in (*first, *second)] == ["a.png", "a.svg", "b.png", "b.svg"]
    for left, right in zip(first, second, strict=True):
        assert left.read_bytes() == right.read_bytes()
    with Image.open(first[0]) as image:
        assert image.width >= 1000
        assert len(image.convert("RGB").getcolors(10**6)) > 10
    text = first[1].read_text()
    assert text.startswith("<?xml")
    assert "dc:date" not in text


def test_the_settings_of_the_caller_are_left_alone(tmp_path):
    before = dict(mpl.rcParams)
    draw_curves(tmp_path / "a")
    assert dict(mpl.rcParams) == before


def test_only_the_ending_of_a_picture_is_replaced(tmp_path):
    assert [file.name for file in draw_dots(tmp_path / "cn.500k")] == ["cn.500k.png", "cn.500k.svg"]


def test_curves_show_the_mean_over_seeds_in_colours_apart(tmp_path, drawn):
    draw_curves(tmp_path / "a")
    axes = drawn[0].axes[0]
    lines = {line.get_label(): line for line in axes.get_lines()}
    plain, ours = lines["MAPPO"], lines["MAPPO-ESP"]
    np.testing.assert_allclose(ours.get_ydata(), [-215.0, -146.0, -121.0])
    np.testing.assert_allclose(plain.get_ydata(), [-225.0, -156.0, -131.0])
    assert (plain.get_color(), ours.get_color()) == COLORS[:2]
    assert plain.get_linestyle() != ours.get_linestyle()
    assert len(axes.collections) == 2
    assert {text.get_text() for text in axes.texts} == {"random", "paper, heuristic"}


def test_the_band_is_the_bootstrap_interval(tmp_path, drawn):
    values = [[1.0, 3.0, 5.0]] * 2
    draw([Curve("a", [0, 1], values)], tmp_path / "a")
    edges = drawn[0].axes[0].collections[0].get_paths()[0].vertices[:, 1]
    _, low, high = curve_band(values)
    assert (edges.min(), edges.max()) == (low[0], high[0])
    assert 1.0 <= low[0] < 3.0 < high[0] <= 5.0


def test_one_seed_has_no_band_and_one_step_is_a_dot(tmp_path, drawn):
    draw([Curve("a", [5], [[1.0]])], tmp_path / "a")
    axes = drawn[0].axes[0]
    assert not axes.collections
    assert axes.get_lines()[0].get_marker() == "o"


def test_dots_are_means_with_their_interval_and_every_seed(tmp_path, drawn):
    draw_dots(tmp_path / "a")
    axes = drawn[0].axes[0]
    assert not axes.patches, "a bar would begin somewhere that means nothing"
    marks = [
        (line.get_xdata().tolist(), line.get_markersize()) for line in axes.get_lines() if line.get_marker() == "o"
    ]
    assert [place for place, size in marks if size < 5] == [[-121.0, -123.0, -122.0], [-118.0]]
    assert [place for place, size in marks if size > 5] == [[-122.0], [-118.0]]
    whiskers = [line.get_xdata() for line in axes.get_lines() if line.get_marker() == "|"]
    assert len(whiskers) == 1, "one seed has no interval"
    assert -123.0 <= whiskers[0][0] < -122.0 < whiskers[0][1] <= -121.0
    assert [label.get_text() for label in axes.get_yticklabels()] == ["rot90\n(3 seeds)", "d4\n(1 seed)"]
    assert axes.get_ylim()[0] > axes.get_ylim()[1], "the first is on top"


def test_the_view_of_dots_is_that_of_the_groups(tmp_path, drawn):
    draw_dots(tmp_path / "a")
    axes = drawn[0].axes[0]
    low, high = axes.get_xlim()
    assert -124.0 < low < -123.0
    assert -118.0 < high < -117.0
    names = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert names == ["random -221.4 (out of view)", "heuristic -119"]


def test_names_are_not_mathematics(tmp_path):
    learning_curves([Panel("costs $5_000", [Curve("$x_{", STEPS, VALUES)])], tmp_path / "a", "y $")
    assert (tmp_path / "a.svg").stat().st_size > 0


@pytest.mark.filterwarnings("ignore:Glyph")
def test_a_name_with_control_characters_leaves_a_picture_that_opens_and_no_escape_in_it(tmp_path):
    learning_curves([Panel("red\x1b[31m <b>", [Curve("a\x07", STEPS, VALUES)])], tmp_path / "a", "y\x00")
    text = (tmp_path / "a.svg").read_text()
    assert ElementTree.fromstring(text).tag.endswith("svg")
    assert "red\\x1b[31m" in text


@pytest.mark.parametrize(
    ("draw", "text"),
    [
        (lambda path: dots({"a": [math.nan]}, path, "t", "x"), "not finite"),
        (lambda path: dots(GROUPS, "/dev/null/a", "t", "x"), "cannot write the figure .*(Not a directory|File exists)"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence_and_no_file(tmp_path, draw, text):
    with pytest.raises(ValueError, match=text):
        draw(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []


def test_panels_share_a_legend_and_each_has_its_title_and_anchors(tmp_path):
    panels = [Panel("navigation, 500k", [RISING, FLAT], {"random": 1.0, "far off": 99.0}), Panel("formation", [FLAT])]
    picture = learning_curves(panels, tmp_path / "curves.png", "greedy return")
    text = picture.with_suffix(".svg").read_text()
    assert all(part in text for part in ("navigation, 500k", "formation", "greedy return", "random"))
    assert "far off" not in text, "it would squeeze the curves"
    assert text.count("<!-- MAPPO-ESP -->") == 1
    assert text.count(COLORS[1].lower()) >= 2, "one label, one colour in both panels"
    assert "<!-- mean and 95 % bootstrap interval over 1 to 2 seeds -->" in text


def test_names_of_anchors_that_lie_together_stand_in_a_row_and_what_is_below_random_is_cut_off():
    axes = Figure().add_subplot()
    axes.set_ylim(-400.0, -100.0)
    _draw_levels(axes, Panel("p", [], {"random": -220.0, "heuristic": -112.0, "cover": -109.0}))
    assert [text.get_text() for text in axes.texts] == ["random", "heuristic, cover"]
    assert axes.get_ylim() == (-220.0 - 0.15 * 120.0, -100.0)
    axes.set_ylim(-200.0, -100.0)  # nothing is as low as the random policy
    _draw_levels(axes, Panel("p", [], {"random": -220.0}))
    assert axes.get_ylim() == (-200.0, -100.0)


def test_the_coefficient_is_drawn_with_the_papers_means(tmp_path):
    lines = {"500k": {"c = 0": [1.0, 2.0], "c = 0.5": [3.0, 4.0]}, "3M": {"c = 0": [5.0, 6.0]}}
    paper = {"500k": {"c = 0": 1.0}, "3M": {"gone": 2.0}}
    text = over_setting(lines, tmp_path / "c", "title", ("weight", "return"), (), paper).with_suffix(".svg").read_text()
    assert all(f"<!-- {part} -->" in text for part in ("c = 0.5", "500k", "3M", "paper, 500k"))
    assert "paper, 3M" not in text


def test_the_settings_values_stand_in_their_order_though_no_line_has_all(tmp_path):
    lines = {"a": {"c = 0": [1.0], "c = 1": [2.0]}, "b": {"c = 0": [1.0], "c = 0.5": [3.0]}}
    for order, expected in ((("c = 0", "c = 0.1", "c = 0.5", "c = 1"), [0, 2, 1]), ((), [0, 1, 2])):
        text = over_setting(lines, tmp_path / "c", "t", ("x", "y"), order).with_suffix(".svg").read_text()
        places = [text.index(f"<!-- {name} -->") for name in ("c = 0", "c = 1", "c = 0.5")]
        assert [sorted(places).index(place) for place in places] == expected
        assert "c = 0.1" not in text
