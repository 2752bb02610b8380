"""Measure how long training takes from nothing until it solves a task, evaluations included.

    python tests/benchmarks/seconds_to_solve.py [--preset fast] [--runs 5] [--cases PATTERN ...] [--set NAME=VALUE ...]
                                                [--threads 2] [--commit 0f974cc] [--json solved.json]

Each run is an `esp train` with seeds of its own, whose schedules are those of 1M steps. Its steps are those of the
first evaluation whose mean greedy return over all seeds reaches the case's threshold; its seconds begin with the
process and end when this evaluation stands in metrics.jsonl. The table has the median over the runs and, in brackets,
the least and the most. Seconds mean something on an idle machine only.
"""

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[2]))
from tests.benchmarks.against import ESP, ROOT, checked_out, paths


@dataclass(frozen=True)
class Case:
    """What is to be solved.

    Attributes:
        options: of `esp train`.
        seeds: trained at once.
        threshold: mean greedy return over all seeds.
        every: environment steps per seed between evaluations.
        episodes: of an evaluation, all seeds together.
        steps: environment steps per seed of the whole run, which schedules know.
    """

    options: str
    seeds: int
    threshold: float
    every: int = 20_000
    episodes: int = 320
    steps: int = 1_000_000

    def words(self, run: int, chosen: Sequence[str] = ()) -> list[str]:
        """Return the words behind `esp train` of one run, numbered from 0, with options of the caller behind them."""
        seeds = ",".join(str(run * self.seeds + k) for k in range(self.seeds))
        evaluation = {"every_steps": self.every, "episodes": self.episodes // self.seeds}
        words = [*self.options.split(), "--seed-list", seeds, "--steps", str(self.steps)]
        words += [word for name, value in evaluation.items() for word in ("--set", f"evaluation.{name}={value}")]
        return [*words, *chosen]


NAVIGATION = -115.0
CASES = {
    "navigation, mappo, 1 seed": Case("--task navigation", 1, NAVIGATION),
    "navigation, mappo, 10 seeds": Case("--task navigation", 10, NAVIGATION),
    "navigation, maddpg, 1 seed": Case("--task navigation --algo maddpg", 1, NAVIGATION),
    "navigation, qmix, 1 seed": Case("--task navigation --algo qmix", 1, NAVIGATION),
    "predator-prey, mappo, 1 seed": Case("--task predator-prey", 1, 85.0, every=10_000),
    # an episode has 300 steps of physics: 320 of them would take longer than the training between two evaluations
    "formation, tight, mappo, 1 seed": Case(
        "--task formation --set task.convention=tight", 1, 218.0, every=24_000, episodes=32
    ),
}


@dataclass(frozen=True)
class Solved:
    """The first evaluation of a run that reached the threshold; infinite where none did."""

    steps: float
    seconds: float


def run(case: Case, words: Sequence[str], tree: Path) -> Solved:
    """Train with the code of `tree` until the threshold is reached, or to the end.

    Raises:
        RuntimeError: `esp train` fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        metrics, seen = Path(folder) / "run" / "metrics.jsonl", 0
        command = [sys.executable, *ESP, "train", *words, "--out", "run"]
        begin = time.perf_counter()
        with (
            (Path(folder) / "said").open("w+", encoding="utf-8") as said,
            subprocess.Popen(command, cwd=folder, env=paths(tree), stdout=said, stderr=said) as process,
        ):
            ended = False
            while not ended:
                ended = process.poll() is not None  # asked before the rows are read: the last ones count too
                text = metrics.read_bytes()[seen:].rpartition(b"\n")[0] if metrics.exists() else b""
                seen += len(text) + bool(text)
                step = reached(text.decode().splitlines(), case.threshold)
                if step is not None:
                    seconds = time.perf_counter() - begin
                    process.terminate()
                    return Solved(step, seconds)
                time.sleep(0.05)
            if process.returncode:
                said.seek(0)
                raise RuntimeError(f"esp train {' '.join(words)} fails: {said.read().strip()}")
        return Solved(math.inf, math.inf)


def reached(lines: Sequence[str], threshold: float) -> int | None:
    """Return the step of the first evaluation whose mean greedy return is at least `threshold`; None without one."""
    for row in map(json.loads, lines):
        returns = row.get("eval/return_greedy")
        if returns and None not in returns and statistics.fmean(returns) >= threshold:
            return int(row["step"])
    return None


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="change a setting too")
    parser.add_argument("--cases", nargs="+", default=["*"], metavar="PATTERN", help="names, or patterns as '*qmix*'")
    parser.add_argument("--runs", type=int, default=5, help="of each case")
    parser.add_argument("--threads", type=int, help="processor threads; all cores where it is not said")
    parser.add_argument("--commit", help="train with the code of an older commit")
    parser.add_argument("--json", type=Path, help="also write every run to this file")
    args = parser.parse_args()
    names = [name for name in CASES if any(fnmatch(name, pattern) for pattern in args.cases)]
    if not names:
        parser.error(f"no case has such a name; the cases are: {'; '.join(CASES)}")
    if args.threads:
        os.environ["OMP_NUM_THREADS"] = str(args.threads)
    chosen = ["--preset", args.preset, *(word for setting in args.set for word in ("--set", setting))]
    table = Table("case", "return", "steps", "seconds", title=" ".join(chosen))
    records = []
    with checked_out(args.commit) if args.commit else nullcontext(ROOT) as tree:
        for name in names:
            case, done = CASES[name], list[Solved]()
            for number in range(args.runs):
                done.append(run(case, case.words(number, chosen), tree))
                told = f"{name}: {done[-1].steps:,.0f} steps, {done[-1].seconds:.1f} s"
                print(told, file=sys.stderr, flush=True)
            steps, seconds = ([getattr(solved, field) for solved in done] for field in ("steps", "seconds"))
            table.add_row(name, f"{case.threshold:g}", spread(steps, ",.0f"), spread(seconds, ".1f"))
            numbers = {"steps": list(map(finite, steps)), "seconds": list(map(finite, seconds))}
            records.append({"case": name, "threshold": case.threshold, **numbers})
    Console(width=110).print(table)
    if args.json:
        document = {"preset": args.preset, "settings": args.set, "commit": args.commit, "records": records}
        args.json.write_text(json.dumps(document, indent=2) + "\n")


def spread(values: Sequence[float], form: str) -> str:
    """Return the median and, in brackets, the least and the most."""
    middle, least, most = statistics.median(values), min(values), max(values)
    return f"{middle:{form}} ({least:{form}} to {most:{form}})"


def finite(value: float) -> float | None:
    """Return a number, or None where it is infinite, which JSON does not have."""
    return value if math.isfinite(value) else None


if __name__ == "__main__":
    main()
