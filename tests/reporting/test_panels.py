"""Figures of whole studies, and the charts of the page."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from esp_cli.reporting.charts import chart
from esp_cli.reporting.panels import Panel, Sensitivity, _draw_anchors, curve_panels, sensitivity
from esp_cli.reporting.plots import PALETTE, Curve

RISING = Curve("MAPPO", [0, 100, 200], [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
FLAT = Curve("MAPPO-ESP", [0, 100], [[3.0], [3.0]])


def test_panels_share_a_legend_and_each_has_its_title_and_anchors(tmp_path):
    panels = [Panel("navigation, 500k", [RISING, FLAT], {"random": 1.0, "far off": 99.0}), Panel("formation", [FLAT])]
    png, svg = curve_panels(panels, tmp_path / "curves.png", "greedy return")
    with Image.open(png) as image:
        assert image.format == "PNG"
    text = svg.read_text()
    assert all(part in text for part in ("navigation, 500k", "formation", "greedy return", "random"))
    assert "far off" not in text, "it would squeeze the curves"
    assert text.count("<!-- MAPPO-ESP -->") == 1
    assert text.count(PALETTE[1].lower()) >= 2, "one label, one colour in both panels"
    again = curve_panels(panels, tmp_path / "again.png", "greedy return")[1]
    assert again.read_text() == text


def test_names_of_anchors_that_lie_together_stand_in_a_row_and_what_is_below_random_is_cut_off():
    axes = Figure().add_subplot()
    axes.set_ylim(-400.0, -100.0)
    _draw_anchors(axes, {"random": -220.0, "heuristic": -112.0, "cover": -109.0})
    assert [text.get_text() for text in axes.texts] == ["random", "heuristic, cover"]
    assert axes.get_ylim() == (-220.0 - 0.15 * 120.0, -100.0)
    axes.set_ylim(-200.0, -100.0)  # nothing is as low as the random policy
    _draw_anchors(axes, {"random": -220.0})
    assert axes.get_ylim() == (-200.0, -100.0)


def test_the_coefficient_is_drawn_with_the_papers_means(tmp_path):
    lines = [
        Sensitivity("500k", {"c = 0": [1.0, 2.0], "c = 0.5": [3.0, 4.0]}, {"c = 0": 1.0}),
        Sensitivity("3M", {"c = 0": [5.0, 6.0]}),
    ]
    text = sensitivity(lines, tmp_path / "c", "title", "weight", "return")[1].read_text()
    assert all(f"<!-- {part} -->" in text for part in ("c = 0.5", "500k", "3M", "paper, 500k"))
    assert "paper, 3M" not in text


def test_the_settings_values_stand_in_their_order_though_no_line_has_all(tmp_path):
    lines = [Sensitivity("a", {"c = 0": [1.0], "c = 1": [2.0]}), Sensitivity("b", {"c = 0": [1.0], "c = 0.5": [3.0]})]
    for order, expected in ((("c = 0", "c = 0.1", "c = 0.5", "c = 1"), [0, 2, 1]), ((), [0, 1, 2])):
        text = sensitivity(lines, tmp_path / "c", "t", "x", "y", order)[1].read_text()
        places = [text.index(f"<!-- {name} -->") for name in ("c = 0", "c = 1", "c = 0.5")]
        assert [sorted(places).index(place) for place in places] == expected
        assert "c = 0.1" not in text


def test_nothing_to_draw_is_told(tmp_path):
    for panels in ([], [Panel("empty", [])]):
        with pytest.raises(ValueError, match="no curve"):
            curve_panels(panels, tmp_path / "x", "y")
    with pytest.raises(ValueError, match="no line"):
        sensitivity([], tmp_path / "x", "t", "x", "y")


def test_a_chart_places_points_by_hand():
    made = chart(Panel("p", [RISING], {"random": 0.5, "far off": 99.0}), ["MAPPO"], "greedy return")
    points = made.curves[0].points
    # steps 0 to 200 between the edges; values 0 to 5 with a margin of 4 % of 5 at either end
    assert [point[0] for point in points] == [made.left, (made.left + made.right) / 2, made.right]
    assert [point[2:4] for point in points] == [(0, 0.5), (100, 2.5), (200, 4.5)]
    height = made.bottom - made.top
    assert points[0][1] == pytest.approx(made.bottom - height * (0.5 + 0.2) / 5.4, abs=0.01)
    assert made.curves[0].line.startswith(f"M{made.left} ")
    assert made.curves[0].colour == PALETTE[0]
    assert [anchor.text for anchor in made.anchors] == ["random 0.5"]


def test_a_chart_leaves_out_what_is_not_finite_and_thins_what_is_long():
    broken = Curve("a", [0, 1, 2], [[1.0, 1.0], [np.nan, 2.0], [3.0, 3.0]])
    assert [point[2] for point in chart(Panel("p", [broken]), ["a"], "y").curves[0].points] == [0, 2]
    long = Curve("a", np.arange(1001), np.arange(1001.0)[:, None])
    points = chart(Panel("p", [long]), ["a"], "y").curves[0].points
    assert len(points) == 168, "every sixth of 1001, and the last"
    assert points[-1][2:4] == (1000, 1000.0)


def test_a_flat_chart_and_one_of_a_single_evaluation_are_drawn():
    made = chart(Panel("p", [Curve("a", [0], [[3.0]]), Curve("b", [0], [[3.0]])]), ["a", "b"], "y")
    assert made.curves[0].line
    assert made.curves[0].colour != made.curves[1].colour
