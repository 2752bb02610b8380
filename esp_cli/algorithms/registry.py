"""The algorithms by name: built in, installed as entry points of `esp.algorithms`, or named as module and class."""

from __future__ import annotations

from esp_cli.algorithms.learner import Learner
from esp_envs.installed import Registry

ALGORITHMS: Registry[Learner] = Registry(
    "algorithm",
    {
        "mappo": "esp_cli.algorithms.mappo:Mappo",
        "maddpg": "esp_cli.algorithms.maddpg:Maddpg",
        "qmix": "esp_cli.algorithms.qmix:Qmix",
    },
    base="esp_cli.algorithms.learner:Learner",
    option="--algo",
    example="reinforce:Reinforce",
)
