"""Which elements a check tries, beyond the declared ones, and the name of those that hold: "d4*agents", "flip-x"."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor

from esp_cli.checking.shifting import Shift
from esp_cli.checking.verdicts import ElementVerdict
from esp_cli.symmetry import Element, FiniteGroup, Group, build_transform, parse_elements
from esp_cli.symmetry.admission import DISCOVERED, declares, exchangeable, moves_some_number, scene_of
from esp_cli.symmetry.elements import order_name
from esp_cli.symmetry.groups import MOST_ITEMS
from esp_cli.symmetry.plane import PlaneElement, mirror
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces

_TRIED = ("d8", "d12", "rot57", "flip23")  # the last two stand for all angles; of n moves d-n is tried, too
_EXCHANGES = 28  # up to so many exchanges (those of 8 agents) all pairs are tried; of more things, only neighbours
_MOST_CORNERS = 64  # a turn by another part of the whole than one of these stands for all angles, as 57 degrees
_MOST = 64  # of longer lists only generators are tried: where these hold, so do their products


class NothingToTry(UserError):  # noqa: N818
    """No element can be tried on a task; the message says why."""


def candidates(spaces: Spaces, transforms: str | None = None) -> list[Element]:
    """Return the elements to try: those asked for, else of polygons, any angle, exchanges of two agents or like items.

    Elements that the actions or layouts cannot carry are left out, and those that move no number; where none is left,
    that is `NothingToTry`. Of default ones that move all numbers alike, as two mirrors that no vector sees, the first
    stands for all.
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


def refused(spaces: Spaces, transforms: str | None = None) -> tuple[ElementVerdict, ...]:
    """Return the elements that cannot be tried: of those asked for, else of the declared ones."""
    refusals = _refusals(_defaults(spaces) if transforms is None else [transforms], spaces).items()
    found = (ElementVerdict(e.name, is_declared(e, spaces), (), told) for e, told in refusals if told is not None)
    return tuple(one for one in found if one.declared or transforms is not None)


def turns_freely(spaces: Spaces) -> bool:
    """Return whether actions and layouts carry a turn by any angle, and not by parts of a ring alone."""
    return all(_refusal(element, spaces) is None for element in _elements("so2", spaces.num_agents))


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
        build_transform([element], spaces)
    except ValueError as error:
        return str(error)
    return None if moves_some_number([element], spaces) else f"{element.name} moves no number of it"


def _moved(element: Element, spaces: Spaces) -> tuple[float, ...]:
    """Return where an element moves some numbers of a task, in thousandths: the same for those that move all alike."""
    transform, agents = build_transform([element], spaces), spaces.num_agents
    generator, outputs = torch.Generator().manual_seed(0), transform.num_outputs

    def drawn(*shape: int) -> Tensor:
        return torch.rand(1, 1, *shape, generator=generator, dtype=torch.float64).float()

    parts = (
        transform.obs(drawn(agents, spaces.observation.width)),
        transform.state(drawn(spaces.state.width)),
        transform.push_outputs(torch.arange(1.0, agents * outputs + 1).view(1, 1, agents, outputs)),
        transform.per_agent(torch.arange(float(agents)).view(1, 1, -1)),
    )
    return tuple(round(1000 * number) + 0.0 for part in parts for number in part.flatten().tolist())


def is_declared(element: Element | Shift, spaces: Spaces) -> bool:
    """Return whether a task's declared symmetry holds an element, or it declares shifts."""
    return spaces.shifts if isinstance(element, Shift) else declares(spaces.symmetry, spaces.num_agents)(element)


def _elements(text: str, num_agents: int) -> tuple[Element, ...]:
    """Return a sampled group's generators, else all; of many those that are no product of earlier ones on the same."""
    found = () if text in ("", "c1") else parse_elements(text, num_agents)
    elements = found.generators() if isinstance(found, Group) else found
    elements = tuple(element for element in elements if not element.is_identity)
    if len(elements) <= _MOST:
        return elements
    chosen, reached = list[Element](), set[Element]()
    generating = defaultdict[frozenset[Any], list[Element]](list)  # by what they act on
    for element in elements:
        if element in reached or all(element.restricted(frozenset([aspect])) in reached for aspect in element.aspects):
            continue
        chosen.append(element)
        alike = [*generating[element.aspects], element]
        with suppress(ValueError):  # its products are too many to list, so it stands for itself
            reached.update(FiniteGroup.generated_by(element.name, alike).elements)
            generating[element.aspects] = alike
    return tuple(chosen)


