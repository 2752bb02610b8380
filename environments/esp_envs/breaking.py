"""Which symmetry is left where a setting of a task breaks some of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Breaking:
    """One way in which a task's scene is not symmetric.

    Attributes:
        name: of the setting.
        size: its value; 0 breaks nothing.
        plane: the planar group that is left, or None where it breaks nothing of the plane.
        agents: whether the agents may still be exchanged.
    """

    name: str
    size: float
    plane: str | None
    agents: bool = True


def remaining(whole: str, breakings: Iterable[Breaking]) -> str:
    """Return the symmetry that several breakings leave together: "flip-x*agents", "c1" for none.

    Two breakings that leave different planar groups are taken to leave none of the plane.

    Args:
        whole: the symmetry without them, "d4*agents".
        breakings: those with size 0 do not count.
    """
    real = [one for one in breakings if one.size]
    planes = {one.plane for one in real if one.plane is not None}
    plane, *rest = whole.split("*")
    if planes:
        plane = planes.pop() if len(planes) == 1 else "c1"
    exchanged = all(one.agents for one in real)
    return "*".join((plane, *(factor for factor in rest if factor != "agents" or exchanged)))


def described(breakings: Iterable[Breaking]) -> str:
    """Return what a reward convention adds about them: ", wind 0.3"."""
    return "".join(f", {one.name} {one.size:g}" for one in breakings if one.size)
