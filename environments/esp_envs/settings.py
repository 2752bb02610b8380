"""What a user may change of a task, and which settings break some of its symmetry."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pydantic import BaseModel, ConfigDict


@dataclass(frozen=True)
class Breaks:
    """What a setting leaves of a symmetry while it is not 0, as `wind: Annotated[float, Breaks("flip-x")] = 0.0`."""

    plane: str | None  # the planar group that is left, or the attribute that says it; None: all of it


class TaskSettings(BaseModel):
    """What a user may change of a task; each field has its default, unit and bounds here and nowhere else."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def without_effect(self) -> frozenset[str]:
        """Return the names of settings that change nothing beside the others."""
        return frozenset()

    @classmethod
    def breakable(cls) -> dict[str, Breaks]:
        """Return what each setting that breaks a symmetry leaves of it, by the setting's name."""
        return {
            name: mark
            for name, field in cls.model_fields.items()
            for mark in field.metadata
            if isinstance(mark, Breaks)
        }

    def broken(self) -> dict[str, Breaks]:
        """Return what those leave that are not 0 and have an effect, each with the name of a planar group."""
        idle = self.without_effect()
        marks = {name: mark for name, mark in self.breakable().items() if getattr(self, name) and name not in idle}
        return {name: replace(mark, plane=getattr(self, f"{mark.plane}", mark.plane)) for name, mark in marks.items()}

    def left_of(self, whole: str) -> str:
        """Return what the settings leave of a symmetry: "flip-x*agents", "c1" for none."""
        broken = self.broken().values()
        planes = {one.plane for one in broken if one.plane is not None}
        plane, *rest = whole.split("*")
        if planes:
            plane = planes.pop() if len(planes) == 1 else "c1"
        return "*".join((plane, *rest))

    def broken_in_words(self) -> str:
        """Return what a reward convention adds about the settings that break a symmetry: ", wind 0.3"."""
        return "".join(f", {name} {getattr(self, name):g}" for name in self.broken())
