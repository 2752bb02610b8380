"""Foreign environments behind the one contract: PettingZoo, Gymnasium and VMAS.

Nothing here imports those packages before a task of theirs is made. A simulator of others says nothing about where it
stands, so a run that is resumed goes on with new episodes.
"""

from __future__ import annotations

import numpy as np

from esp_envs.errors import UserError


def seed_of(base: int, *which: int) -> int:
    """Return a seed of its own for an episode, or for an episode of one world, of what has the seed `base`."""
    return int(np.random.SeedSequence([base, *which]).generate_state(1)[0] >> 1)


def require_attributes(task: object, *names: str) -> None:
    """Refuse a task whose class leaves out what its base class asks for, or whose metrics are one text."""
    if isinstance(metrics := getattr(task, "metrics", ()), str):
        raise UserError(f"the metrics of {type(task).__name__} are a text; give a tuple: ('{metrics}',)")
    missing = [name for name in names if getattr(task, name, None) is None]
    if missing:
        raise UserError(f"the class {type(task).__name__} does not say its {', '.join(missing)}; set it in the class")
