"""Groups built from generators: C_n, D_n, SO(2), O(2), orders of agents or items, and their direct products."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from fractions import Fraction
from functools import cached_property, reduce
from itertools import permutations, product
from operator import matmul

import numpy as np
import torch
from numpy.typing import NDArray

from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.plane import PlaneElement, mirror
from esp_envs.errors import UserError

LISTED_LIMIT = 1024
"""Largest number of elements that is listed; larger groups (all orders of 7 agents: 5040) are sampled instead."""
MOST_ITEMS = 6
"""Items of a field all of whose orders make a group; of more, they are too many to list."""


class Group(ABC):
    """A group that can be drawn from and asked for membership; `FiniteGroup` can also be listed."""

    name: str

    @abstractmethod
    def draw(self, generator: torch.Generator) -> Element:
        """Draw one element uniformly (identity included) from a generator on the CPU."""

    @abstractmethod
    def __contains__(self, element: object) -> bool:
        """Whether the element belongs to the group."""

    @abstractmethod
    def generators(self) -> tuple[Element, ...]:
        """Return elements whose products are the group, or come near each of its elements if it is continuous."""


class FiniteGroup(Group):
    """A listed group, sorted by `Element.order`: identity first.

    Attributes:
        name: what `parse_elements` calls it.
        elements: all G elements.
    """

    def __init__(self, name: str, elements: Iterable[Element]) -> None:
        self.name = name
        self.elements = tuple(sorted(set(elements), key=lambda e: e.order))
        self._index = {element: i for i, element in enumerate(self.elements)}

    @classmethod
    def generated_by(cls, name: str, generators: Iterable[Element]) -> FiniteGroup:
        """Build the smallest group that holds the generators.

        Raises:
            UserError: it has more than `LISTED_LIMIT` elements.
        """
        gens = tuple(generators)
        identity = gens[0] @ gens[0].inverse()
        found, frontier = {identity}, [identity]
        while frontier:
            # In a finite group, products of generators already contain every inverse.
            frontier = [p for p in {g @ h for g in gens for h in frontier} if p not in found]
            found.update(frontier)
            if len(found) > LISTED_LIMIT:
                raise UserError(f"{name} has more than {LISTED_LIMIT} elements; use a smaller group or so2, o2")
        return cls(name, found)

    @property
    def order(self) -> int:
        """G, the number of elements."""
        return len(self.elements)

    @cached_property
    def product(self) -> NDArray[np.int64]:
        """The product table [G, G]: entry (i, j) is the index of elements[i] @ elements[j]."""
        return np.array([[self._index[g @ h] for h in self.elements] for g in self.elements])

    def draw(self, generator: torch.Generator) -> Element:
        """Draw uniformly; see `Group.draw`."""
        return self.elements[int(torch.randint(self.order, (), generator=generator))]

    def __contains__(self, element: object) -> bool:
        return element in self._index

    def generators(self) -> tuple[Element, ...]:
        """Return all elements."""
        return self.elements


class PlaneGroup(Group):
    """SO(2), all turns, or O(2), all turns and mirrors; drawn from the uniform (Haar) measure."""

    def __init__(self, mirrors: bool) -> None:
        self.name = "o2" if mirrors else "so2"
        self.mirrors = mirrors

    def draw(self, generator: torch.Generator) -> Element:
        """Draw an angle uniformly, and for O(2) a fair mirror flag."""
        turn = Fraction(float(torch.rand((), generator=generator, dtype=torch.float64)))
        mirrored = self.mirrors and bool(torch.randint(2, (), generator=generator))
        return PlaneElement(turn, mirrored)

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, PlaneElement) or element != element.in_place:
            return False
        return self.mirrors or not element.mirrored

    def generators(self) -> tuple[Element, ...]:
        """Return one radian (its multiples come near every turn) and, for O(2), `flip-x`."""
        radian = PlaneElement(Fraction(1 / math.tau))
        return (radian, mirror()) if self.mirrors else (radian,)


class AgentPermutations(Group):
    """All orders of N agents, sampled; for N with more than `LISTED_LIMIT` orders."""

    def __init__(self, num_agents: int) -> None:
        self.name = "agents"
        self.num_agents = num_agents

    def draw(self, generator: torch.Generator) -> Element:
        """Draw an order uniformly."""
        return PlaneElement(permutation=tuple(torch.randperm(self.num_agents, generator=generator).tolist()))

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, Element) or not element.in_place.is_identity or element.items:
            return False
        return element.permutation is None or len(element.permutation) == self.num_agents

    def generators(self) -> tuple[Element, ...]:
        """Return the swap of the first two agents and the round of all of them, which generate every order."""
        return tuple(PlaneElement(permutation=order) for order in swap_and_round(self.num_agents))


class ProductGroup(Group):
    """The direct product of a planar group, orders of agents and orders of items, sampled factor by factor."""

    def __init__(self, *factors: Group) -> None:
        self.name = "*".join(factor.name for factor in factors)
        self.factors = factors

    def draw(self, generator: torch.Generator) -> Element:
        """Draw each factor."""
        return reduce(matmul, [factor.draw(generator) for factor in self.factors])

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, Element):
            return False
        return all(part.is_identity or any(part in factor for factor in self.factors) for part in _parts(element))

    def generators(self) -> tuple[Element, ...]:
        """Return those of all factors."""
        return tuple(element for factor in self.factors for element in factor.generators())


def _parts(element: Element) -> Iterator[Element]:
    """Yield what an element does in the plane, to agents, and to the items of each field."""
    yield element.in_place
    yield PlaneElement(permutation=element.permutation)
    for order in element.items:
        yield PlaneElement(items=(order,))


def swap_and_round(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the exchange of the first two of some things and the round of all, which generate every order of them."""
    return (1, 0, *range(2, count)), (*range(1, count), 0)


