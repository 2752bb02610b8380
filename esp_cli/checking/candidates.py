"""Which elements a check tries, beyond the declared ones, and which group those that hold make up."""

from __future__ import annotations

from collections.abc import Sequence

from esp_cli.checking.verdicts import ElementVerdict
from esp_cli.symmetry import Element, FiniteGroup, Group, build_transform, parse_elements
from esp_cli.symmetry.admission import declares, exchangeable
from esp_cli.symmetry.elements import order_name
from esp_cli.symmetry.groups import swap_and_round
from esp_cli.symmetry.parse import Factors
from esp_envs.errors import UserError
from esp_envs.spec import Spaces

_TRIED = "d8,rot57,flip23"
"""Turns and mirrors that are tried; the last two stand for all angles."""
_NAMED = ("c2", "flip-x", "flip-y", "flip-diagonal", "flip-antidiagonal", "d2", "c4", "d4", "c8", "d8")
"""Groups that are named as found, smaller ones first, if all their elements hold."""
_MOST = 64
"""Of more listed elements some are tried that generate them all: where these hold, so do their products."""


def candidates(spaces: Spaces, transforms: str | None = None) -> list[Element]:
    """Return the elements to try: those asked for, else of d8, any angle, orders of agents and of declared items.

    Elements that the actions or layouts cannot carry are left out, and those that move no number of the task. Of the
    default ones that move all numbers alike, as two mirrors that no vector sees, the first stands for all.

    Args:
        spaces: of the task.
        transforms: text as `--transforms` takes it.

    Raises:
        UserError: the text means nothing, or nothing that is asked for can be tried.
    """
    texts = [transforms] if transforms is not None else [_TRIED, Factors.of(spaces.symmetry).scene]
    if transforms is None:
        agents = {"agents": spaces.num_agents} if spaces.num_agents > 1 else {}
        for name, count in (agents | Factors.of(spaces.symmetry).items).items():
            texts += _orders(name, count)
    refusals = _refusals(texts, spaces)
    found: list[Element] = []
    for element in (element for element, refusal in refusals.items() if refusal is None):
        alike = (build_transform([element @ one.inverse()], spaces).is_identity for one in found)
        if transforms is not None or not any(alike):
            found.append(element)
    if not found:
        said = next(iter(refusals.values()), None)
        raise UserError(f"no transform can be tried on {spaces.label}: {said or 'none is named'}")
    return found


def refused(spaces: Spaces, transforms: str) -> dict[str, str]:
    """Return why elements that are asked for cannot be tried, by their names."""
    return {element.name: told for element, told in _refusals([transforms], spaces).items() if told is not None}


def _refusals(texts: Sequence[str], spaces: Spaces) -> dict[Element, str | None]:
    """Return for each element that some texts name why it cannot be tried, or None."""
    asked = dict.fromkeys(element for text in texts for element in _elements(text, spaces.num_agents))
    return {element: _refusal(element, spaces) for element in asked}


def _orders(name: str, count: int) -> list[str]:
    """Return the names of elements that generate all orders of some things."""
    return [order_name(name, order) for order in swap_and_round(count)]


def _refusal(element: Element, spaces: Spaces) -> str | None:
    """Say why an element cannot be tried, if it cannot: actions or layouts cannot carry it, or it moves nothing."""
    try:
        transform = build_transform([element], spaces)
    except ValueError as error:
        return str(error)
    return f"{element.name} moves no number of it" if transform.is_identity else None


def is_declared(element: Element, spaces: Spaces) -> bool:
    """Return whether a task's declared symmetry holds an element."""
    return declares(spaces.symmetry, spaces.num_agents)(element)


def found_group(verdicts: Sequence[ElementVerdict], spaces: Spaces) -> str:
    """Name the largest group whose tried elements all hold: "d4*agents", "c2", or "c1" for none."""
    holding = {verdict.element for verdict in verdicts if verdict.outcome == "holds"}
    broken = {verdict.element for verdict in verdicts if verdict.outcome == "broken"}
    plane, count = "c1", spaces.num_agents
    for name in sorted((*_NAMED, Factors.of(spaces.symmetry).scene), key=lambda name: len(_listed(name, count))):
        elements = _elements(name, count)
        known = [element for element in elements if element.name in holding | broken]
        whole = generate(known, elements) if name in _NAMED else len(known) == len(elements)
        if known and whole and broken.isdisjoint(element.name for element in known):
            plane = name
    for name, of_any_angle, steps in (("so2", {"rot57"}, "c8"), ("o2", {"rot57", "flip23"}, "d8")):
        if of_any_angle <= holding and broken.isdisjoint(element.name for element in _elements(steps, 1)):
            plane = name
    agents = any(_is_order(name) for name in holding) and not any(_is_order(name) for name in broken)
    counts = exchangeable(spaces).items()
    items = {name: count for name, count in counts if set(_orders(name, count)) <= set(holding)}
    return Factors(plane, agents, items).name


def generate(known: Sequence[Element], elements: Sequence[Element]) -> bool:
    """Return whether the tried elements of a group generate all of it."""
    return bool(known) and FiniteGroup.generated_by("known", known).order == len(elements) + 1


def _is_order(name: str) -> bool:
    """Return whether an element only changes the places of agents."""
    return name.startswith("agents-")


def _listed(text: str, num_agents: int) -> tuple[Element, ...]:
    """Return the elements that a text names, of a group that is sampled its generators, without the identity."""
    if text in ("", "c1"):
        return ()
    found = parse_elements(text, num_agents)
    if isinstance(found, Group):
        return tuple(element for element in found.generators() if not element.is_identity)
    return found


def _elements(text: str, num_agents: int) -> tuple[Element, ...]:
    """Return those to try: all, or of many each one that is no product of those before it."""
    elements = _listed(text, num_agents)
    if len(elements) <= _MOST:
        return elements
    chosen: list[Element] = []
    generating: list[Element] = []
    reached: set[Element] = set()
    for element in elements:
        if element in reached:
            continue
        chosen.append(element)
        try:
            reached.update(FiniteGroup.generated_by(element.name, [*generating, element]).elements)
        except ValueError:  # its products are too many to list, so it stands for itself
            continue
        generating.append(element)
    return tuple(chosen)
