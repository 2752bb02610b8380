"""Figures: both files, the same bytes every time, and what they show."""

from __future__ import annotations

import math

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from esp_cli.policies.curve_statistics import curve_band
from esp_cli.reporting import plots
from esp_cli.reporting.plots import PALETTE, Curve, Group, dots, learning_curves

STEPS = [0, 100_000, 200_000]
VALUES = np.array([[-220.0, -210.0, -215.0], [-150.0, -140.0, -148.0], [-120.0, -118.0, -125.0]])
CURVES = [Curve("MAPPO", STEPS, VALUES - 10), Curve("MAPPO-ESP", STEPS, VALUES)]
GROUPS = [Group("rot90", [-121.0, -123.0, -122.0]), Group("d4", [-118.0])]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that were written, to look into."""
    figures = []
    save = Figure.savefig

    def remember(self, *args, **kwargs):
        figures.append(self)
        return save(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", remember)
    return figures


def draw_curves(path, **changes):
    settings = {"references": {"random": -221.4, "heuristic": -109.0, "paper": -110.22}, **changes}
    return learning_curves(CURVES, path, "navigation", "return, convention esp", **settings)


def draw_dots(path, **changes):
    settings = {"anchors": {"random": -221.4, "heuristic": -119.0}, **changes}
    return dots(GROUPS, path, "transforms", "return, convention esp", **settings)


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


@pytest.mark.parametrize(("draw", "lines"), [(draw_curves, "references"), (draw_dots, "anchors")])
def test_other_numbers_are_another_figure(tmp_path, draw, lines):
    other = draw(tmp_path / "b", **{lines: {"paper": -130.0}})
    assert draw(tmp_path / "a")[1].read_bytes() != other[1].read_bytes()


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
    plain, ours = lines["MAPPO (3 seeds)"], lines["MAPPO-ESP (3 seeds)"]
    np.testing.assert_allclose(ours.get_ydata(), [-215.0, -146.0, -121.0])
    np.testing.assert_allclose(plain.get_ydata(), [-225.0, -156.0, -131.0])
    assert (plain.get_color(), ours.get_color()) == PALETTE[:2]
    assert plain.get_linestyle() != ours.get_linestyle()
    assert len(axes.collections) == 2
    assert {text.get_text() for text in axes.texts} == {"random -221.4", "heuristic -109", "paper -110.22"}


def test_the_band_is_the_bootstrap_interval(tmp_path, drawn):
    values = [[1.0, 3.0, 5.0]] * 2
    learning_curves([Curve("a", [0, 1], values)], tmp_path / "a", "t", "y")
    edges = drawn[0].axes[0].collections[0].get_paths()[0].vertices[:, 1]
    _, low, high = curve_band(values)
    assert (edges.min(), edges.max()) == (low[0], high[0])
    assert 1.0 <= low[0] < 3.0 < high[0] <= 5.0


def test_one_seed_has_no_band_and_one_step_is_a_dot(tmp_path, drawn):
    learning_curves([Curve("a", [5], [[1.0]])], tmp_path / "a", "t", "y")
    axes = drawn[0].axes[0]
    assert not axes.collections
    assert axes.get_lines()[0].get_marker() == "o"


def test_lines_out_of_view_have_no_label(tmp_path, drawn):
    draw_curves(tmp_path / "a", ylim=(-150.0, -100.0))
    axes = drawn[0].axes[0]
    assert axes.get_ylim() == (-150.0, -100.0)
    assert {text.get_text() for text in axes.texts} == {"heuristic -109", "paper -110.22"}


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
    learning_curves([Curve("$x_{", STEPS, VALUES)], tmp_path / "a", "costs $5_000", "y $")
    assert (tmp_path / "a.svg").stat().st_size > 0


def test_labels_are_pushed_apart_in_order():
    gap = plots._LABEL_GAP
    placed = plots._spread([0.5, 0.9, 0.51, 0.5])
    assert placed[1] == 0.9
    assert placed[0] < placed[3] < placed[2]
    assert np.diff(sorted(placed)).min() > gap - 1e-6
    assert np.mean(placed) == pytest.approx(np.mean([0.5, 0.9, 0.51, 0.5]))
    assert plots._spread([0.1, 0.9]) == [0.1, 0.9]
    assert plots._spread([]) == []


@pytest.mark.parametrize(
    ("draw", "text"),
    [
        (lambda path: learning_curves([], path, "t", "y"), "no curve to draw"),
        (lambda path: dots([], path, "t", "x"), "no group to draw"),
        (
            lambda path: learning_curves([Curve("a", [1, 2], [[1.0]])], path, "t", "y"),
            "'a' has 2 steps and 1 evaluations",
        ),
        (lambda path: learning_curves([Curve("a", [1], [1.0])], path, "t", "y"), r"\[K, S\]"),
        (lambda path: dots([Group("a", [math.nan])], path, "t", "x"), "not finite"),
        (lambda path: dots(GROUPS, "/dev/null/a", "t", "x"), "cannot write the figure .*(Not a directory|File exists)"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence_and_no_file(tmp_path, draw, text):
    with pytest.raises(ValueError, match=text):
        draw(tmp_path / "a")
    assert list(tmp_path.iterdir()) == []
