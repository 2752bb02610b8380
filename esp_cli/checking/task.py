"""Check the symmetry of a task, or find what nobody declared, in the way that the task allows."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from esp_cli.checking import comparison, paired, recorded, transitions
from esp_cli.checking.candidates import candidates, named, refused, turns_freely
from esp_cli.checking.recorded import Transitions, collect
from esp_cli.checking.shifting import SHIFT, Shift
from esp_cli.checking.verdicts import ElementVerdict, Watch
from esp_cli.symmetry import Element
from esp_cli.symmetry.admission import scene_of
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.spec import Spaces
from esp_envs.views import RoleView

PAIRED, TRANSITIONS = "paired states", "transitions"
TOLERATED = {PAIRED: comparison.TOLERATED, TRANSITIONS: transitions.TOLERATED}
"""Standard deviations that a field may be off and yet hold, by method."""
_COPIES = 256  # most worlds of a task that takes no state
_EPISODES = 4096
_UNTRIED = "shifts are tried where a task can be set to a state"


@dataclass(frozen=True)
class SymmetryReport:
    """What a check found."""

    task: str  # its name, or the file of transitions
    method: str  # "paired states" or "transitions"
    declared: str
    found: str  # the largest group whose tried elements all hold: "d4*agents", "flip-x", "c1" for nothing
    transforms: str  # what `--transforms` takes to use it; empty where nothing was found
    elements: tuple[ElementVerdict, ...]
    refused: tuple[ElementVerdict, ...]  # that could not be tried, of those asked for, else of the declared ones

    @property
    def broken(self) -> tuple[str, ...]:
        """Declared elements that are broken."""
        return self._declared("broken")

    @property
    def uncovered(self) -> tuple[str, ...]:
        """Declared elements of which the data cannot tell."""
        return self._declared("not covered")

    @property
    def holds(self) -> bool:
        """Whether every declared element holds."""
        return not self.broken and not self.uncovered

    def _declared(self, outcome: str) -> tuple[str, ...]:
        return tuple(e.element for e in (*self.elements, *self.refused) if e.declared and e.outcome == outcome)


def check_symmetry(
    make: MakeWorlds,
    transforms: str | None = None,
    from_transitions: bool = False,
    watch: Watch = lambda *_: None,
    seconds: float = math.inf,
    spare: float = math.inf,
) -> SymmetryReport:
    """Judge for each element and field whether a task is symmetric.

    Elements are those of `--transforms`, or "shift"; by default those of `candidates`, and a shift where the task
    declares that it changes nothing. `watch` is told of how many steps of how many are collected, then of elements.
    After `seconds` the elements that are left are not covered; declared ones are tried first, and after `spare` seconds
    no others. No more than half of the time that is left goes to collecting.
    """
    until, spare = time.monotonic() + seconds, time.monotonic() + spare
    spec = make(1, [0]).spec
    if spec.roles:
        raise UserError(f"{spec.name} has roles; 'esp check symmetry' judges each role by itself")
    elements = [] if transforms == SHIFT else candidates(spec, transforms)
    shifts = [Shift(spec)] if transforms == SHIFT or (transforms is None and spec.shifts) else []
    method, verdicts = judged(make, [*elements, *shifts], from_transitions, watch, until, spare)
    return _reported(spec.name, method, spec, elements, verdicts, transforms)


def check_recorded(
    source: str,
    spaces: Spaces,
    data: Transitions,
    transforms: str | None = None,
    watch: Watch = lambda *_: None,
    seconds: float = math.inf,
) -> SymmetryReport:
    """Judge transitions of a policy that prefers no direction, from whatever source; see `check_symmetry`."""
    elements = candidates(spaces, transforms)
    verdicts = transitions.check_transitions(spaces, data, elements, watch, time.monotonic() + seconds)
    return _reported(source, TRANSITIONS, spaces, elements, verdicts, transforms)


def judged(
    make: MakeWorlds,
    elements: Sequence[Element | Shift],
    from_transitions: bool = False,
    watch: Watch = lambda *_: None,
    until: float = math.inf,
    spare: float = math.inf,
) -> tuple[str, list[ElementVerdict]]:
    """Return the method that a task allows, and what it says of elements until time is over; a shift comes last."""
    probe = make(1, [0])
    seen, native = probe.spec, probe.has("set_state")
    alone = (probe.inner.spec if isinstance(probe, RoleView) else seen).num_agents == 1
    if from_transitions or not probe.settable():
        worlds = make(min(_COPIES, max(recorded.FEWEST, 8192 // seen.horizon)), [0])
        data = collect(worlds, _EPISODES, until=(until + time.monotonic()) / 2, watch=watch)
        turns = [element for element in elements if isinstance(element, Element)]
        untried = [ElementVerdict(SHIFT, seen.shifts, (), _UNTRIED)] * (len(elements) - len(turns))
        return TRANSITIONS, [*transitions.check_transitions(seen, data, turns, watch, until, alone), *untried]

    def settable(num_envs: int, seeds: Sequence[int]) -> Environment:
        env = make(num_envs, seeds)
        env.settable()
        return env

    carried = [e for e in elements if probe.spec.joint_fields is not None or not transitions.is_unheld(e, probe.spec)]
    by_pairs = paired.check_paired(settable, carried, not native, watch, until, spare)
    verdicts = dict(zip(carried, by_pairs, strict=True))
    if rest := [element for element in elements if element not in verdicts]:  # items that the simulator does not name
        verdicts |= zip(rest, judged(make, rest, True, watch, min(until, spare))[1], strict=True)
    return PAIRED, [verdicts[element] for element in elements]


def _reported(
    source: str,
    method: str,
    spaces: Spaces,
    elements: Sequence[Element],
    verdicts: Sequence[ElementVerdict],
    transforms: str | None,
) -> SymmetryReport:
    holding = [e for e, verdict in zip(elements, verdicts, strict=False) if verdict.outcome == "holds"]
    scene = scene_of(spaces.symmetry, spaces.num_agents)
    found, usable = named(holding, elements, scene, turns_freely(spaces))
    left_out = () if transforms == SHIFT else refused(spaces, transforms)
    return SymmetryReport(source, method, spaces.symmetry, found, usable, tuple(verdicts), left_out)
