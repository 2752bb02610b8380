"""Read transforms and groups from text: `rot90,flip-x`, `d4`, `so2`, `d4*agents`, `d4*landmarks-3`."""

from __future__ import annotations

import re
from collections.abc import Callable
from fractions import Fraction
from functools import reduce

from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.groups import (
    LISTED_LIMIT,
    FiniteGroup,
    Group,
    agent_permutations,
    cyclic,
    dihedral,
    direct_product,
    item_orders,
    orthogonal,
    special_orthogonal,
)
from esp_cli.symmetry.plane import PlaneElement, mirror, rotation

_NAMED = {
    "identity": PlaneElement(),
    "flip-x": mirror(0),
    "flip-diagonal": mirror(45),
    "flip-y": mirror(90),
    "flip-antidiagonal": mirror(135),
}
_KNOWN = "rot90, rot45, flip-x, flip-y, flip-diagonal, flip-antidiagonal, c4, d4, c8, so2, o2, agents, d4*agents"
_DEGREES = r"(\d+(?:\.\d+)?|\d+/0*[1-9]\d*)"
_ORDER = r"(?!(?:rot|flip)-)([a-z]\w*)((?:-\d{1,4})+)"
"""A field and numbers: how many items it has, or the place that each of them moves to."""
_MAX_FOLD = 360


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
        ValueError: an unknown name, nothing besides the identity, or a sampled group that does not stand alone.
    """
    items = [_item(part.strip(), text, num_agents) for part in text.lower().split(",")]
    listed = [item for item in items if isinstance(item, tuple)]
    if len(listed) < len(items):
        if len(items) == 1 and isinstance(items[0], Group):
            return items[0]
        raise ValueError(f"transforms '{text}' list a group that is sampled; let so2, o2 or a large group stand alone")
    unique = tuple(dict.fromkeys(e for item in listed for e in item if not e.is_identity))
    if not unique:
        raise ValueError(f"transforms '{text}' hold only the identity; name one that moves something")
    return unique


def parse_group(text: str, num_agents: int) -> Group:
    """Read one group name or a product of a planar group, `agents` and orders of items: a task's declared symmetry.

    Raises:
        ValueError: unknown, or no group.
    """
    factors = [_factor(part.strip(), text, num_agents) for part in text.lower().split("*")]
    groups = [f for f in factors if isinstance(f, Group)]
    if len(groups) != len(factors):
        raise ValueError(f"'{text}' is not a group; write for example c4, d4, o2, agents or d4*agents")
    ranks = [_rank(group) for group in groups]
    if ranks != sorted(set(ranks)):
        raise ValueError(f"'{text}' is not a direct product; write a planar group, then agents, as in d4*agents")
    return groups[0] if len(groups) == 1 else direct_product(*groups)


def is_planar(name: str) -> bool:
    """Return whether a factor of a group's name is its planar part: neither agents nor items change places."""
    return name != "agents" and not re.fullmatch(_ORDER, name)


def planar_part(symmetry: str) -> str:
    """Return the planar part of a task's symmetry; empty where there is none."""
    return "*".join(name for name in symmetry.split("*") if is_planar(name))


def name_of_orders(name: str, count: int) -> str:
    """Return the name of the group of all orders of agents, or of a field's items: "agents", "landmarks-3"."""
    return name if name == "agents" else f"{name}-{count}"


def _rank(group: Group) -> tuple[int, str]:
    """Return where a group stands in a direct product: plane, agents, items of each field by name."""
    if is_planar(group.name):
        return 0, ""
    return (1, "") if group.name == "agents" else (2, group.name.partition("-")[0])


def _item(part: str, text: str, num_agents: int) -> tuple[Element, ...] | Group:
    """Read one item of the list: a tuple of elements, or a group that has to be sampled."""
    factors = [_factor(p.strip(), text, num_agents) for p in part.split("*")]
    groups = [f for f in factors if isinstance(f, Group)]
    if len(groups) == len(factors) and (len(groups) == 1 or not is_planar(groups[-1].name)):
        group = parse_group(part, num_agents)
        return group.elements if isinstance(group, FiniteGroup) else group
    lists = []
    for factor in factors:
        if isinstance(factor, Group) and not isinstance(factor, FiniteGroup):
            raise ValueError(f"'{part}' multiplies a sampled group; write a planar group times agents, as in o2*agents")
        lists.append(factor.elements if isinstance(factor, FiniteGroup) else (factor,))
    if len({type(element) for elements in lists for element in elements}) > 1:
        raise ValueError(f"'{part}' multiplies transforms of several kinds; list them with commas, or choose one kind")
    size = reduce(lambda a, b: a * b, (len(x) for x in lists))
    if size > LISTED_LIMIT:
        raise ValueError(f"'{part}' has {size} products, more than {LISTED_LIMIT}; use fewer factors")
    return reduce(lambda a, b: tuple(g @ h for g in a for h in b), lists)


def _factor(word: str, text: str, num_agents: int) -> Element | Group:
    """Read one word: an element or a group."""
    for read in READERS:
        if (found := read(word, num_agents)) is not None:
            return found
    where = f" in '{text}'" if word != text else ""
    raise ValueError(f"unknown transform '{word}'{where}; write for example {_KNOWN}")


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
    sigma = tuple(int(x) for x in word.split("-")[1:])
    if sorted(sigma) != list(range(num_agents)):
        order = "-".join(map(str, (*range(1, num_agents), 0)))
        raise ValueError(
            f"'{word}' is not an order of {num_agents} agents; write each place once, as in agents-{order}"
        )
    return PlaneElement(permutation=sigma)


def _read_items(word: str, _: int) -> Element | Group | None:
    if not (match := re.fullmatch(_ORDER, word)):
        return None
    name, numbers = match[1], tuple(int(x) for x in match[2].split("-")[1:])
    return item_orders(name, *numbers) if len(numbers) == 1 else PlaneElement(items=((name, numbers),))


READERS: list[Callable[[str, int], Element | Group | None]] = [_read_plane, _read_agents, _read_items]
"""What reads a word for N agents, or returns None; each kind of transform has its own."""


def _polygon(letter: str, n: int) -> FiniteGroup:
    if not 1 <= n <= _MAX_FOLD:
        raise ValueError(f"group '{letter}{n}' is out of range; take n from 1 to {_MAX_FOLD}, or so2 / o2")
    return cyclic(n) if letter == "c" else dihedral(n)
