"""The algorithms by name. Adding one is a file and a line here."""

from __future__ import annotations

from esp_cli.algorithms import maddpg, mappo, qmix
from esp_cli.algorithms.learner import Learner

ALGORITHMS: dict[str, type[Learner]] = {"mappo": mappo.Mappo, "maddpg": maddpg.Maddpg, "qmix": qmix.Qmix}
