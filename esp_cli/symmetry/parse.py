"""Reading of transforms and groups from text: `rot90,flip-x`, `d4`, `so2`, `d4*agents`, `flip-x*hips-3-2-1-0`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import reduce
from operator import matmul

from esp_cli.files.formatting import shortened
from esp_cli.symmetry.elements import AGENTS, Element, Geometry, order_name
from esp_cli.symmetry.groups import (
    LISTED_LIMIT,
    MOST_ITEMS,
    FiniteGroup,
    Group,
    agent_permutations,
    are_independent,
    direct_product,
    item_orders,
    swap_and_round,
)
from esp_cli.symmetry.plane import read_plane
from esp_envs.errors import UserError

_KNOWN = "rot90, rot45, flip-x, flip-y, flip-diagonal, c4, d4, c8, so2, o2, agents, landmarks-3, d4*agents"
# a field and numbers: how many items it has, or the place that each of them moves to
_ORDER = r"(?!(?i:rot|flip|agents)-)([A-Za-z]\w*)((?:-\d{1,4})+)"


def parse_elements(text: str, num_agents: int) -> tuple[Element, ...] | Group:
    """Read a comma-separated list of elements and groups.

    Elements are as `rot90`, `flip-x`, `flip22.5`, `agents-1-0-2`, `landmarks-1-0-2`, groups as `c4`, `d4`, `so2`, `o2`,
    `agents`, `landmarks-3`, each possibly a product with `*`, whose right factor acts first. Returned are the
    non-identity elements in the order written, each once; or the group itself where it has to be sampled (continuous,
    or larger than `LISTED_LIMIT`), which has to stand alone.
    """
    items = [_item(part.strip(), text, num_agents) for part in text.split(",")]
    listed = [item for item in items if isinstance(item, tuple)]
    if len(listed) < len(items):
        if len(items) == 1 and isinstance(items[0], Group):
            return items[0]
        said = f"transforms '{shortened(text)}' list a group that is sampled"
        raise UserError(f"{said}; let so2, o2 or a large group stand alone")
    unique = tuple(dict.fromkeys(e for item in listed for e in item if not e.is_identity))
    if not unique:
        raise UserError(f"transforms '{shortened(text)}' hold only the identity; name one that moves something")
    return unique


def parse_group(text: str, num_agents: int) -> Group:
    """Read a declared symmetry: groups, and elements as generators, `d4*agents` or `flip-x*hips-3-2-1-0`.

    Factors that act on different things make their direct product; a comma, or a common thing, all that they generate.
    """
    return direct_product(*declared_factors(text, num_agents))


def declared_factors(text: str, num_agents: int) -> list[Group]:
    """Return independent groups whose direct product is a declared symmetry, see `parse_group`."""
    groups = [group for part in text.split(",") for group in _declared(part.strip(), text, num_agents)]
    if are_independent(groups):
        return sorted(groups, key=rank)
    if not all(isinstance(group, FiniteGroup) for group in groups):
        said = f"'{shortened(text)}' generates no group that can be listed"
        raise UserError(f"{said}; let so2, o2 or many agents act on their own")
    return [FiniteGroup.generated_by(text, [g for group in groups for g in group.generators()])]


def _declared(part: str, text: str, num_agents: int) -> list[Group]:
    """Return the groups of a product, and that which the product of its elements generates."""
    words = [word.strip() for word in part.split("*")]
    if num_agents < 2:  # one agent has no others to change places with
        words = [word for word in words if word.lower() != AGENTS]
    factors = [_factor(word, text, num_agents) for word in words]
    elements = [factor for factor in factors if isinstance(factor, Element)]
    groups = [factor for factor in factors if isinstance(factor, Group)]
    if elements:
        name = "*".join(word for word, factor in zip(words, factors, strict=True) if isinstance(factor, Element))
        groups.append(FiniteGroup.generated_by(name, [reduce(matmul, elements)]))
    return groups


def is_item_name(name: str) -> bool:
    """Return whether orders of the items of a field with this name can be written: "landmarks-1-0-2"."""
    return "-" not in name and re.fullmatch(_ORDER, f"{name}-2") is not None


def rank(group: Group) -> tuple[int, str]:
    """Return where a group stands in a direct product: scene 0, agents 1, items of each field by name 2."""
    names = [aspect for aspect in group.aspects if isinstance(aspect, str)]
    if len(names) < len(group.aspects) or not names:
        return (0, "")
    return (1, "") if names == [AGENTS] else (2, min(names))


def _item(part: str, text: str, num_agents: int) -> tuple[Element, ...] | Group:
    factors = [_factor(word.strip(), text, num_agents) for word in part.split("*")]
    groups = [factor for factor in factors if isinstance(factor, Group)]
    if len(groups) == len(factors):
        of_scene = [not any(isinstance(aspect, str) for aspect in group.aspects) for group in groups]
        ordered = len(groups) == 1 or not of_scene[-1]
        if are_independent(groups) and (ordered or all(of_scene)):
            group = direct_product(*sorted(groups, key=rank))
            return group.elements if isinstance(group, FiniteGroup) else group
        if ordered:
            said = f"'{shortened(part)}' is not a direct product"
            raise UserError(f"{said}; write each thing that moves once, as in d4*agents")
    lists = []
    for factor in factors:
        if isinstance(factor, Group) and not isinstance(factor, FiniteGroup):
            said = f"'{shortened(part)}' multiplies a sampled group"
            raise UserError(f"{said}; write a planar group times agents, as in o2*agents")
        lists.append(factor.elements if isinstance(factor, FiniteGroup) else (factor,))
    size = math.prod(map(len, lists))
    if size > LISTED_LIMIT:
        raise UserError(f"'{shortened(part)}' has {size} products, more than {LISTED_LIMIT}; use fewer factors")
    return reduce(lambda a, b: tuple(g @ h for g in a for h in b), lists)


def _factor(word: str, text: str, num_agents: int) -> Element | Group:
    """Read one word: an element or a group. Fields keep their capitals, and come after all other words."""
    read = (reader(word.lower(), num_agents) for reader in READERS)
    found = next((one for one in read if one is not None), None)
    found = _read_items(word) if found is None else found
    if found is None:
        where = f" in '{shortened(text)}'" if word != text else ""
        raise UserError(f"unknown transform '{shortened(word)}'{where}; write for example {_KNOWN}")
    return found if isinstance(found, Group) else Element.of(found)


def _read_agents(word: str, num_agents: int) -> Element | Group | None:
    if word == AGENTS:
        return agent_permutations(num_agents)
    return Element(permutation=_order(word, num_agents)) if re.fullmatch(r"agents(-\d{1,4})+", word) else None


# what reads a word for N agents, or returns None; each kind of geometry has its own
READERS: list[Callable[[str, int], Element | Geometry | Group | None]] = [read_plane, _read_agents]


def _read_items(word: str) -> Element | Group | None:
    if not (match := re.fullmatch(_ORDER, word)):
        return None
    count = match[2].count("-")
    if count > 1:
        return Element(items=((match[1], _order(word, count)),))
    items = int(match[2][1:])
    return item_orders(match[1], items) if 2 <= items <= MOST_ITEMS else None


def _order(word: str, count: int) -> tuple[int, ...]:
    name, *numbers = word.split("-")
    places = tuple(map(int, numbers))
    if sorted(places) != list(range(count)):
        example = order_name(name, swap_and_round(count)[1])
        said = f"'{shortened(word)}' is not an order of {count} {name}"
        raise UserError(f"{said}; write each place once, as in {example}")
    return places
