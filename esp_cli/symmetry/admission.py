"""Which transforms a task admits: its actions must carry them, and its dynamics and reward must be invariant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from esp_cli.symmetry.elements import AGENTS, Element
from esp_cli.symmetry.groups import MOST_ITEMS, Group, ProductGroup
from esp_cli.symmetry.operators import item_places, layout_operator
from esp_cli.symmetry.parse import Factors, declared_factors, is_item_name, parse_elements
from esp_cli.symmetry.representation import action_map, field_names, joint_sources, state_sources
from esp_envs.errors import UserError
from esp_envs.spec import Continuous, Discrete, Items, Spaces

DISCOVERED = "discovered:"
"""Begins transforms that were found in data, and that the task need not declare."""
_WITHOUT = "use --prior none, or let what holds be found: --prior auto, or --set prior.transforms=discovered"
_ANYTHING, _ANY_SCENE = "any", "any-scene"
"""Declared symmetries that no task writes: every element, and every one that leaves agents and items in place."""
_FEW_ORDERS = 23
"""Orders that are weighed beside d4, each of which takes about as long: those of four agents."""
PLANE_GROUPS = ("c2", "d2", "c4", "d4", "c8", "d8", "so2", "o2")
"""The planar groups that `carried_groups` tries, smaller ones first."""


def admit(text: str, elements: Sequence[Element] | Group, spaces: Spaces, instead: str = "") -> None:
    """Refuse transforms that a task cannot carry.

    Args:
        text: what the user wrote, for the message.
        elements: what it means.
        spaces: of the task.
        instead: what to do where the task carries no planar group; by default to use orders of agents or no prior.

    Raises:
        UserError: some action's image is no action, the element is outside the task's declared symmetry, or agents
            or items are to change places and a layout does not say which numbers follow them.
    """
    moved = elements.generators() if isinstance(elements, Group) else tuple(elements)
    reason = _reason(moved, spaces)
    if reason is None:
        return
    advice = instead or _WITHOUT
    if carried := carried_groups(spaces):
        plane = [name for name in carried if name in (*PLANE_GROUPS, Factors.of(_usable(spaces)).scene)]
        advice = f"use a group within {plane[-1]}" if plane else instead or f"use {carried[0]}"
        if _action_reason(moved, spaces):
            advice = advice.replace("use ", "use continuous actions or ", 1)
    raise UserError(f"{text} cannot act on {spaces.label}: {reason}; {advice}")


def carried_groups(spaces: Spaces) -> tuple[str, ...]:
    """Return the named groups that a task's actions and declared symmetry both carry, the largest planar one last.

    `agents` follows if the agents of the task may change places, then orders of items that it declares.
    """
    factors = Factors.of(_usable(spaces))
    own = "" if factors.scene in (_ANYTHING, _ANY_SCENE) else factors.scene
    names = PLANE_GROUPS if own in ("", "c1", *PLANE_GROUPS) else (*PLANE_GROUPS, own)
    agents = ["agents"] if spaces.num_agents > 1 else []
    return tuple(name for name in (*names, *agents, *factors.orders) if _carries(name, spaces))


def default_transforms(spaces: Spaces, weighed: bool = False) -> str:
    """Return the transforms of a task for which nobody chose any, as `parse_elements` takes them.

    d4 where the task carries it; else the planar part of its symmetry if that can be listed; else c4; else orders of
    its agents or items. Where it declares nothing, d4, which `admit` refuses.

    Args:
        spaces: of the task.
        weighed: whether each element counts by how nearly it holds, so that nothing has to be declared: then d4
            wherever actions and layouts carry it, and such orders, or elements coupled with some, beside it.

    Raises:
        UserError: its symmetry means nothing.
    """
    declared = _factors(_usable(spaces), spaces)
    listed = [name for name in declared[:1] if name != "so2"]
    chosen = next((name for name in ("d4", *listed, "c4", *declared) if _carries(name, spaces)), "d4")
    if not weighed or not _carries("d4", unrestricted(spaces)):
        return chosen
    found = parse_elements(chosen, spaces.num_agents)
    if isinstance(found, Group) or len(found) > _FEW_ORDERS:
        return "d4"
    return f"d4,{chosen}" if all(element.orders for element in found) else "d4"


def admit_declared(spaces: Spaces) -> None:
    """Refuse the symmetry that a task declares, or declares nearly, where its actions or layouts cannot carry it.

    Raises:
        UserError: they cannot, or it means nothing.
    """
    for text in filter(None, (spaces.symmetry, spaces.nearly)):
        for name in _factors(text, spaces):
            found = parse_elements(name, spaces.num_agents)
            admit(name, found, replace(spaces, symmetry=text, nearly=""))


def _factors(symmetry: str, spaces: Spaces) -> list[str]:
    """Return the factors of a symmetry that move something, the scene's first: "d4*agents" -> ["d4", "agents"]."""
    factors = Factors.of(symmetry)
    scene = [factors.scene] if factors.scene not in ("", "c1") else []
    return [*scene, *([AGENTS] if factors.agents and spaces.num_agents > 1 else []), *factors.orders]


def exchangeable(spaces: Spaces) -> dict[str, int]:
    """Return the fields whose items may change places as far as layouts tell, each with how many it has.

    An agent sees two to `MOST_ITEMS` of them, they are no pictures and follow no agents, the state has them too, and
    the name is one word of letters, digits and underscores.
    """
    own = {field.name for field in spaces.state.fields}
    return {
        field.name: field.count
        for field in spaces.observation.fields
        if field.items is Items.FIXED and field.pixels is None and 2 <= field.count <= MOST_ITEMS
        if field.name in own or spaces.is_joint
        if is_item_name(field.name)
    }


