"""What tuning searches: a range or a list of values for each setting, by default one space for each algorithm."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from pydantic import JsonValue, field_validator, model_validator

from esp_cli.files.documents import Strict, flat, read_table, validated
from esp_cli.files.formatting import did_you_mean
from esp_cli.prior.config import of_no_use_to
from esp_envs.errors import UserError


class Dimension(Strict):
    """What is tried of one setting: a range from `low` to `high`, or `choices`."""

    low: int | float | None = None  # smallest value; whole numbers where both ends are whole
    high: int | float | None = None  # largest value
    log: bool = False  # whether to draw orders of magnitude evenly
    choices: tuple[JsonValue, ...] | None = None  # the values, where it is no range

    @field_validator("low", "high", mode="before")
    @classmethod
    def _is_number(cls, value: object) -> object:
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise UserError("it has to be a number")
        return value

    @model_validator(mode="after")
    def _is_one(self) -> Dimension:
        ends = (self.low, self.high)
        if self.choices is not None:
            if not self.choices or ends != (None, None) or self.log:
                raise UserError("write a list of values, or low and high")
        elif self.low is None or self.high is None or not self.low < self.high:
            raise UserError("write low and high, the smaller one first")
        elif self.log and self.low <= 0:
            raise UserError("log needs a low above 0")
        return self

    @property
    def is_whole(self) -> bool:
        return isinstance(self.low, int) and isinstance(self.high, int)

    def corners(self) -> tuple[JsonValue, ...]:
        """Return values that show whether the setting takes all: its choices, or both ends, and a fraction between."""
        if self.choices is not None:
            return self.choices
        assert self.low is not None
        assert self.high is not None
        between = () if self.is_whole else (self.low + (self.high - self.low) / math.e,)
        return (self.low, *between, self.high)

    def encoded(self, value: JsonValue) -> object:
        """Return a value as a trial of Optuna holds it; None where it is outside of the space."""
        if self.choices is not None:
            return next((json.dumps(choice) for choice in self.choices if choice == value), None)
        if not isinstance(value, int | float) or self.low is None or self.high is None:
            return None
        fits = value % 1 == 0 or not self.is_whole
        return value if fits and self.low <= value <= self.high else None

    def holding(self, value: JsonValue) -> Dimension:
        """Return this dimension, or one that is as much wider as it takes to hold a value of its kind."""
        if value is None or self.encoded(value) is not None:
            return self
        if self.choices is not None:
            return Dimension(choices=(value, *self.choices))
        if not isinstance(value, int | float) or self.low is None or self.high is None or (self.log and value <= 0):
            return self
        return Dimension(low=min(self.low, value), high=max(self.high, value), log=self.log)


Space = Mapping[str, Dimension]  # dotted names of settings -> what is tried of each


def _range(low: float, high: float, log: bool = True) -> Dimension:
    return Dimension(low=low, high=high, log=log)


def _choices(*values: JsonValue) -> Dimension:
    return Dimension(choices=values)


_NETWORK = {"network.hidden": _choices([64, 64], [128, 128]), "network.activation": _choices("tanh", "relu")}
_PRIOR = {"prior.consistency_coef": _range(0.01, 1.0)}
_GAMMA = _range(0.9, 0.995, log=False)
_OFF_POLICY = {
    "learning_rate": _range(5e-4, 1e-2),
    "gamma": _GAMMA,
    "td_lambda": _range(0.0, 0.95, log=False),
    "updates_per_episode": _choices(1, 2),
    "num_envs": _choices(4, 8),
    "epsilon_steps": _range(5_000, 200_000),
}
SPACES: Mapping[str, Space] = {
    "mappo": {
        "mappo.learning_rate": _range(1e-4, 1e-2),
        "mappo.entropy_coef": _range(1e-3, 0.1),
        "mappo.gamma": _GAMMA,
        "mappo.gae_lambda": _range(0.8, 0.99, log=False),
        "mappo.clip_epsilon": _range(0.1, 0.3, log=False),
        "mappo.num_epochs": _range(3, 15, log=False),
        "mappo.num_minibatches": _choices(1, 2, 5, 10),
        "mappo.num_envs": _choices(32, 64, 128),
        **_NETWORK,
    },
    "maddpg": {
        **{f"maddpg.{name}": dimension for name, dimension in _OFF_POLICY.items()},
        "maddpg.actor_learning_rate": _range(5e-4, 1e-2),
        "maddpg.tau": _range(1e-3, 5e-2),
        "maddpg.output_penalty": _range(1e-4, 0.1),
        **_NETWORK,
    },
    "qmix": {
        **{f"qmix.{name}": dimension for name, dimension in _OFF_POLICY.items()},
        "qmix.target_every": _range(25, 400),
        "qmix.replay_episodes": _choices(500, 1000, 5000),
        **_NETWORK,
    },
}
"""Unless the user names another one. The prior adds the weight of its loss."""


def default_space(algorithm: str) -> Space:
    """Return the space of an algorithm; settings of the prior concern runs with the prior alone."""
    if algorithm not in SPACES:
        raise UserError(f"{algorithm} has no default space; name the settings to tune with --space FILE")
    return {**SPACES[algorithm], **_PRIOR}


def read_space(path: Path) -> Space:
    """Read a space from a file, JSON or TOML: {"mappo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": true}}.

    A list stands for choices: {"network.hidden": [[64, 64], [128, 128]]}.
    """
    fields: dict[str, dict[str, object]] = {}
    found = dict(flat(read_table(path)))
    for dotted, value in found.items():
        name, _, last = dotted.rpartition(".")
        if last not in Dimension.model_fields and found.keys() & {f"{name}.low", f"{name}.high"}:
            hint = did_you_mean(last, Dimension.model_fields) or "; write low, high and log"
            raise UserError(f"{path} says '{last}' of the range '{name}'{hint}")
        if last in Dimension.model_fields and name:
            fields.setdefault(name, {})[last] = value
        elif isinstance(value, list):
            fields[dotted] = {"choices": tuple(value)}
        else:
            raise UserError(f"{path} gives '{dotted}' one value; write a list, or low and high, or use --set for it")
    if not fields:
        raise UserError(f"{path} names no setting; write what to try, as 'mappo.num_epochs': [5, 10]")
    return {name: validated(Dimension, values, name) for name, values in fields.items()}


def space_of(space: Space, prior: str) -> Space:
    """Return what changes anything in runs with this kind of prior: without it, nothing of the prior does."""
    idle = {f"prior.{name}" for name in of_no_use_to(prior)}
    return {name: d for name, d in space.items() if name not in idle}