def cyclic(n: int) -> FiniteGroup:
    """Return C_n, the turns by multiples of 360/n degrees."""
    return FiniteGroup.generated_by(f"c{n}", [PlaneElement(Fraction(1, n))])


def dihedral(n: int) -> FiniteGroup:
    """Return D_n, the 2n turns and mirrors of a regular n-gon with one corner on the x-axis."""
    return FiniteGroup.generated_by(f"d{n}", [PlaneElement(Fraction(1, n)), mirror()])


def special_orthogonal() -> PlaneGroup:
    """Return SO(2)."""
    return PlaneGroup(mirrors=False)


def orthogonal() -> PlaneGroup:
    """Return O(2)."""
    return PlaneGroup(mirrors=True)


def agent_permutations(num_agents: int) -> Group:
    """Return S_N: listed up to `LISTED_LIMIT` orders, sampled beyond.

    Raises:
        UserError: fewer than two agents.
    """
    if num_agents < 2:
        raise UserError("agents can only change places where there are two or more; choose a planar group")
    if math.factorial(num_agents) > LISTED_LIMIT:
        return AgentPermutations(num_agents)
    return FiniteGroup("agents", (PlaneElement(permutation=p) for p in permutations(range(num_agents))))


def item_orders(field: str, count: int) -> FiniteGroup:
    """Return all orders of a field's items.

    Raises:
        UserError: fewer than 2 items, or more than `MOST_ITEMS`.
    """
    if not 2 <= count <= MOST_ITEMS:
        raise UserError(f"{count} {field} have no group of orders; 2 to {MOST_ITEMS} like items of a field have one")
    return FiniteGroup(f"{field}-{count}", (PlaneElement(items=((field, p),)) for p in permutations(range(count))))


def direct_product(*factors: Group) -> Group:
    """Return the direct product of a planar group, orders of agents and orders of items, listed where small enough."""
    sampled = ProductGroup(*factors)
    listed = [factor.elements for factor in factors if isinstance(factor, FiniteGroup)]
    if len(listed) < len(factors) or math.prod(map(len, listed)) > LISTED_LIMIT:
        return sampled
    return FiniteGroup(sampled.name, (reduce(matmul, each) for each in product(*listed)))
