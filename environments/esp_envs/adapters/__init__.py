"""Foreign environments behind the one contract: PettingZoo, Gymnasium and VMAS.

Nothing here imports those packages before a task of theirs is made.
"""

from __future__ import annotations

import numpy as np


def seed_of(base: int, episode: int) -> int:
    """Return the seed of an episode of a world whose own seed is `base`."""
    return int(np.random.SeedSequence([base, episode]).generate_state(1)[0] >> 1)
