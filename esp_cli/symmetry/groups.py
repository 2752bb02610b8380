"""Groups from generators, orders of agents and items, and direct products; `plane` has those of the plane."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from functools import cached_property, lru_cache, reduce
from itertools import permutations, product
from operator import matmul
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from esp_cli.symmetry.elements import AGENTS, Element, Geometry
from esp_envs.errors import UserError

LISTED_LIMIT = 1024  # most elements that are listed; larger groups (all orders of 7 agents: 5040) are sampled instead
MOST_ITEMS = 6  # most items of a field all of whose orders make a group


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

    @cached_property
    def aspects(self) -> frozenset[Any]:
        """All that its elements act on, see `Element.aspects`."""
        return frozenset[Any]().union(*(element.aspects for element in self.generators()))


class FiniteGroup(Group):
    """A listed group of G elements, sorted by `Element.sort_key`: identity first.

    FiniteGroup.generated_by("d2", [rotation(180), mirror()]).order # 4
    """

    def __init__(self, name: str, elements: Iterable[Element]) -> None:
        self.name = name
        self.elements = tuple(sorted(set(elements), key=lambda e: e.sort_key))
        self._index = {element: i for i, element in enumerate(self.elements)}

    @classmethod
    def generated_by(cls, name: str, generators: Iterable[Element | Geometry]) -> FiniteGroup:
        """Build the smallest group that holds the generators, of at most `LISTED_LIMIT` elements."""
        gens = tuple(map(Element.of, generators))
        found, frontier = {Element()}, [Element()]
        while frontier:
            # In a finite group, products of generators already contain every inverse.
            frontier = [p for p in {g @ h for g in gens for h in frontier} if p not in found]
            found.update(frontier)
            if len(found) > LISTED_LIMIT:
                raise UserError(f"'{name}' has more than {LISTED_LIMIT} elements; use a smaller group or so2, o2")
        return cls(name, found)

    @property
    def order(self) -> int:
        return len(self.elements)

    @cached_property
    def product(self) -> NDArray[np.int64]:
        """The product table [G, G]: entry (i, j) is the index of elements[i] @ elements[j]."""
        return np.array([[self._index[g @ h] for h in self.elements] for g in self.elements])

    def draw(self, generator: torch.Generator) -> Element:
        return self.elements[int(torch.randint(self.order, (), generator=generator))]

    def __contains__(self, element: object) -> bool:
        return element in self._index

    def generators(self) -> tuple[Element, ...]:
        return self.elements


class AgentPermutations(Group):
    """All orders of N agents, sampled; for N with more than `LISTED_LIMIT` orders."""

    def __init__(self, num_agents: int) -> None:
        self.name = AGENTS
        self.num_agents = num_agents

    def draw(self, generator: torch.Generator) -> Element:
        return Element(permutation=tuple(torch.randperm(self.num_agents, generator=generator).tolist()))

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, Element) or element != Element(permutation=element.permutation):
            return False
        return element.permutation is None or len(element.permutation) == self.num_agents

    def generators(self) -> tuple[Element, ...]:
        return tuple(Element(permutation=order) for order in swap_and_round(self.num_agents))


class ProductGroup(Group):
    """The direct product of groups that act on different aspects, sampled factor by factor."""

    def __init__(self, *factors: Group) -> None:
        self.name = "*".join(factor.name for factor in factors)
        self.factors = factors

    def draw(self, generator: torch.Generator) -> Element:
        return reduce(matmul, [factor.draw(generator) for factor in self.factors])

    def __contains__(self, element: object) -> bool:
        if not isinstance(element, Element):
            return False
        parts = [element.restricted(factor.aspects) for factor in self.factors]
        within = all(part in factor for part, factor in zip(parts, self.factors, strict=True))
        return within and reduce(matmul, parts, Element()) == element

    def generators(self) -> tuple[Element, ...]:
        return tuple(element for factor in self.factors for element in factor.generators())


def swap_and_round(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the exchange of the first two of some things and the round of all, which generate every order of them."""
    return (1, 0, *range(2, count)), (*range(1, count), 0)


@lru_cache(maxsize=16)
def agent_permutations(num_agents: int) -> Group:
    """Return S_N: listed up to `LISTED_LIMIT` orders, sampled beyond."""
    if num_agents < 2:
        raise UserError("agents can only change places where there are two or more; choose a planar group")
    if math.factorial(num_agents) > LISTED_LIMIT:
        return AgentPermutations(num_agents)
    return FiniteGroup(AGENTS, (Element(permutation=p) for p in permutations(range(num_agents))))


def item_orders(field: str, count: int) -> FiniteGroup:
    """Return all orders of a field's items."""
    if not 2 <= count <= MOST_ITEMS:
        raise UserError(f"{count} {field} have no group of orders; 2 to {MOST_ITEMS} like items of a field have one")
    return FiniteGroup(f"{field}-{count}", (Element(items=((field, p),)) for p in permutations(range(count))))


def are_independent(groups: Iterable[Group]) -> bool:
    """Return whether no two groups act on a common aspect, so that they have a direct product."""
    aspects = [group.aspects for group in groups]
    return sum(map(len, aspects)) == len(frozenset[Any]().union(*aspects))


def direct_product(*factors: Group) -> Group:
    """Return the direct product of groups that act on different aspects, listed where small enough."""
    if not factors:
        return FiniteGroup("c1", [Element()])
    if len(factors) == 1:
        return factors[0]
    sampled = ProductGroup(*factors)
    listed = [factor.elements for factor in factors if isinstance(factor, FiniteGroup)]
    if len(listed) < len(factors) or math.prod(map(len, listed)) > LISTED_LIMIT:
        return sampled
    return FiniteGroup(sampled.name, (reduce(matmul, each) for each in product(*listed)))
