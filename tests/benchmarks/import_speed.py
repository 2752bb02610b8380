"""Seconds of processor time that a start costs, in alternating processes, compiled modules at hand.

    python tests/benchmarks/import_speed.py [--json import-speed.json]

The library: what `from esp_cli import Symmetry` takes beyond torch and numpy. The application: whole commands that
train nothing.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
from functools import partial
from pathlib import Path

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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="also write seconds of processor time by case to this file")
    file = parser.parse_args().json
    os.environ["PYTHONDONTWRITEBYTECODE"] = ""
    cases = {f"{name}, beyond torch and numpy": partial(imported, line) for name, line in LINES.items()}
    cases |= {f"esp {words}": partial(commanded, words) for words in COMMANDS}
    for measure in cases.values():
        measure()  # leaves what it imports compiled
    taken = [{name: measure() for name, measure in cases.items()} for _ in range(ROUNDS)]
    medians = {name: round(statistics.median(one[name] for one in taken), 3) for name in cases}
    for name, seconds in medians.items():
        print(f"{name}: {seconds:.3f} s of processor time")
    if file:
        file.write_text(json.dumps(medians, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