def named(
    accepted: Sequence[Element], tried: Sequence[Element], scene: str = "", freely: bool = True
) -> tuple[str, str]:
    """Return the name of the largest group that the accepted elements close to, and what `--transforms` takes.

    Turns by odd angles stand for all where the task `turns_freely`, else for those that they generate.

    A group of the scene, as of legs, is looked at too. It counts where all of its elements that were tried are
    accepted, and generate it; coupled generators, as flip-x*agents-1-0, count one by one. All orders of agents, or of a
    field's items, count where those that were tried are accepted and generate them.
    """
    plane, text = _scene([e for e in accepted if not e.orders], [e for e in tried if not e.orders], scene, freely)
    whole, single = _orders_of(accepted, tried)
    glue = " and " if "," in plane else "*"
    name = " and ".join([glue.join((plane, *whole)), *([",".join(single)] if single else [])])
    glue = "," if "," in plane else "*"
    product = glue.join(part for part in (text, *whole) if part)
    texts = (",".join(part for part in (product, *single) if part), product, text)
    return name, next((DISCOVERED + part for part in texts if part and _is_readable(part, accepted)), "")


def _scene(accepted: Sequence[Element], tried: Sequence[Element], scene: str, freely: bool) -> tuple[str, str]:
    """Return the name and `--transforms` of the largest group of the scene whose tried elements are all accepted."""
    held, seen = set(accepted), {e: PlaneElement.of(e) for e in tried if _is_planar(e)}
    turns, mirrors = ([e for e, plane in seen.items() if plane.mirrored == mirrored] for mirrored in (False, True))
    most = _MOST_CORNERS if freely else math.inf
    if held.issuperset(turns) and any(seen[e].turn.denominator > most for e in turns):
        name = "o2" if mirrors and held.issuperset(mirrors) else "so2"
        return name, name
    groups = _polygon_groups({e: plane for e, plane in seen.items() if plane.turn.denominator <= most})
    if scene and "*" not in scene and not any(_is_planar(e) for e in _listed(scene)):
        groups.append((scene, _listed(scene)))
    best, text, size = "c1", "", 1
    for name, group in groups:
        known = [e for e in group if e in tried]
        if len(group) >= size and held.issuperset(known) and _generate(known, len(group) + 1):
            best, text, size = name, name if "," not in name else ",".join(e.name for e in known), len(group) + 1
    return best, text


def _is_planar(element: Element) -> bool:
    return all(isinstance(part, PlaneElement) for part in element.geometry)


def _polygon_groups(tried: Mapping[Element, PlaneElement]) -> list[tuple[str, tuple[Element, ...]]]:
    """Return the cyclic and dihedral groups that hold some of the tried elements, by name, without the identity."""
    folds = sorted({plane.turn.denominator for plane in tried.values() if not plane.mirrored})
    axes = [e for e, plane in tried.items() if plane.mirrored]
    found = [(axis.name, (axis,)) for axis in axes] + [(f"c{fold}", _listed(f"c{fold}")) for fold in folds]
    for axis in axes:
        for fold in folds:
            turned = _listed(f"c{fold}")
            group = (*turned, *sorted((axis, *(turn @ axis for turn in turned)), key=lambda e: e.sort_key))
            name = f"d{fold}" if Element.of(mirror()) in group else ",".join(e.name for e in group)
            found.append((name, group))
    return found


def _orders_of(accepted: Sequence[Element], tried: Sequence[Element]) -> tuple[list[str], list[str]]:
    """Return the groups of all orders of agents or items, and the accepted elements with orders that make up none."""
    found, whole = dict[tuple[str, int], list[Element]](), list[str]()
    single = [element.name for element in accepted if element.orders and not element.in_place.is_identity]
    for element in tried:
        if len(element.orders) == 1 and element.in_place.is_identity:
            name, places = element.orders[0]
            found.setdefault((name, len(places)), []).append(element)
    for (name, count), elements in sorted(found.items(), key=lambda one: (one[0][0] != "agents", one[0])):
        if set(elements) <= set(accepted) and _mix(elements, count):
            whole.append(name if name == "agents" else f"{name}-{count}")
        else:
            single += [element.name for element in elements if element in accepted]
    return whole, single


def _mix(elements: Sequence[Element], count: int) -> bool:
    """Return whether orders of some things generate all; of many, whether exchanges of two connect each with each."""
    if count <= MOST_ITEMS:
        return _generate(elements, math.factorial(count))
    moved = [{i for i, place in enumerate(e.orders[0][1]) if i != place} for e in elements]
    reached = {0}
    for _ in range(count):
        reached = reached.union(*(pair for pair in moved if len(pair) == 2 and pair & reached))
    return len(reached) == count


def _generate(known: Sequence[Element], order: int) -> bool:
    """Return whether elements generate a group of so many."""
    return bool(known) and FiniteGroup.generated_by("known", known).order == order


def _listed(text: str) -> tuple[Element, ...]:
    """Return the elements that a text names, without the identity; none of c1, and of what is sampled."""
    elements = () if text == "c1" else parse_elements(text, 1)
    return () if isinstance(elements, Group) else elements


def _is_readable(text: str, accepted: Sequence[Element]) -> bool:
    """Return whether `--transforms` takes a text; it takes no list that holds a sampled group."""
    with suppress(ValueError):
        parse_elements(text, max((len(e.permutation or ()) for e in accepted), default=1))
        return True
    return False
