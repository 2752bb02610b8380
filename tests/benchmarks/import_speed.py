"""Seconds that `from esp_cli import Symmetry` takes beyond torch and numpy, in alternating processes."""

from __future__ import annotations

import statistics
import subprocess
import sys

BASE = "import time, torch, numpy; begun = time.process_time();"
LINES = {"nothing more": "pass", "Symmetry": "from esp_cli import Symmetry, Field, Kind, layout, discrete_moves"}
ROUNDS = 5


def main() -> None:
    """Print the medians."""
    taken: dict[str, list[float]] = {name: [] for name in LINES}
    for _ in range(ROUNDS):
        for name, line in LINES.items():
            code = f"{BASE} {line}; print(time.process_time() - begun)"
            done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
            taken[name].append(float(done.stdout))
    for name, seconds in taken.items():
        print(f"{name}: {statistics.median(seconds):.3f} s of CPU beyond torch and numpy")


if __name__ == "__main__":
    main()
