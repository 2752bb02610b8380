"""What can be asked for, and what is asked for where nobody says; imports nothing of this package."""

from __future__ import annotations

from typing import Literal

__version__ = "0.1.0"

PriorKind = Literal["esp", "none", "augment", "consistency"]
"""What a prior consists of, in the order in which a task's bundled policies are preferred."""
Mode = Literal["greedy", "stochastic"]  # how a policy acts: by its most probable action, or by actions that it draws
STEPS = 1_000_000  # environment steps per seed of a run
EPISODES = 320  # of an evaluation, per seed
STUDY_SEEDS = tuple(range(10))  # as many as the paper has
SLOWEST = 0.01  # speed of a film, times real time, at least
MAX_STEPS = 10**12  # of one run; the fastest machine needs years for them
MAX_SEED = 999_999_999  # on a command line
MAX_SEEDS = 1000  # of one run; more is a typing error
