"""Scenes and episodes that the tests of pictures and films draw."""

import numpy as np

from esp_cli.drawing.recording import Episode
from esp_envs import Body, Scene

RED, BLUE, GREEN = "#ff0000", "#0000ff", "#00ff00"
WINDOW = (-1.0, 1.0, -1.0, 1.0)


def line(count=9, trail=True):
    """A red body on its way from the lower left to the right, and a blue one that stands."""
    places = np.linspace([-0.8, -0.6], [0.8, -0.6], count)  # beside the lines of the grid
    still = Body((0.0, 0.5), 0.1, BLUE)
    return [Scene((still, Body(tuple(place), 0.1, RED, trail=trail)), WINDOW) for place in places]


def episode(scenes):
    return Episode(scenes, [float(k) for k in range(len(scenes))])
