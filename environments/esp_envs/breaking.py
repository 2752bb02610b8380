"""Settings that break some of a task's symmetry: declared where the setting is, and what they leave together."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Breaks:
    """What a setting leaves of a task's symmetry while it is not 0; it annotates the setting.

    Attributes:
        plane: the planar group that is left, the name of the settings' attribute that says it, or None where nothing of
            the plane is broken.
        agents: whether the agents may still be exchanged.

    Example:
        class WindySettings(TaskSettings):
            wind: Annotated[float, Breaks("flip-x")] = 0.0
    """

    plane: str | None
    agents: bool = True


def remaining(whole: str, broken: Iterable[Breaks]) -> str:
    """Return the symmetry that is left where several things break it: "flip-x*agents", "c1" for none.

    Two that leave different planar groups are taken to leave none of the plane.

    Args:
        whole: the symmetry without them, "d4*agents".
        broken: each with the name of the planar group that it leaves.
    """
    real = list(broken)
    planes = {one.plane for one in real if one.plane is not None}
    plane, *rest = whole.split("*")
    if planes:
        plane = planes.pop() if len(planes) == 1 else "c1"
    exchanged = all(one.agents for one in real)
    return "*".join((plane, *(factor for factor in rest if factor != "agents" or exchanged)))
