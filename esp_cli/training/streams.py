"""Independent random streams from one seed number.

Worlds, learning, the prior and evaluation each draw from a stream of their own, so that switching one on or off
leaves the others' draws as they were: a run with a prior meets the same worlds as the run without.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch


def stream_seed(seed: int, *names: object) -> int:
    """Return a 63-bit seed that depends on the run seed and the stream's names alone."""
    text = "/".join(str(part) for part in (seed, *names))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1


def stream_seeds(seeds: Sequence[int], *names: object) -> list[int]:
    """Return the stream's seed for each run seed."""
    return [stream_seed(seed, *names) for seed in seeds]


def generators(seeds: Sequence[int], *names: object) -> list[torch.Generator]:
    """Return one CPU generator per run seed for the named stream."""
    return [torch.Generator().manual_seed(seed) for seed in stream_seeds(seeds, *names)]
