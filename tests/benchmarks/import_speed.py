"""Seconds of processor time that a start costs, in alternating processes, compiled modules at hand.

The library: what `from esp_cli import Symmetry` takes beyond torch and numpy. The application: whole commands that
train nothing.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
from functools import partial

BASE = "import time, torch, numpy; begun = time.process_time();"
LINES = {"nothing more": "pass", "Symmetry": "from esp_cli import Symmetry, Field, Kind, layout, discrete_moves"}
COMMANDS = ("--help", "train --help", "ablate breaking --help", "tasks", "policies")
ROUNDS = 9


def imported(line: str) -> float:
    """Return the processor time of a line behind the imports of torch and numpy."""
    code = f"{BASE} {line}; print(time.process_time() - begun)"
    return float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)


def commanded(words: str) -> float:
    """Return the processor time of a process that runs one command of `esp`."""
    begun = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = "from esp_cli.app import main; main()"
    subprocess.run([sys.executable, "-c", code, *words.split()], capture_output=True, check=True)
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return ended.ru_utime - begun.ru_utime + ended.ru_stime - begun.ru_stime


def main() -> None:
    """Print the medians."""
    os.environ["PYTHONDONTWRITEBYTECODE"] = ""
    cases = {f"{name}, beyond torch and numpy": partial(imported, line) for name, line in LINES.items()}
    cases |= {f"esp {words}": partial(commanded, words) for words in COMMANDS}
    for measure in cases.values():
        measure()  # leaves what it imports compiled
    taken = [{name: measure() for name, measure in cases.items()} for _ in range(ROUNDS)]
    for name in cases:
        print(f"{name}: {statistics.median(one[name] for one in taken):.3f} s of processor time")


if __name__ == "__main__":
    main()
