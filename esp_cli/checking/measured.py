"""What a prior asks to be measured in its task before training: which elements there are, and how far to trust each."""

from __future__ import annotations

import json
import math
from functools import lru_cache

from esp_cli.checking.task import TRANSITIONS, check_symmetry, judged
from esp_cli.checking.verdicts import ElementVerdict
from esp_cli.symmetry import Group, parse_elements
from esp_cli.symmetry.admission import DISCOVERED, admitted_elements, all_carry, unrestricted
from esp_cli.training.config import RunConfig
from esp_envs.base import Environment, generators_for
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.registry import task_class
from esp_envs.roles import without_agents
from esp_envs.views import worlds_of_role


def prepared(config: RunConfig) -> RunConfig:
    """Return a configuration with all that its prior leaves to be measured; others come back as they are.

    Transforms "discovered" become what is found; nothing found is written as "discovered:", and then there is no prior.
    Where trust is "measured", each element gets its weight. That is the idea of PSE (Yu et al., 2024,
    arXiv:2401.00167), which quantifies the breaking during training; to measure it before, and how, is ours. What was
    measured stands in the configuration: nothing is measured twice.
    """
    prior = config.prior
    if prior.kind == "none":
        return config
    if prior.compass and prior.trust != "full":
        raise UserError(
            f"with prior.compass nothing is false that prior.trust={prior.trust} could find; leave one of the two out"
        )
    if prior.transforms == DISCOVERED.rstrip(":"):
        found = _discovered(_of(config))
        if prior.copies == "all" or prior.trust != "full":
            found = _listed(found, config)
        prior = prior.model_copy(update={"transforms": DISCOVERED + found} | ({} if found else {"kind": "none"}))
    if prior.kind != "none" and prior.trust != "full" and not prior.weights:
        gaps = _breaking(_of(config), prior.transforms)
        weights = {name: math.exp(-prior.doubt * gap) if gap < math.inf else 0.0 for name, gap in gaps}
        prior = prior.model_copy(update={"weights": weights})
    return config if prior is config.prior else config.model_copy(update={"prior": prior})


def planned(config: RunConfig) -> RunConfig:
    """Return `prepared`, with settings of the prior that have no effect at their defaults: equal runs are one run."""
    return _effective(prepared(_effective(config)))  # what was measured can leave other settings without effect


def _effective(config: RunConfig) -> RunConfig:
    prior = config.prior.effective()
    trusts = prior.kind != "none" and prior.needs_declaration and not config.prior.needs_declaration
    return config if trusts and not _declares(config) else config.model_copy(update={"prior": prior})


def _declares(config: RunConfig) -> bool:
    """Return whether the task declares the transforms of its prior, or nobody has to."""
    spec, transforms = _maker(_of(config))(1, [0]).spec, config.prior.transforms
    return transforms.startswith(DISCOVERED) or all_carry(transforms, spec.roles or (spec,))


def _listed(transforms: str, config: RunConfig) -> str:
    """Leave factors out from the right, orders of items first, until all elements can be listed."""
    num_agents = _maker(_of(config))(1, [0]).spec.num_agents
    while "*" in transforms and isinstance(parse_elements(transforms, num_agents), Group):
        transforms = transforms.rpartition("*")[0]
    return transforms


_Task = tuple[type[Environment], str]  # a class and its settings as JSON: equal for equal ones


def _of(config: RunConfig) -> _Task:
    return task_class(config.task), json.dumps(config.task_settings, sort_keys=True)


def _maker(task: _Task) -> MakeWorlds:
    cls, settings = task[0], task[0].Settings(**json.loads(task[1]))
    return lambda num_envs, seeds: cls(settings, num_envs, generators_for(seeds))


@lru_cache(maxsize=64)
def _discovered(task: _Task) -> str:
    return check_symmetry(_maker(task)).transforms.removeprefix(DISCOVERED)


@lru_cache(maxsize=64)
def _breaking(task: _Task, transforms: str) -> tuple[tuple[str, float], ...]:
    """Return by how many deviations each element's worst field is off in any role; infinite where nobody knows."""
    make_worlds, gaps = _maker(task), dict[str, float]()
    spec = make_worlds(1, [0]).spec
    for role in spec.roles or (spec,):
        own = transforms if role.num_agents > 1 else without_agents(transforms)
        elements = admitted_elements(own, unrestricted(role)) if own else ()  # what is weighed need not be declared
        if isinstance(elements, Group):
            raise UserError(
                f"a prior that is auto or measured weighs each element, but '{transforms}' is sampled; choose a "
                "finite group, such as d4"
            )
        method, verdicts = judged(worlds_of_role(make_worlds, role.name) if spec.roles else make_worlds, elements)
        for verdict in verdicts:
            gaps[verdict.element] = max(_gap(verdict, method), gaps.get(verdict.element, 0.0))
    return tuple(gaps.items())


def _gap(verdict: ElementVerdict, method: str) -> float:
    """Return the worst field's gap; infinite where it is not covered, or broken by transitions, which may show less."""
    outcomes = {field.outcome for field in verdict.fields} | {verdict.outcome}
    if "not covered" in outcomes or (method == TRANSITIONS and "broken" in outcomes):
        return math.inf
    return max((field.gap for field in verdict.fields if field.outcome == "broken"), default=0.0)
