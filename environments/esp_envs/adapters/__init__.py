"""Foreign environments behind the one contract: PettingZoo, Gymnasium and VMAS.

Nothing here imports those packages before a task of theirs is made. A simulator of others says nothing about where it
stands, so a run that is resumed goes on with new episodes.
"""

from __future__ import annotations

import numpy as np


def seed_of(base: int, *which: int) -> int:
    """Return a seed of its own for an episode, or for an episode of one world, of what has the seed `base`."""
    return int(np.random.SeedSequence([base, *which]).generate_state(1)[0] >> 1)
