"""The algorithms by name. Adding one is a file and a line here."""

from __future__ import annotations

from esp_cli.algorithms import maddpg, mappo, qmix
from esp_cli.algorithms.learner import Learner

ALGORITHMS: dict[str, type[Learner]] = {"mappo": mappo.Mappo, "maddpg": maddpg.Maddpg, "qmix": qmix.Qmix}

PRESETS = {"mappo": mappo.PRESETS, "maddpg": maddpg.PRESETS, "qmix": qmix.PRESETS}
"""Per algorithm and preset: the settings, by section, that differ from the defaults."""

TUNED = {"mappo": mappo.TUNED, "maddpg": maddpg.TUNED, "qmix": qmix.TUNED}
"""Per algorithm and task: the settings, by section, that the preset `default` changes there."""
