"""What a search tries: a range or a list of values for each setting, by default one space for each algorithm."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from pydantic import JsonValue, field_validator, model_validator

from esp_cli.files.documents import Strict, flat, read_table, validated
from esp_cli.files.formatting import did_you_mean
from esp_cli.prior.config import of_no_use_to
from esp_envs.errors import UserError

_END = 0.05  # share of a range at each end that counts as the end


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

    def is_at_end(self, value: object) -> bool:
        """Return whether better values may lie beyond what is tried, since this is among the first or last of it.

        Of choices in order the first or last of three and more, of a range the outermost twentieths; names have no end.

        >>> Dimension(low=1e-4, high=1e-2, log=True).is_at_end(9e-3), Dimension(choices=(5, 10, 15)).is_at_end(10)
        (True, False)
        """
        if self.choices is not None:
            ordered = len(self.choices) > 2 and not any(isinstance(x, str | bool) for x in self.choices)
            return ordered and value in (self.choices[0], self.choices[-1])
        assert isinstance(value, int | float)
        low, at, high = (math.log(float(x)) if self.log else float(x) for x in (self.low or 0, value, self.high or 0))
        return not _END <= (at - low) / (high - low) <= 1 - _END

    def draw(self, generator: random.Random) -> JsonValue:
        """Draw a value, each equally likely; of a logarithmic range, each order of magnitude."""
        if self.choices is not None:
            return generator.choice(self.choices)
        assert self.low is not None
        assert self.high is not None
        if isinstance(self.low, int) and isinstance(self.high, int) and not self.log:
            return generator.randint(self.low, self.high)
        if not self.log:
            return generator.uniform(self.low, self.high)
        drawn = math.exp(generator.uniform(math.log(self.low), math.log(self.high)))
        return round(drawn) if self.is_whole else min(max(drawn, self.low), self.high)  # whatever exp rounds to


_Value = TypeVar("_Value")

Space = Mapping[str, Dimension]  # dotted names of settings -> what is tried of each


def of(**values: Sequence[JsonValue]) -> Space:
    """Return a space of choices."""
    return {name: Dimension(choices=tuple(choices)) for name, choices in values.items()}


_OFF_POLICY = of(
    learning_rate=(1e-3, 2e-3, 4e-3, 1e-2),
    gamma=(0.9, 0.95, 0.98, 0.99),
    td_lambda=(0.3, 0.6, 0.8, 0.9),
    updates_per_episode=(1, 2),
    num_envs=(4, 8),
    epsilon_steps=(5_000, 10_000, 20_000, 50_000),
)
LEARNERS: Mapping[str, Space] = {
    "mappo": of(
        learning_rate=(1e-3, 2e-3, 4e-3, 8e-3),
        entropy_coef=(0.001, 0.003, 0.01, 0.03),
        gamma=(0.9, 0.95, 0.98, 0.99),
        gae_lambda=(0.8, 0.9, 0.95),
        num_epochs=(3, 5, 8),
        num_minibatches=(2, 5, 10),
        num_envs=(64, 128),
    ),
    "maddpg": {
        **_OFF_POLICY,
        **of(
            actor_learning_rate=(1e-3, 2e-3, 4e-3, 1e-2),
            tau=(0.005, 0.01, 0.03),
            output_penalty=(1e-4, 1e-3, 1e-2),
        ),
    },
    "qmix": {**_OFF_POLICY, **of(target_every=(25, 50, 100, 200), replay_episodes=(500, 1000, 5000))},
}
"""What is tried of each learner's settings."""
_PRIOR: Space = {"prior.consistency_coef": Dimension(choices=(0.03, 0.1, 0.3, 1.0))}
_NETWORK: Space = {
    "network.hidden": Dimension(choices=([64, 64], [128, 128])),
    "network.activation": Dimension(choices=("tanh", "relu")),
}


def of_learner(algorithm: str) -> Space:
    """Return what is tried of a learner's settings, and of the prior's."""
    if algorithm not in LEARNERS:
        raise UserError(f"{algorithm} has no default space; name the settings to tune with --space FILE")
    return {**{f"{algorithm}.{name}": tried for name, tried in LEARNERS[algorithm].items()}, **_PRIOR}


def default_space(algorithm: str) -> Space:
    """Return what is tried where the user names nothing else: the learner's settings, the prior's and the network's."""
    return {**of_learner(algorithm), **_NETWORK}


def drawn(space: Space, generator: random.Random) -> dict[str, JsonValue]:
    """Draw a value of each setting."""
    return {name: dimension.draw(generator) for name, dimension in space.items()}


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


def of_use(settings: Mapping[str, _Value], prior: str) -> dict[str, _Value]:
    """Return the settings that change anything in runs with this kind of prior; without it, none of the prior does."""
    idle = {f"prior.{name}" for name in of_no_use_to(prior)}
    return {name: value for name, value in settings.items() if name not in idle}