def unrestricted(spaces: Spaces) -> Spaces:
    """Return spaces without a declaration to hold to: actions and layouts alone say what is carried."""
    return replace(spaces, nearly=_ANYTHING)


def under_a_compass(spaces: Spaces) -> Spaces:
    """Return spaces whose agents see a compass and labels.

    They admit whatever moves the scene, every order of agents, and the orders of items declared before.
    """
    return replace(spaces, nearly=Factors(_ANY_SCENE, True, Factors.of(_usable(spaces)).items).name)


def declares(symmetry: str, num_agents: int) -> Callable[[Element], bool]:
    """Return what says whether a declared symmetry holds an element.

    Raises:
        UserError: the symmetry means nothing.
    """
    if symmetry == _ANYTHING:
        return lambda _: True
    factors = Factors.of(symmetry)
    if factors.scene != _ANY_SCENE:
        group = ProductGroup(*declared_factors(symmetry, num_agents))
        return lambda element: element in group
    orders = declares(replace(factors, scene="c1").name, num_agents)
    return lambda element: orders(Element(permutation=element.permutation, items=element.items))


def _carries(name: str, spaces: Spaces) -> bool:
    found = parse_elements(name, spaces.num_agents)
    return _reason(found.generators() if isinstance(found, Group) else found, spaces) is None


def _usable(spaces: Spaces) -> str:
    """Return the symmetry that a prior may use: one that holds nearly, else the one that holds."""
    return spaces.nearly or spaces.symmetry


def _reason(elements: Sequence[Element], spaces: Spaces) -> str | None:
    """Say why a task cannot carry elements, if it cannot."""
    scenes = tuple(dict.fromkeys(element.in_place for element in elements))
    declared = declares(_usable(spaces), spaces.num_agents)
    undeclared = [element for element in elements if not declared(element)]
    return (
        _action_reason(scenes, spaces)
        or _scene_reason([element for element in undeclared if not declared(element.in_place)], spaces)
        or _layout_reason(scenes, elements, spaces)
        or _agents_reason([element for element in elements if element.permutation is not None], spaces)
        or _items_reason(elements, spaces)
        or _order_reason(undeclared, declared, spaces)
    )


def _action_reason(scenes: Sequence[Element], spaces: Spaces) -> str | None:
    """Say which action has no image, if one has none."""
    if isinstance(spaces.action, Discrete):
        try:
            action_map(spaces.action, scenes)
        except UserError as error:
            return str(error)
    return None


def _scene_reason(undeclared: Sequence[Element], spaces: Spaces) -> str | None:
    """Say what an element does to the scene that dynamics and reward do not carry."""
    if not undeclared:
        return None
    carried = Factors.of(_usable(spaces)).scene or "c1"
    return f"{undeclared[0].in_place.name} is no symmetry of its dynamics and reward, which carry {carried}"


def _layout_reason(scenes: Sequence[Element], elements: Sequence[Element], spaces: Spaces) -> str | None:
    """Say which field cannot be transformed, if one cannot."""
    layouts = [spaces.observation, spaces.state]
    if isinstance(spaces.action, Continuous):
        layouts.append(spaces.action.layout)
    try:
        for layout in layouts:
            for field in layout.fields:
                item_places(field, elements)
            layout_operator(layout, scenes)
    except UserError as error:
        return str(error)
    return None


def _agents_reason(moving: Sequence[Element], spaces: Spaces) -> str | None:
    """Say why agents cannot change places, if some are asked to and cannot."""
    if not moving:
        return None
    if any(len(element.permutation or ()) != spaces.num_agents for element in moving):
        return f"the permutation is not one of its {spaces.num_agents} agents"
    if not spaces.is_joint and all(f.items is not Items.AGENTS for f in spaces.state.fields):
        return "its state does not say which numbers belong to which agent"
    try:
        places = np.array([moving[0].permutation])
        joint_sources(spaces.observation, places)
        if not spaces.is_joint:
            state_sources(spaces.state, places)
    except UserError as error:
        return str(error)
    return None


def _items_reason(elements: Sequence[Element], spaces: Spaces) -> str | None:
    """Say why items cannot change places, if some are asked to and cannot."""
    known, seen = field_names(spaces), [field.name for field in spaces.observation.fields]
    for name in dict.fromkeys(name for element in elements for name, _ in element.items):
        if name not in known:
            return f"it has no field '{name}', but {', '.join(known)}"
        if name in seen and not spaces.is_joint and all(field.name != name for field in spaces.state.fields):
            return f"its state does not hold its {name}"
    return None


def _order_reason(undeclared: Sequence[Element], declared: Callable[[Element], bool], spaces: Spaces) -> str | None:
    """Say which order of agents or items is not declared, if one is not."""
    usable = _usable(spaces)
    for element in undeclared:
        parts = {name: Element(items=((name, order),)) for name, order in element.items}
        if element.permutation is not None:
            parts = {AGENTS: Element(permutation=element.permutation), **parts}
        for name, part in parts.items():
            if not declared(part):
                what = AGENTS if name == AGENTS else f"its {name}"
                alone = " by themselves" if f"*{name}-" in usable else ""
                return f"its declared symmetry, {usable}, does not say that {what} may be exchanged{alone}"
    return None


def admitted_elements(text: str, spaces: Spaces, instead: str = "") -> tuple[Element, ...] | Group:
    """Read transforms from text (see `parse_elements`) and refuse what the task cannot carry (see `admit`).

    What was discovered ("discovered:flip-x") need not be declared: actions and layouts alone have to carry it.
    """
    found = text.removeprefix(DISCOVERED)
    if not found and text:
        raise UserError("nothing was discovered that transforms could name; choose some, or no prior")
    elements = parse_elements(found, spaces.num_agents)
    admit(found, elements, spaces if found == text else unrestricted(spaces), instead)
    return elements
