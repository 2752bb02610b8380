"""Read transforms and groups from text: `rot90,flip-x`, `d4`, `so2`, `d4*agents`, `d4*landmarks-3`."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce

from esp_cli.symmetry.elements import Element, order_name
from esp_cli.symmetry.groups import (
    LISTED_LIMIT,
    MOST_ITEMS,
    FiniteGroup,
    Group,
    agent_permutations,
    cyclic,
    dihedral,
    direct_product,
    item_orders,
    orthogonal,
    special_orthogonal,
    swap_and_round,
)
from esp_cli.symmetry.plane import PlaneElement, mirror, rotation
from esp_envs.errors import UserError

_NAMED = {
    "identity": PlaneElement(),
    "flip-x": mirror(0),
    "flip-diagonal": mirror(45),
    "flip-y": mirror(90),
    "flip-antidiagonal": mirror(135),
}
_KNOWN = "rot90, rot45, flip-x, flip-y, flip-diagonal, c4, d4, c8, so2, o2, agents, landmarks-3, d4*agents"
_DEGREES = r"(\d+(?:\.\d+)?|\d+/0*[1-9]\d*)"
_ORDER = r"(?!(?i:rot|flip|agents)-)([A-Za-z]\w*)((?:-\d{1,4})+)"
"""A field and numbers: how many items it has, or the place that each of them moves to."""
_MAX_FOLD = 360
_PLANE = (0, "")
"""Rank of planar groups in a direct product, see `_rank`."""


def parse_elements(text: str, num_agents: int) -> tuple[Element, ...] | Group:
    """Read a comma-separated list of elements and groups.

    Args:
        text: elements (`rot90`, `flip-x`, `flip22.5`, `agents-1-0-2`, `landmarks-1-0-2`) and groups (`c4`, `d4`,
            `so2`, `o2`, `agents`, `landmarks-3`), each possibly a product with `*`, whose right factor acts first.
        num_agents: N, which gives `agents` its meaning.

    Returns:
        The non-identity elements in the order written, each once; or the group itself where it has to be sampled
        (continuous, or larger than `LISTED_LIMIT`).

    Raises:
        UserError: an unknown name, nothing besides the identity, or a sampled group that does not stand alone.
    """
    items = [_item(part.strip(), text, num_agents) for part in text.split(",")]
    listed = [item for item in items if isinstance(item, tuple)]
    if len(listed) < len(items):
        if len(items) == 1 and isinstance(items[0], Group):
            return items[0]
        raise UserError(f"transforms '{text}' list a group that is sampled; let so2, o2 or a large group stand alone")
    unique = tuple(dict.fromkeys(e for item in listed for e in item if not e.is_identity))
    if not unique:
        raise UserError(f"transforms '{text}' hold only the identity; name one that moves something")
    return unique


def parse_group(text: str, num_agents: int) -> Group:
    """Read one group name or a product of a planar group, `agents` and orders of items: a task's declared symmetry.

    Raises:
        UserError: unknown, or no group.
    """
    factors = [_factor(part.strip(), text, num_agents) for part in text.split("*")]
    groups = [f for f in factors if isinstance(f, Group)]
    if len(groups) != len(factors):
        raise UserError(f"'{text}' is not a group; write for example c4, d4, o2, agents or d4*agents")
    ranked = {_rank(group): group for group in groups}
    if len(ranked) < len(groups) or (len(groups) > 1 and next(reversed(ranked)) == _PLANE):
        raise UserError(
            f"'{text}' is not a direct product; write a planar group, agents and fields, each once, as d4*agents"
        )
    return groups[0] if len(groups) == 1 else direct_product(*(ranked[rank] for rank in sorted(ranked)))


@dataclass(frozen=True)
class Factors:
    """What a task's symmetry moves: "d4*agents*landmarks-3".

    Attributes:
        plane: name of the planar part, empty where there is none.
        agents: whether agents change places.
        items: fields whose items change places, each with how many it has.
    """

    plane: str
    agents: bool
    items: dict[str, int]

    @classmethod
    def of(cls, symmetry: str) -> Factors:
        """Read a task's symmetry.

        Raises:
            UserError: it has one order of items, and not all.
        """
        plane, items = [], dict[str, int]()
        words = [part.strip() for part in symmetry.split("*")]
        for word in words:
            match = re.fullmatch(_ORDER, word)
            if match is None:
                plane += [word.lower()] if word.lower() != "agents" else []
            elif match[2].count("-") == 1:
                items[match[1]] = int(match[2][1:])
            else:
                count = match[2].count("-")
                raise UserError(f"'{word}' is one order of items; declare all of them, as in {match[1]}-{count}")
        return cls("*".join(plane), "agents" in map(str.lower, words), items)

    @property
    def name(self) -> str:
        """The symmetry as a task declares it."""
        return "*".join((*filter(None, [self.plane]), *(["agents"] if self.agents else []), *self.orders))

    @property
    def orders(self) -> list[str]:
        """The groups of all orders of items: ["landmarks-3"]."""
        return [f"{name}-{count}" for name, count in self.items.items()]

    def allow(self, name: str, count: int) -> bool:
        """Return whether agents (so named), or the items of a field, may take any order."""
        return self.agents if name == "agents" else self.items.get(name) == count


def is_item_name(name: str) -> bool:
    """Return whether orders of the items of a field with this name can be written: "landmarks-1-0-2"."""
    return "-" not in name and re.fullmatch(_ORDER, f"{name}-2") is not None


def _rank(group: Group) -> tuple[int, str]:
    """Return where a group stands in a direct product: plane, agents, items of each field by name."""
    moved = {name for element in group.generators() for name, _ in element.orders}
    if not moved:
        return _PLANE
    return (1, "") if moved == {"agents"} else (2, min(moved))


def _item(part: str, text: str, num_agents: int) -> tuple[Element, ...] | Group:
    """Read one item of the list: a tuple of elements, or a group that has to be sampled."""
    factors = [_factor(p.strip(), text, num_agents) for p in part.split("*")]
    groups = [f for f in factors if isinstance(f, Group)]
    if len(groups) == len(factors) and (len(groups) == 1 or _rank(groups[-1]) != _PLANE):
        group = parse_group(part, num_agents)
        return group.elements if isinstance(group, FiniteGroup) else group
    lists = []
    for factor in factors:
        if isinstance(factor, Group) and not isinstance(factor, FiniteGroup):
            raise UserError(f"'{part}' multiplies a sampled group; write a planar group times agents, as in o2*agents")
        lists.append(factor.elements if isinstance(factor, FiniteGroup) else (factor,))
    if len({type(element) for elements in lists for element in elements}) > 1:
        raise UserError(f"'{part}' multiplies transforms of several kinds; list them with commas, or choose one kind")
    size = reduce(lambda a, b: a * b, (len(x) for x in lists))
    if size > LISTED_LIMIT:
        raise UserError(f"'{part}' has {size} products, more than {LISTED_LIMIT}; use fewer factors")
    return reduce(lambda a, b: tuple(g @ h for g in a for h in b), lists)


def _factor(word: str, text: str, num_agents: int) -> Element | Group:
    """Read one word: an element or a group."""
    for read in READERS:
        if (found := read(word.lower(), num_agents)) is not None:
            return found
    if (orders := _read_items(word)) is not None:
        return orders
    where = f" in '{text}'" if word != text else ""
    raise UserError(f"unknown transform '{word}'{where}; write for example {_KNOWN}")


def _read_plane(word: str, _: int) -> Element | Group | None:
    if word in _NAMED:
        return _NAMED[word]
    if word in ("so2", "o2"):
        return special_orthogonal() if word == "so2" else orthogonal()
    if match := re.fullmatch(r"([cd])(\d{1,3})", word):
        return _polygon(match[1], int(match[2]))
    if match := re.fullmatch("rot" + _DEGREES, word):
        return rotation(Fraction(match[1]))
    if match := re.fullmatch("flip-?" + _DEGREES, word):
        return mirror(Fraction(match[1]))
    return None


def _read_agents(word: str, num_agents: int) -> Element | Group | None:
    if word == "agents":
        return agent_permutations(num_agents)
    if not re.fullmatch(r"agents(-\d{1,4})+", word):
        return None
    return PlaneElement(permutation=_order(word, num_agents))


READERS: list[Callable[[str, int], Element | Group | None]] = [_read_plane, _read_agents]
"""What reads a word for N agents, or returns None; each kind of transform has its own."""


def _read_items(word: str) -> Element | Group | None:
    """Read an order of a field's items, or all orders; fields keep their capitals, and come after all other words."""
    if not (match := re.fullmatch(_ORDER, word)):
        return None
    count = match[2].count("-")
    if count > 1:
        return PlaneElement(items=((match[1], _order(word, count)),))
    items = int(match[2][1:])
    return item_orders(match[1], items) if 2 <= items <= MOST_ITEMS else None


def _order(word: str, count: int) -> tuple[int, ...]:
    """Read the place that each of some things moves to: "agents-1-0-2".

    Raises:
        UserError: it is no order of so many.
    """
    name, *numbers = word.split("-")
    places = tuple(map(int, numbers))
    if sorted(places) != list(range(count)):
        example = order_name(name, swap_and_round(count)[1])
        raise UserError(f"'{word}' is not an order of {count} {name}; write each place once, as in {example}")
    return places


def _polygon(letter: str, n: int) -> FiniteGroup:
    if not 1 <= n <= _MAX_FOLD:
        raise UserError(f"group '{letter}{n}' is out of range; take n from 1 to {_MAX_FOLD}, or so2 / o2")
    return cyclic(n) if letter == "c" else dihedral(n)
