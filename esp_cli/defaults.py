"""What is asked for where nobody says, and the most that can be asked for; imports nothing."""

from __future__ import annotations

STEPS = 1_000_000
"""Environment steps per seed of a run."""
EPISODES = 320
"""Of an evaluation, per seed."""
STUDY_SEEDS = tuple(range(10))
"""Of a study: as many as the paper has."""
SLOWEST = 0.01
"""Speed of a film, times real time, at least."""
MAX_STEPS = 10**12
"""Steps that one run may take; the fastest machine needs years for them."""
MAX_SEEDS = 1000
"""Most seeds of one run; more is a typing error."""
