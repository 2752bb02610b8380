"""Which transforms a task admits: its actions must carry them, and its dynamics and reward must be invariant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from esp_cli.symmetry import representation
from esp_cli.symmetry.elements import AGENTS, Element
from esp_cli.symmetry.groups import MOST_ITEMS, Group, ProductGroup
from esp_cli.symmetry.parse import declared_factors, is_item_name, parse_elements, rank
from esp_envs.errors import UserError
from esp_envs.roles import without_agents
from esp_envs.spec import Continuous, Discrete, Items, Spaces, TaskSpec

DISCOVERED = "discovered:"  # begins transforms that were found in data, and that the task need not declare
_WITHOUT = "use --prior none, or let what holds be found: --prior auto, or --set prior.transforms=discovered"
# declared symmetries that no task writes: every element, and every one that leaves agents and items in place
_ANYTHING, _ANY_SCENE = "<any>", "<any-scene>"
_FEW_ORDERS = 23  # orders that are weighed beside d4, each of which takes about as long: those of four agents
# the planar groups that `carried_groups` tries, smaller ones first
PLANE_GROUPS = ("c2", "d2", "c4", "d4", "c8", "d8", "so2", "o2")


def admitted_elements(text: str, spaces: Spaces, instead: str = "") -> tuple[Element, ...] | Group:
    """Read transforms from text (see `parse_elements`) and refuse what the task cannot carry (see `admit`)."""
    found = text.removeprefix(DISCOVERED)
    if not found and text:
        raise UserError("nothing was discovered that transforms could name; choose some, or no prior")
    elements = parse_elements(found, spaces.num_agents)
    admit(found, elements, spaces if found == text else unrestricted(spaces), instead)
    return elements


def admit(text: str, elements: Sequence[Element] | Group, spaces: Spaces, instead: str = "") -> None:
    """Refuse transforms that a task cannot carry; `text` is what the user wrote, and `instead` what to do.

    It cannot where some action's image is no action, the element is outside the task's declared symmetry, or agents or
    items are to change places and a layout does not say which numbers follow them.
    """
    moved = _generating(elements)
    reason = _reason(_require, moved, spaces)
    if reason is None:
        return
    advice = instead or _WITHOUT
    if carried := carried_groups(spaces):
        plane = [name for name in carried if name in (*PLANE_GROUPS, scene_of(_usable(spaces), spaces.num_agents))]
        advice = f"use a group within {plane[-1]}" if plane else instead or f"use {carried[0]}"
        if isinstance(spaces.action, Discrete) and _reason(representation.action_map, spaces.action, moved):
            advice = advice.replace("use ", "use continuous actions or ", 1)
    raise UserError(f"{text} cannot act on {spaces.label}: {reason}; {advice}")


def admit_declared(spaces: Spaces) -> None:
    """Refuse the symmetry that a task declares, or declares nearly, where its actions or layouts cannot carry it."""
    for text in filter(None, (spaces.symmetry, spaces.nearly)):
        declared = replace(spaces, symmetry=text, nearly="")
        for name in _factors(declared):
            admit(name, parse_elements(name, spaces.num_agents), declared)


def carried_groups(spaces: Spaces) -> tuple[str, ...]:
    """Return the named groups that a task's actions and declared symmetry both carry, the largest planar one last."""
    agents = [AGENTS] if spaces.num_agents > 1 else []
    scene = scene_of(_usable(spaces), spaces.num_agents)
    names = dict.fromkeys([*PLANE_GROUPS, scene, *agents, *_factors(spaces)])
    return tuple(name for name in names if name not in ("", "c1") and carries(name, spaces))


def default_transforms(spaces: Spaces, weighed: bool = False) -> str:
    """Return the transforms of a task for which nobody chose any, as `parse_elements` takes them.

    d4 where the task carries it; else the planar part of its symmetry if that can be listed; else c4; else orders of
    its agents or items. Where it declares nothing, d4, which `admit` refuses. Where each element is `weighed` by how
    nearly it holds, nothing has to be declared: then d4 wherever actions and layouts carry it and it moves one of their
    numbers, and such orders, or elements coupled with some, beside it.
    """
    if isinstance(spaces, TaskSpec) and spaces.roles:
        own = [default_transforms(role, weighed) for role in spaces.roles]
        return next((name for name in own if all_carry(name, spaces.roles, weighed)), own[0])
    declared = _factors(spaces)
    listed = [name for name in declared[:1] if name != "so2"]
    chosen = next((name for name in ("d4", *listed, "c4", *declared) if carries(name, spaces)), "d4")
    d4 = _generating(parse_elements("d4", spaces.num_agents))
    if not weighed or not carries("d4", unrestricted(spaces)) or not moves_some_number(d4, spaces):
        return chosen
    found = parse_elements(chosen, spaces.num_agents)
    if isinstance(found, Group) or len(found) > _FEW_ORDERS:
        return "d4"
    return f"d4,{chosen}" if all(element.orders for element in found) else "d4"


def moves_some_number(elements: Sequence[Element], spaces: Spaces) -> bool:
    """Return whether some element moves a number of a task, as a turn of scalars alone does not."""
    seen = representation.rows_operator(spaces.observation, elements, spaces.num_agents)
    moved = (seen, representation.state_operator(spaces, elements), representation.output_operator(spaces, elements))
    return not all(operator.is_identity for operator in moved)


def all_carry(name: str, roles: Sequence[TaskSpec], weighed: bool = False) -> bool:
    """Return whether every role carries what a name means to it; where it is `weighed`, nothing has to be declared."""
    meant = [(name if role.num_agents > 1 else without_agents(name), role) for role in roles]
    return all(not text or carries(text, unrestricted(role) if weighed else role) for text, role in meant)


