"""Which elements a check tries, beyond the declared ones."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import torch

from esp_cli.checking.shifting import Shift
from esp_cli.symmetry import Element, FiniteGroup, Group, build_transform, parse_elements
from esp_cli.symmetry.admission import declares, exchangeable, scene_of
from esp_cli.symmetry.elements import order_name
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces

_TRIED = ("d8", "d12", "rot57", "flip23")
"""Turns and mirrors that are tried; the last two stand for all angles. Of n moves d-n is tried, too."""
_EXCHANGES = 28
"""Up to so many exchanges (those of 8 agents) all pairs are tried; of more things, only neighbours."""
_MOST = 64
"""Of longer lists only generators are tried: where these hold, so do their products."""


class NothingToTry(UserError):  # noqa: N818
    """No element can be tried on a task; the message says why."""


def candidates(spaces: Spaces, transforms: str | None = None) -> list[Element]:
    """Return the elements to try: those asked for, else of polygons, any angle, exchanges of two agents or like items.

    Elements that the actions or layouts cannot carry are left out, and those that move no number of the task. Of the
    default ones that move all numbers alike, as two mirrors that no vector sees, the first stands for all.

    Args:
        spaces: of the task.
        transforms: text as `--transforms` takes it.

    Raises:
        UserError: the text means nothing.
        NothingToTry: nothing that is asked for can be tried.
    """
    texts = [transforms] if transforms is not None else _defaults(spaces)
    refusals = _refusals(texts, spaces)
    possible = [element for element, refusal in refusals.items() if refusal is None]
    moves = {element: _moved(element, spaces) for element in reversed(possible)}
    first = {numbers: element for element, numbers in moves.items()}  # of those that move alike
    found = [element for element in possible if transforms is not None or first[moves[element]] == element]
    if not found:
        said = next(iter(refusals.values()), None)
        raise NothingToTry(f"no transform can be tried on {spaces.label}: {said or 'none is named'}")
    return found


def refused(spaces: Spaces, transforms: str) -> dict[str, str]:
    """Return why elements that are asked for cannot be tried, by their names."""
    return {element.name: told for element, told in _refusals([transforms], spaces).items() if told is not None}


def _refusals(texts: Sequence[str], spaces: Spaces) -> dict[Element, str | None]:
    """Return for each element that some texts name why it cannot be tried, or None."""
    asked = dict.fromkeys(element for text in texts for element in _elements(text, spaces.num_agents))
    return {element: _refusal(element, spaces) for element in asked}


def _defaults(spaces: Spaces) -> list[str]:
    """Return the texts of what is tried where nobody asks."""
    texts = [*_TRIED, scene_of(spaces.symmetry, spaces.num_agents)]
    if isinstance(spaces.action, Discrete) and spaces.action.kind.is_vector:
        texts.append(f"d{max(1, sum(any(point) for point in spaces.action.points))}")
    for name, count in {"agents": spaces.num_agents, **exchangeable(spaces)}.items():
        pairs = list(itertools.combinations(range(count), 2))
        for a, b in pairs if len(pairs) <= _EXCHANGES else itertools.pairwise(range(count)):
            order = list(range(count))
            order[a], order[b] = b, a
            texts.append(order_name(name, order))
    return texts


def _refusal(element: Element, spaces: Spaces) -> str | None:
    """Say why an element cannot be tried, if it cannot: actions or layouts cannot carry it, or it moves nothing."""
    try:
        transform = build_transform([element], spaces)
    except ValueError as error:
        return str(error)
    return f"{element.name} moves no number of it" if transform.is_identity else None


def _moved(element: Element, spaces: Spaces) -> tuple[float, ...]:
    """Return where an element moves some numbers of a task, in thousandths: the same for those that move all alike."""
    transform, agents = build_transform([element], spaces), spaces.num_agents
    generator = torch.Generator().manual_seed(0)
    obs, state = (
        torch.rand(1, 1, *shape, generator=generator, dtype=torch.float64).float()
        for shape in ((agents, spaces.observation.width), (spaces.state.width,))
    )
    if isinstance(spaces.action, Discrete):
        action = torch.arange(spaces.action.count).view(1, -1, 1).expand(1, -1, agents)
    else:
        action = torch.rand(1, 1, agents, spaces.action.width, generator=generator)
    order = transform.per_agent(torch.arange(float(agents)).view(1, 1, -1))
    parts = (transform.obs(obs), transform.state(state), transform.action(action), order)
    return tuple(round(1000 * number) + 0.0 for part in parts for number in part.flatten().tolist())


def is_declared(element: Element | Shift, spaces: Spaces) -> bool:
    """Return whether a task's declared symmetry holds an element, or it declares shifts."""
    if isinstance(element, Shift):
        return spaces.shifts
    return declares(spaces.symmetry, spaces.num_agents)(element)


def _listed(text: str, num_agents: int) -> tuple[Element, ...]:
    """Return the elements that a text names, of a group that is sampled its generators, without the identity."""
    if text in ("", "c1"):
        return ()
    found = parse_elements(text, num_agents)
    if isinstance(found, Group):
        return tuple(element for element in found.generators() if not element.is_identity)
    return found


def _elements(text: str, num_agents: int) -> tuple[Element, ...]:
    """Return those to try: all, or of many each one that is no product of those before it that act on the same."""
    elements = _listed(text, num_agents)
    if len(elements) <= _MOST:
        return elements
    chosen: list[Element] = []
    generating = dict[frozenset[Any], list[Element]]()  # by what they act on
    reached: set[Element] = set()
    for element in elements:
        if element in reached or all(element.restricted(frozenset([aspect])) in reached for aspect in element.aspects):
            continue
        chosen.append(element)
        alike = generating.setdefault(element.aspects, [])
        try:
            reached.update(FiniteGroup.generated_by(element.name, [*alike, element]).elements)
        except ValueError:  # its products are too many to list, so it stands for itself
            continue
        alike.append(element)
    return tuple(chosen)
