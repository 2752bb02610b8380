"""What this process may use of the machine; imports no torch."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
