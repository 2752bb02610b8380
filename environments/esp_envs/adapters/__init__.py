"""Foreign environments behind the one contract: PettingZoo, Gymnasium and VMAS.

Nothing here imports those packages before a task of theirs is made. A simulator of others says nothing about where it
stands, so a run that is resumed goes on with new episodes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from esp_envs.errors import UserError


def seed_of(base: int, *which: int) -> int:
    """Return a seed of its own for an episode, or for an episode of one world, of what has the seed `base`."""
    return int(np.random.SeedSequence([base, *which]).generate_state(1)[0] >> 1)


def require_attributes(task: object, *names: str) -> None:
    """Refuse a task whose class leaves out what its base class asks for, or whose metrics or totals are no names."""
    kind, metrics, totals = type(task).__name__, getattr(task, "metrics", ()), getattr(task, "totals", ())
    for what, given in (("metrics", metrics), ("totals", totals)):
        if isinstance(given, str):
            raise UserError(f"the {what} of {kind} are a text; give a tuple: ('{given}',)")
    if unknown := next((name for name in totals if name not in metrics), None):
        raise UserError(f"the totals of {kind} name '{unknown}', but its metrics are {', '.join(metrics) or 'none'}")
    missing = [name for name in names if getattr(task, name, None) is None]
    if missing:
        raise UserError(f"the class {kind} does not say its {', '.join(missing)}; set it in the class")


def require_roles(task: object, roles: Collection[str]) -> None:
    """Refuse masks and shared rewards that are given for roles which the task does not have."""
    for what in ("masks", "shared_reward"):
        given = getattr(task, what, False)
        for name in given if isinstance(given, Mapping) else ():
            if name not in roles:
                raise UserError(
                    f"{what} of {type(task).__name__} names '{name}', but its roles are {', '.join(roles) or 'none'}"
                )
