"""Name the largest group that elements make up: "d4*agents", "c6", "flip-x"."""

from __future__ import annotations

import math
from collections.abc import Sequence

from esp_cli.symmetry import Element, FiniteGroup, Group, parse_elements
from esp_cli.symmetry.admission import DISCOVERED
from esp_cli.symmetry.groups import MOST_ITEMS
from esp_cli.symmetry.plane import PlaneElement, mirror

_MOST_CORNERS = 64
"""A turn by another part of the whole than one of these stands for all angles, as 57 degrees."""


def named(accepted: Sequence[Element], tried: Sequence[Element], scene: str = "") -> tuple[str, str]:
    """Return the name of the largest group that the accepted elements close to, and what `--transforms` takes.

    A group of the scene counts where all of its elements that were tried are accepted, and generate it. All orders of
    agents, or of a field's items, count where the accepted orders generate them.

    Args:
        accepted: elements that hold.
        tried: all elements.
        scene: a group that is no polygon's, as of legs, which is looked at too. Coupled generators, as
            flip-x*agents-1-0, count one by one.
    """
    plane, text = _scene([e for e in accepted if not e.orders], [e for e in tried if not e.orders], scene)
    whole, single = _orders_of(accepted)
    glue = " and " if "," in plane else "*"
    name = " and ".join([glue.join((plane, *whole)), *([",".join(single)] if single else [])])
    glue = "," if "," in plane else "*"
    product = glue.join(part for part in (text, *whole) if part)
    texts = (",".join(part for part in (product, *single) if part), product, text)
    return name, next((DISCOVERED + part for part in texts if part and _is_readable(part, accepted)), "")


def _scene(accepted: Sequence[Element], tried: Sequence[Element], scene: str) -> tuple[str, str]:
    """Return the name and `--transforms` of the largest group of the scene whose tried elements are all accepted."""
    held, seen = set(accepted), {e: PlaneElement.of(e) for e in tried if _is_planar(e)}
    turns, mirrors = ([e for e, plane in seen.items() if plane.mirrored == mirrored] for mirrored in (False, True))
    if held.issuperset(turns) and any(seen[e].turn.denominator > _MOST_CORNERS for e in turns):
        name = "o2" if mirrors and held.issuperset(mirrors) else "so2"
        return name, name
    groups = _polygon_groups([e for e, plane in seen.items() if plane.turn.denominator <= _MOST_CORNERS])
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


def _polygon_groups(tried: Sequence[Element]) -> list[tuple[str, tuple[Element, ...]]]:
    """Return the cyclic and dihedral groups that hold some of the tried elements, by name, without the identity."""
    mirrored = [PlaneElement.of(e).mirrored for e in tried]
    turns = (PlaneElement.of(e).turn for e, is_mirror in zip(tried, mirrored, strict=True) if not is_mirror)
    folds = sorted({turn.denominator for turn in turns})
    axes = [e for e, is_mirror in zip(tried, mirrored, strict=True) if is_mirror]
    found: list[tuple[str, tuple[Element, ...]]] = [(axis.name, (axis,)) for axis in axes] + [
        (f"c{fold}", _listed(f"c{fold}")) for fold in folds
    ]
    for axis in axes:
        for fold in folds:
            turned = _listed(f"c{fold}")
            group = (*turned, *sorted((axis, *(turn @ axis for turn in turned)), key=lambda e: e.sort_key))
            name = f"d{fold}" if Element.of(mirror()) in group else ",".join(e.name for e in group)
            found.append((name, group))
    return found


def _orders_of(accepted: Sequence[Element]) -> tuple[list[str], list[str]]:
    """Return the groups of all orders of agents or items, and the accepted elements with orders that make up none."""
    found, whole = dict[tuple[str, int], list[Element]](), list[str]()
    single = [element.name for element in accepted if element.orders and not element.in_place.is_identity]
    for element in accepted:
        if len(element.orders) == 1 and element.in_place.is_identity:
            name, places = element.orders[0]
            found.setdefault((name, len(places)), []).append(element)
    for (name, count), elements in sorted(found.items(), key=lambda one: (one[0][0] != "agents", one[0])):
        if _mix(elements, count):
            whole.append(name if name == "agents" else f"{name}-{count}")
        else:
            single += [element.name for element in elements]
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
    try:
        parse_elements(text, max((len(e.permutation or ()) for e in accepted), default=1))
    except ValueError:
        return False
    return True