def scene_of(symmetry: str, num_agents: int) -> str:
    """Return what a symmetry does to the scene, with coupled orders if there are: "d4", "flip-x*hips-1-0"."""
    return "*".join(group.name for group in _declared(symmetry, num_agents) if rank(group)[0] == 0)


def _factors(spaces: Spaces) -> list[str]:
    """Return the factors of a task's symmetry that move something, the scene's first: ["d4", "agents"]."""
    symmetry = _usable(spaces)
    orders = [group.name for group in _declared(symmetry, spaces.num_agents) if rank(group)[0]]
    return [name for name in (scene_of(symmetry, spaces.num_agents), *orders) if name not in ("", "c1")]


def _declared(symmetry: str, num_agents: int) -> list[Group]:
    """Return the independent groups of a symmetry, "c1" for those that no task writes."""
    return declared_factors("c1" if symmetry == _ANYTHING else symmetry.replace(_ANY_SCENE, "c1"), num_agents)


def _usable(spaces: Spaces) -> str:
    """Return the symmetry that a prior may use: one that holds nearly, else the one that holds."""
    return spaces.nearly or spaces.symmetry


def exchangeable(spaces: Spaces) -> dict[str, int]:
    """Return the fields whose items may change places as far as layouts tell, each with how many it has.

    An agent sees two to `MOST_ITEMS` of them, they are no pictures, are not sorted and follow no agents, the state has
    them too, and the name is one word of letters, digits and underscores.
    """
    own = {field.name for field in spaces.state.fields}
    return {
        field.name: field.count
        for field in spaces.observation.fields
        if field.items is Items.FIXED and field.pixels is None and 2 <= field.count <= MOST_ITEMS
        if not field.sorted_by
        if field.name in own or spaces.joint_fields is not None
        if is_item_name(field.name)
    }


def unrestricted(spaces: Spaces) -> Spaces:
    """Return spaces without a declaration to hold to: actions and layouts alone say what is carried."""
    return replace(spaces, nearly=_ANYTHING)


def under_a_compass(spaces: Spaces) -> Spaces:
    """Return spaces whose agents see a compass and labels: they admit all that moves the scene, and orders of agents.

    Orders of items are admitted as declared before.
    """
    items = [group.name for group in _declared(_usable(spaces), spaces.num_agents) if rank(group)[0] == 2]
    return replace(spaces, nearly="*".join([_ANY_SCENE, AGENTS, *items]))


def declares(symmetry: str, num_agents: int) -> Callable[[Element], bool]:
    """Return what says whether a declared symmetry holds an element."""
    if symmetry == _ANYTHING:
        return lambda _: True
    group = ProductGroup(*_declared(symmetry, num_agents))
    if symmetry.startswith(_ANY_SCENE):
        return lambda element: Element(permutation=element.permutation, items=element.items) in group
    return lambda element: element in group


def carries(name: str, spaces: Spaces) -> bool:
    """Return whether a task's actions, layouts and declared symmetry carry elements or a group, by name."""
    return _reason(_require, _generating(parse_elements(name, spaces.num_agents)), spaces) is None


def _generating(elements: Sequence[Element] | Group) -> tuple[Element, ...]:
    """Return elements whose products are all that is meant: a group's generators."""
    return tuple(elements.generators() if isinstance(elements, Group) else elements)


def _reason(check: Callable[..., object], *args: object) -> str | None:
    try:
        check(*args)
    except UserError as error:
        return str(error)
    return None


def _require(elements: Sequence[Element], spaces: Spaces) -> None:
    scenes = tuple(dict.fromkeys(element.in_place for element in elements))
    declared = declares(_usable(spaces), spaces.num_agents)
    undeclared = [element for element in elements if not declared(element)]
    if isinstance(spaces.action, Discrete):
        representation.action_map(spaces.action, scenes)
    for element in undeclared:
        if not declared(element.in_place):
            carried = scene_of(_usable(spaces), spaces.num_agents) or "c1"
            raise UserError(f"{element.in_place.name} is no symmetry of its dynamics and reward, which carry {carried}")
    acted = [spaces.action.layout] if isinstance(spaces.action, Continuous) else []
    for layout in (spaces.observation, spaces.state, *acted):
        for field in layout.fields:
            representation.item_places(field, elements)
        representation.layout_operator(layout, scenes)
    _require_followed(elements, spaces)
    for element in undeclared:
        _require_orders(element, declared, spaces)


def _require_followed(elements: Sequence[Element], spaces: Spaces) -> None:
    """Refuse orders of agents or items that observation and state do not follow."""
    places = representation.agent_places(elements, spaces.num_agents)
    if places is not None:
        if spaces.joint_fields is None and all(f.items is not Items.AGENTS for f in spaces.state.fields):
            raise UserError("its state does not say which numbers belong to which agent")
        representation.joint_sources(spaces.observation, places[:1])
        representation.state_operator(spaces, [Element(permutation=tuple(places[0].tolist()))])
    representation.require_items(elements, spaces)
    seen, held = ({field.name for field in layout.fields} for layout in (spaces.observation, spaces.state))
    for name in dict.fromkeys(name for element in elements for name, _ in element.items):
        if name in seen and name not in held and spaces.joint_fields is None:
            raise UserError(f"its state does not hold its {name}")


def _require_orders(element: Element, declared: Callable[[Element], bool], spaces: Spaces) -> None:
    """Refuse orders of agents or items that are not declared."""
    usable = _usable(spaces)
    for name, order in element.orders:
        part = Element(permutation=order) if name == AGENTS else Element(items=((name, order),))
        if not declared(part):
            what = AGENTS if name == AGENTS else f"its {name}"
            alone = " by themselves" if f"*{name}-" in usable else ""
            raise UserError(f"its declared symmetry, {usable}, does not say that {what} may be exchanged{alone}")
