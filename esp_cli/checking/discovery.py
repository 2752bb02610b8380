"""Find symmetries that nobody declared: try many elements, keep those that are shown to hold, name their group.

An element is accepted where every field of it is shown to be off by less than a tolerance. The null hypothesis of each
field is that it is off by the tolerance or more; an element's p-value is the largest of its fields. The procedure
of Benjamini and Hochberg (1995) over all elements bounds the share of false ones among the accepted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from esp_cli.checking.candidates import candidates, generate
from esp_cli.checking.paired import check_paired
from esp_cli.checking.recorded import Transitions, collect
from esp_cli.checking.regression import MATERIAL, check_by_regression
from esp_cli.checking.verdicts import RANK, ElementVerdict
from esp_cli.symmetry import Element
from esp_cli.symmetry.admission import DISCOVERED, exchangeable
from esp_cli.symmetry.elements import order_name
from esp_cli.symmetry.parse import parse_elements
from esp_envs.conformance.subject import MakeWorlds
from esp_envs.spec import Spaces

FALSE_DISCOVERIES = 0.05
"""Share of false elements among the accepted, at most, in expectation."""
_TOLERATED_SD = 0.15
"""Gap between paired steps, in standard deviations, below which a field that is not found broken counts as equal."""
_EXCHANGES = 28
"""Exchanges of two that are tried, at most: all of 8 agents."""
_WORLDS = 256
_EPISODES = 4096


@dataclass(frozen=True)
class Tried:
    """What became of one element.

    Attributes:
        element: its name.
        accepted: whether it counts as a symmetry.
        p_value: of the hypothesis that it is off by the tolerance or more.
        gap: of the worst field, in the unit of the method.
        error: its standard error.
        field: the worst field.
    """

    element: str
    accepted: bool
    p_value: float
    gap: float
    error: float
    field: str


@dataclass(frozen=True)
class Discovery:
    """What was found.

    Attributes:
        source: the task, run or file.
        method: "paired states" or "transitions".
        group: the name of what was found: "d4*agents", "flip-x", "c1" for nothing.
        transforms: what `--transforms` takes to use it; empty where nothing was found.
        tried: one entry for each element.
    """

    source: str
    method: str
    group: str
    transforms: str
    tried: tuple[Tried, ...]


def discover_in_task(make: MakeWorlds, transforms: str | None = None, logs_alone: bool = False) -> Discovery:
    """Find the symmetries of a task; its declared symmetry is not looked at.

    Args:
        make: makes E worlds for some seeds.
        transforms: elements to try; by default those of `default_candidates`.
        logs_alone: use transitions of the random policy even where the task can be set to states.
    """
    probe = make(1, [0])
    spec, elements = probe.spec, default_candidates(probe.spec, transforms)
    if probe.has("set_state") and not logs_alone:
        verdicts = check_paired(make, elements)
        return _concluded(spec.name, "paired states", elements, verdicts, _TOLERATED_SD)
    data = collect(make(max(16, min(_WORLDS, 8192 // spec.horizon)), [0]), _EPISODES)
    return discover_in_transitions(spec.name, spec, data, transforms)


def discover_in_transitions(source: str, spaces: Spaces, data: Transitions, transforms: str | None = None) -> Discovery:
    """Find the symmetries of transitions of any policy; see `discover_in_task`."""
    elements = default_candidates(spaces, transforms)
    verdicts = check_by_regression(spaces, data, elements)
    return _concluded(source, "transitions", elements, verdicts, MATERIAL)


def accepted_of(p_values: Sequence[float]) -> list[bool]:
    """Return which hypotheses are rejected at the false discovery rate (Benjamini and Hochberg, 1995)."""
    ordered = sorted(p_values)
    bounds = [p for k, p in enumerate(ordered, 1) if p <= FALSE_DISCOVERIES * k / len(ordered)]
    return [bool(bounds) and p <= bounds[-1] for p in p_values]


def named(accepted: Sequence[Element], tried: Sequence[Element]) -> tuple[str, str]:
    """Return the name of the largest group that the accepted elements close to, and what `--transforms` takes.

    A planar group counts where all of its elements that were tried are accepted, and at least one was tried. All orders
    of agents, or of a field's items, count where the accepted exchanges of two connect each with each.

    Args:
        accepted: elements that hold.
        tried: all elements.
    """
    plane, text = _plane([e for e in accepted if e == e.in_place], tried)
    whole, single = _orders_of(accepted)
    glue = " and " if "," in plane else "*"
    name = " and ".join([glue.join((plane, *whole)), *([",".join(single)] if single else [])])
    glue = "," if "," in plane else "*"
    product = glue.join(part for part in (text, *whole) if part)
    texts = (",".join(part for part in (product, *single) if part), product, text)
    return name, next((DISCOVERED + part for part in texts if part and _is_readable(part, accepted)), "")


def _orders_of(accepted: Sequence[Element]) -> tuple[list[str], list[str]]:
    """Return the groups of all orders of agents or items, and the accepted elements that make up none."""
    found: dict[tuple[str, int], list[Element]] = {}
    for element in accepted:
        if len(element.orders) == 1 and element.in_place.is_identity:
            name, places = element.orders[0]
            found.setdefault((name, len(places)), []).append(element)
    whole, single = list[str](), list[str]()
    for (name, count), elements in sorted(found.items(), key=lambda one: (one[0][0] != "agents", one[0])):
        if _connect([element.orders[0][1] for element in elements], count):
            whole.append(name if name == "agents" else f"{name}-{count}")
        else:
            single += [element.name for element in elements]
    return whole, single


def _connect(orders: Sequence[tuple[int, ...]], count: int) -> bool:
    """Return whether the exchanges of two among some orders connect all things; then they generate every order."""
    moved = [{i for i, place in enumerate(order) if i != place} for order in orders]
    reached = {0}
    for _ in range(count):
        reached = reached.union(*(pair for pair in moved if len(pair) == 2 and pair & reached))
    return len(reached) == count


def _is_readable(text: str, accepted: Sequence[Element]) -> bool:
    """Return whether `--transforms` takes a text; it takes no list that holds a sampled group."""
    try:
        parse_elements(text, max((len(e.permutation or ()) for e in accepted), default=1))
    except ValueError:
        return False
    return True


def _plane(accepted: Sequence[Element], tried: Sequence[Element]) -> tuple[str, str]:
    """Return the name and the `--transforms` of the largest planar group whose tried elements are all accepted."""
    held, seen = set(accepted), set(tried)
    best, text, size = "c1", "", 0
    for name, elements in _subgroups():
        known = [e for e in elements if e in seen]
        if len(known) > size and held.issuperset(known) and generate(known, elements):
            best, text, size = name, name if "," not in name else ",".join(e.name for e in known), len(known)
    for name, of_any_angle, steps in (("o2", "rot57,flip23", "d16"), ("so2", "rot57", "c16")):
        if held.issuperset((*_listed(of_any_angle), *seen.intersection(_listed(steps)))):
            return name, name
    return best, text


def _subgroups() -> list[tuple[str, tuple[Element, ...]]]:
    """Return every subgroup of D16 with its elements but the identity, named where `parse_elements` has a name."""
    found: list[tuple[str, tuple[Element, ...]]] = []
    for fold in (1, 2, 4, 8, 16):
        turns = () if fold == 1 else _listed(f"c{fold}")
        if turns:
            found.append((f"c{fold}", turns))
        for shift in range(16 // fold):
            mirrors = _listed(",".join(f"flip{11.25 * (shift + 16 / fold * k):g}" for k in range(fold)))
            plain = shift == 0 and fold > 1
            name = f"d{fold}" if plain else ",".join(e.name for e in (*turns, *mirrors))
            found.append((name, (*turns, *mirrors)))
    return found


def _listed(text: str) -> tuple[Element, ...]:
    elements = parse_elements(text, 1)
    assert isinstance(elements, tuple)
    return elements


def default_candidates(spaces: Spaces, transforms: str | None = None) -> list[Element]:
    """Return the elements to try that actions and layouts can carry, whatever the task declares.

    By default turns and mirrors of a 16-gon, two that stand for all angles, and exchanges of two agents or of two like
    items of a field.
    """
    if transforms is not None:
        return candidates(spaces, transforms)
    texts = ["d16", "rot57", "flip23", *_exchanges("agents", spaces.num_agents)]
    for name, count in exchangeable(spaces).items():
        texts += _exchanges(name, count)
    return [element for text in texts for element in _carried(spaces, text)]


def _exchanges(name: str, count: int) -> list[str]:
    """Return the exchanges of two of some things that are tried."""
    texts = []
    for a, b in itertools.islice(itertools.combinations(range(count), 2), _EXCHANGES):
        order = list(range(count))
        order[a], order[b] = b, a
        texts.append(order_name(name, order))
    return texts


def _carried(spaces: Spaces, text: str) -> list[Element]:
    """Return those of some elements that can be carried."""
    try:
        return candidates(spaces, text)
    except ValueError:
        return []


def _concluded(
    source: str,
    method: str,
    elements: Sequence[Element],
    verdicts: Sequence[ElementVerdict],
    tolerance: float,
) -> Discovery:
    tried = judged_elements(verdicts, tolerance)
    kept = [element for element, one in zip(elements, tried, strict=True) if one.accepted]
    group, transforms = named(kept, elements)
    return Discovery(source, method, group, transforms, tried)


def judged_elements(verdicts: Sequence[ElementVerdict], tolerance: float) -> tuple[Tried, ...]:
    """Return what becomes of each element, if a field may be off by a tolerance."""
    p_values = [_p_value(verdict, tolerance) for verdict in verdicts]
    accepted = accepted_of(p_values) if p_values else []
    return tuple(_tried(verdict, p, holds) for verdict, p, holds in zip(verdicts, p_values, accepted, strict=True))


def _p_value(verdict: ElementVerdict, tolerance: float) -> float:
    """Return how likely gaps this small are, if some field is off by the tolerance; 1 where one is found broken."""
    if verdict.outcome != "holds":
        return 1.0
    worst = 0.0
    for field in verdict.fields:
        if field.outcome == "holds":
            if not math.isfinite(field.gap + field.error):
                return 1.0
            score = (tolerance - field.gap) / max(field.error, 1e-12)
            worst = max(worst, 0.5 * math.erfc(score / math.sqrt(2)))
    return worst


def _tried(verdict: ElementVerdict, p_value: float, accepted: bool) -> Tried:
    fields = [f for f in verdict.fields if f.outcome != "not covered"]
    if not fields:
        return Tried(verdict.element, accepted, p_value, math.nan, math.nan, verdict.reason or "not covered")
    worst = max(fields, key=lambda f: (RANK[f.outcome], f.gap))
    return Tried(verdict.element, accepted, p_value, worst.gap, worst.error, worst.field)
