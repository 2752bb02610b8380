"""Check the symmetry of a task, in the way that it allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from esp_cli.checking.candidates import candidates, found_group, refused
from esp_cli.checking.paired import check_paired
from esp_cli.checking.recorded import collect
from esp_cli.checking.transitions import check_transitions
from esp_cli.checking.verdicts import ElementVerdict
from esp_envs.conformance.subject import MakeWorlds

_COPIES = 256
"""Worlds of a task that cannot be set to a state."""


@dataclass(frozen=True)
class SymmetryReport:
    """What a check found.

    Attributes:
        task: its name.
        method: "paired states" or "transitions".
        declared: the symmetry that the task declares.
        found: the largest group whose tried elements all hold.
        elements: one verdict for each element that was tried.
        refused: why elements that were asked for could not be tried, by their names.
    """

    task: str
    method: str
    declared: str
    found: str
    elements: tuple[ElementVerdict, ...]
    refused: Mapping[str, str]

    @property
    def holds(self) -> bool:
        """Whether no declared element is broken."""
        return not any(element.declared and element.outcome == "broken" for element in self.elements)


def check_symmetry(make: MakeWorlds, transforms: str | None = None) -> SymmetryReport:
    """Judge for each element and field whether a task is symmetric.

    Args:
        make: makes E worlds for some seeds.
        transforms: which elements, as `--transforms` takes them; by default those of `candidates`.

    Raises:
        UserError: the transforms mean nothing, or the task can carry none of them.
    """
    probe = make(1, [0])
    spec = probe.spec
    elements = candidates(spec, transforms)
    if probe.has("set_state"):
        method, verdicts = "paired states", check_paired(make, elements)
    else:
        worlds = min(_COPIES, max(32, 8192 // spec.horizon))
        method, verdicts = "transitions", check_transitions(spec, collect(make(worlds, [0])), elements)
    found, left_out = found_group(verdicts, spec), {} if transforms is None else refused(spec, transforms)
    return SymmetryReport(spec.name, method, spec.symmetry, found, tuple(verdicts), left_out)
