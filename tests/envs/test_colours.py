"""Colours that people with any common colour blindness tell apart, measured as CIE76 distances."""

from itertools import combinations

import numpy as np
import pytest

from esp_envs import make
from esp_envs.drawing import BACKGROUND
from esp_envs.scene import COLORS, DARK, PALE, look

LEAST = 30.0
# what is seen without red or green cones, on linear red, green and blue: Machado, Oliveira, Fernandes, 2009, severity 1
SIGHT = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
}
TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def lab(color: str, sight: str = "normal") -> np.ndarray:
    """Return L*, a*, b* of "#rrggbb" as somebody sees it."""
    levels = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    seen = TO_XYZ @ np.clip(SIGHT[sight] @ linear, 0, 1) / TO_XYZ.sum(1)
    f = np.where(seen > (6 / 29) ** 3, np.cbrt(seen), seen / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def apart(first: str, second: str) -> float:
    """Return the least CIE76 distance of two colours over all kinds of sight."""
    return min(float(np.linalg.norm(lab(first, sight) - lab(second, sight))) for sight in SIGHT)


def test_the_distance_has_known_answers() -> None:
    assert lab("#ffffff") == pytest.approx([100, 0, 0], abs=0.01)
    assert lab("#ff0000") == pytest.approx([53.24, 80.09, 67.20], abs=0.02)
    assert apart("#000000", "#ffffff") == pytest.approx(100, abs=0.1)
    assert apart("#d84a3f", "#3fa86a") < LEAST < np.linalg.norm(lab("#d84a3f") - lab("#3fa86a")), "red and green"


def test_colours_of_agents_curves_and_things_are_told_apart_by_everybody() -> None:
    measured = {pair: apart(*pair) for pair in combinations((*COLORS, DARK, PALE), 2)}
    assert min(measured.values()) >= LEAST, min(measured, key=measured.get)
    assert min(apart(color, paper) for color in (*COLORS, DARK) for paper in (BACKGROUND, "#ffffff")) >= LEAST


@pytest.mark.parametrize("task", ["navigation", "predator-prey", "wildlife", "formation"])
def test_bodies_of_different_kinds_or_agents_differ_in_colour_or_letter(task: str) -> None:
    env = make(task, 1, [0])
    env.reset()
    bodies = env.scene().bodies
    kinds = {body.label: body.color for body in bodies if not body.name}
    agents = [body for body in bodies if body.name and body.shape == "disc"]
    assert [body.name for body in agents] == [look(k)["name"] for k in range(env.spec.num_agents)]
    assert all(apart(body.color, color) >= LEAST for body in agents for color in kinds.values())
