"""What a prior asks to be measured in its task before training: which elements there are, and how far to trust each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

from esp_cli.checking.task import TRANSITIONS, check_symmetry, judged
from esp_cli.checking.verdicts import ElementVerdict
from esp_cli.symmetry import Element, Group, parse_elements
from esp_cli.symmetry.admission import DISCOVERED, admitted_elements, unrestricted
from esp_cli.training.config import RunConfig
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.registry import make, task_class
from esp_envs.spec import TaskSpec
from esp_envs.views import worlds_of_role

_HORIZON = 50
"""Steps of an episode, at most, where a task has such a setting: of a longer one only the beginning is looked at."""


def prepared(config: RunConfig) -> RunConfig:
    """Return a configuration with all that its prior leaves to be measured; others come back as they are.

    Transforms "discovered" become what is found; nothing found is written as "discovered:", and then there is no prior.
    Where trust is "measured", each element gets its weight. That is the idea of PSE (Yu et al., 2024,
    arXiv:2401.00167), which quantifies the breaking during training; to measure it before, and how, is ours. What was
    measured stands in the configuration: nothing is measured twice.

    Raises:
        UserError: there is a compass, which leaves nothing to be measured, or the task cannot carry the elements.
    """
    prior = config.prior
    if prior.kind == "none":
        return config
    if prior.compass and prior.trust != "full":
        raise UserError(
            f"with prior.compass nothing is false that prior.trust={prior.trust} could find; leave one of the two out"
        )
    if prior.transforms == DISCOVERED.rstrip(":"):
        found = _discovered(_Maker(config))
        if prior.copies == "all" or prior.trust != "full":
            found = _listed(found, config)
        prior = prior.model_copy(update={"transforms": DISCOVERED + found} | ({} if found else {"kind": "none"}))
    if prior.kind != "none" and prior.trust != "full" and not prior.weights:
        gaps = _breaking(_Maker(config), prior.transforms)
        weights = {name: math.exp(-prior.doubt * gap) if gap < math.inf else 0.0 for name, gap in gaps}
        prior = prior.model_copy(update={"weights": weights})
    return config if prior is config.prior else config.model_copy(update={"prior": prior})


def planned(config: RunConfig) -> RunConfig:
    """Return `prepared`, with settings of the prior that have no effect at their defaults: equal runs are one run."""
    return _effective(prepared(_effective(config)))  # what was measured can leave other settings without effect


def _effective(config: RunConfig) -> RunConfig:
    return config.model_copy(update={"prior": config.prior.effective()})


def _listed(transforms: str, config: RunConfig) -> str:
    """Leave factors out from the right, orders of items first, until all elements can be listed."""
    num_agents = _Maker(config)(1, [0]).spec.num_agents
    while "*" in transforms and isinstance(parse_elements(transforms, num_agents), Group):
        transforms = transforms.rpartition("*")[0]
    return transforms


class _Maker:
    """Makes the worlds of a configuration; equal for equal tasks, so that nothing is measured twice."""

    def __init__(self, config: RunConfig) -> None:
        self._task, self._settings = config.task, dict(config.task_settings)
        if isinstance(horizon := self._settings.get("horizon"), int):
            self._settings["horizon"] = min(horizon, _HORIZON)
        self._key = (task_class(config.task), repr(sorted(self._settings.items())))  # a name can get another class

    def __call__(self, num_envs: int, seeds: Sequence[int]) -> Environment:
        return make(self._task, num_envs, seeds, self._settings)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Maker) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@lru_cache(maxsize=64)
def _discovered(make_worlds: _Maker) -> str:
    return check_symmetry(make_worlds).transforms.removeprefix(DISCOVERED)


@lru_cache(maxsize=64)
def _breaking(make_worlds: _Maker, transforms: str) -> tuple[tuple[str, float], ...]:
    """Return by how many standard deviations each element's worst field is off; infinite where nobody knows.

    Raises:
        UserError: the task cannot carry the elements, or they cannot be listed.
    """
    spec = make_worlds(1, [0]).spec
    if spec.roles:
        return _breaking_of_roles(make_worlds, spec, transforms)
    elements = admitted_elements(transforms, unrestricted(spec))  # what is weighed need not be declared
    return _gaps_of(make_worlds, elements, transforms)


def _breaking_of_roles(make_worlds: _Maker, spec: TaskSpec, transforms: str) -> tuple[tuple[str, float], ...]:
    """Return the largest gap of each element among the roles, which share the prior's weights."""
    gaps: dict[str, float] = {}
    for role in spec.roles:
        elements = admitted_elements(transforms, unrestricted(role))
        for name, gap in _gaps_of(worlds_of_role(make_worlds, role.name), elements, transforms):
            gaps[name] = max(gap, gaps.get(name, 0.0))
    return tuple(gaps.items())


def _gaps_of(
    make_worlds: MakeWorlds, elements: tuple[Element, ...] | Group, transforms: str
) -> tuple[tuple[str, float], ...]:
    if isinstance(elements, Group):
        raise UserError(
            f"a prior that is auto or measured weighs each element, but '{transforms}' is sampled; choose a "
            "finite group, such as d4"
        )
    method, verdicts = judged(make_worlds, elements)
    return tuple((verdict.element, _gap(verdict, method)) for verdict in verdicts)


def _gap(verdict: ElementVerdict, method: str) -> float:
    """Return by how much the worst field is off; infinite where nobody knows.

    That is where a field is not covered, or is broken as far as transitions show, which can be less than it is.
    """
    outcomes = {field.outcome for field in verdict.fields} | {verdict.outcome}
    if "not covered" in outcomes or (method == TRANSITIONS and "broken" in outcomes):
        return math.inf
    return max((field.gap for field in verdict.fields if field.outcome == "broken"), default=0.0)
