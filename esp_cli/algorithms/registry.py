"""The algorithms by name. Adding one is a file and a line here."""

from __future__ import annotations

from esp_cli.algorithms import mappo
from esp_cli.algorithms.mappo import Mappo

ALGORITHMS: dict[str, type[Mappo]] = {"mappo": Mappo}

PRESETS = {"mappo": mappo.PRESETS}
"""Per algorithm and preset: the settings, by section, that differ from the defaults."""

TUNED = {"mappo": mappo.TUNED}
"""Per algorithm and task: the settings, by section, that the preset `default` changes there."""
