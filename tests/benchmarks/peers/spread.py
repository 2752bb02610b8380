"""The file that both comparisons on simple_spread write, and runs of esp beside them. Needs no package.

    OMP_NUM_THREADS=1 esp train --task navigation --set task.convention=pettingzoo --steps 300k --seed-list 0 \
        --out runs/spread-0
    python tests/benchmarks/peers/spread.py --json spread.json --beside MAPPO-ESP=runs/spread-0

The file holds for each run rows of frames, seconds since the start and the mean return of the training episodes: the
sum of rewards over an episode, as the mean over agents. Prints the mean over the last 6000 frames of each run, which
are one row of BenchMARL, then its mean ± standard error over seeds and the median seconds.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from statistics import mean, median, stdev

Row = tuple[int, float, float]


def add_missing(file: Path, wanted: Mapping[str, Callable[[], list[Row]]]) -> None:
    """Run what the file doesn't have yet, and write it after each run."""
    found: dict[str, list[Row]] = json.loads(file.read_text()) if file.exists() else {}
    for name, rows in wanted.items():
        if name not in found:
            found[name] = [(frames, round(seconds, 2), round(returns, 3)) for frames, seconds, returns in rows()]
            file.write_text(json.dumps(found) + "\n")


def summarise(file: Path) -> None:
    """Print how each run ends, then the mean over seeds."""
    ends = defaultdict[str, list[tuple[float, float]]](list)
    for name, rows in json.loads(file.read_text()).items():
        frames, seconds, _ = rows[-1]
        last = mean(row[2] for row in rows if row[0] > frames - 6000)
        ends[name.rsplit(", seed ", 1)[0]].append((last, seconds))
        print(f"{name}: {last:.2f} after {frames} frames and {seconds:.1f} s; first row after {rows[0][1]:.1f} s")
    for name, runs in ends.items():
        returns, seconds = zip(*runs, strict=True)
        error = f" ± {stdev(returns) / len(runs) ** 0.5:.2f}" if len(runs) > 1 else ""
        print(f"{name}: {mean(returns):.2f}{error}, {median(seconds):.1f} s (seeds: {len(runs)})")


def seed_of_esp(folder: Path) -> int:
    """Return the seed of a run folder; it must be one, so that its seconds are those of one run."""
    seeds = json.loads((folder / "config.json").read_text())["seeds"]
    if len(seeds) > 1:
        raise ValueError(f"{folder} has {len(seeds)} seeds; train each alone: --seed-list 0")
    return seeds[0]


def run_of_esp(folder: Path) -> list[Row]:
    """Return the rows of a run folder of one seed."""
    found = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    rows = [(row["step"], row["time/elapsed_s"], row["train/return"][0]) for row in found if "train/return" in row]
    return [row for row in rows if row[2] is not None]


def main() -> None:
    """Add the given run folders to the file, and print how each run ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--beside", nargs="+", default=[], metavar="LABEL=RUN")
    parser.add_argument("--json", type=Path, default=Path("spread.json"))
    given = parser.parse_args()
    runs = [(label, Path(folder)) for label, folder in (pair.split("=", 1) for pair in given.beside)]
    add_missing(given.json, {f"{label}, seed {seed_of_esp(run)}": partial(run_of_esp, run) for label, run in runs})
    summarise(given.json)


if __name__ == "__main__":
    main()
