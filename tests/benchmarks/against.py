"""Measure how fast this working tree trains against an older commit, on this machine.

    python tests/benchmarks/against.py [--commit 1b792e9] [--rounds 5] [--cases NAME ...] [--set NAME=VALUE ...]
                                       [--json ratios.json]

The older commit is checked out beside the working tree, in a temporary folder. Each round runs every case once with the
old and once with the new code, each in a process of its own. A case of training is `esp train`; its rate is the median
over its iterations, taken from the times in metrics.jsonl. The figure of a case is the median over the rounds of
new / old; above 1 the working tree is faster. Ratios mean something on an idle machine only.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import pairwise
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[2]
WARM_UP = 2
"""Iterations at the start of a run that do not count."""
ESP = ("-c", "from esp_cli.app import main; main()")
NO_EVALUATION = "--set evaluation.every_steps=1000000000 --set evaluation.episodes=1"


@dataclass(frozen=True)
class Training:
    """A run of `esp train`.

    Attributes:
        options: of the command line.
        seeds: trained at once.
        steps: environment steps per seed.
        end_to_end: divide by the time of the whole process, evaluation and start included.
    """

    options: str
    seeds: int
    steps: int
    end_to_end: bool = False

    def measure(self, tree: Path, folder: Path, chosen: Sequence[str]) -> float:
        """Return seed-steps per second with the code of `tree`, with more options behind those of the case."""
        options = self.options if self.end_to_end else f"{self.options} {NO_EVALUATION}"
        begin = time.perf_counter()
        size = ("--seeds", str(self.seeds), "--steps", str(self.steps), "--out", "run", *chosen)
        python(tree, folder, *ESP, "train", *options.split(), *size)
        seconds = time.perf_counter() - begin
        if self.end_to_end:
            return self.seeds * self.steps / seconds
        rows = map(json.loads, (folder / "run" / "metrics.jsonl").read_text().splitlines())
        return self.seeds * steps_per_second(rows)


@dataclass(frozen=True)
class Worlds:
    """The worlds of a task alone, measured by the tree's own env_speed.py."""

    task: str

    def measure(self, tree: Path, folder: Path, _: Sequence[str]) -> float:
        """Return environment steps per second with the code of `tree`."""
        script = str(tree / "tests" / "benchmarks" / "env_speed.py")
        python(tree, folder, script, "--task", self.task, "--worlds", "1024", "--json", "speed.json")
        return float(json.loads((folder / "speed.json").read_text())["records"][0]["steps_per_second"])


Case = Training | Worlds


def _cases() -> Iterator[tuple[str, Case]]:
    perceptron = "--network mlp"  # the default of navigation before there were networks over sets
    peers = (
        f"{perceptron} --prior none --set mappo.num_envs=128 --set mappo.num_minibatches=1 --set mappo.num_epochs=10"
        " --set network.activation=relu"
    )
    bfloat16 = "--set network.precision=bfloat16"
    mappo = {
        "mappo 128 x 25, 10 x 1, plain": (peers, 3200),
        "mappo 128 x 25, 10 x 1, plain, bfloat16": (f"{peers} {bfloat16}", 3200),
        "mappo default, plain": (f"{perceptron} --prior none", 800),
        "mappo default, esp": (perceptron, 800),
        "mappo default, esp, bfloat16": (f"{perceptron} {bfloat16}", 800),
    }
    for name, (options, per_iteration) in mappo.items():
        yield f"{name}, 10 seeds", Training(options, 10, 12 * per_iteration)
        yield f"{name}, 1 seed", Training(options, 1, 25 * per_iteration)
    for name in ("maddpg", "qmix", "qmix gru"):
        algorithm, _, network = name.partition(" ")
        options = f"--algo {algorithm} --network {network or 'mlp'}"
        yield f"{name}, plain, 10 seeds", Training(f"{options} --prior none", 10, 12 * 200)
        yield f"{name}, esp, 10 seeds", Training(options, 10, 12 * 200)
    yield "formation, esp train end to end, 1 seed", Training("--task formation", 1, 48_000, end_to_end=True)
    for task in ("navigation", "predator-prey", "wildlife"):
        yield f"{task} worlds", Worlds(task)


CASES: dict[str, Case] = dict(_cases())


def steps_per_second(rows: Iterable[Mapping[str, Any]]) -> float:
    """Return the median rate of the iterations behind the warm-up, less the last one, which evaluates.

    Args:
        rows: of metrics.jsonl.

    Raises:
        ValueError: the run has too few iterations.
    """
    marks = [(row["step"], row["time/elapsed_s"]) for row in rows if "time/elapsed_s" in row][WARM_UP - 1 : -1]
    if len(marks) < 2:
        raise ValueError(
            f"the run is too short to measure: it needs more than {WARM_UP + 1} iterations; raise its steps"
        )
    return statistics.median((b - a) / (t - s) for (a, s), (b, t) in pairwise(marks))


def paths(tree: Path) -> dict[str, str]:
    """Return an environment in which Python finds the code of `tree`, and keeps what it compiles as it usually does."""
    return os.environ | {"PYTHONPATH": f"{tree}{os.pathsep}{tree / 'environments'}", "PYTHONDONTWRITEBYTECODE": ""}


def python(tree: Path, folder: Path, *arguments: str) -> str:
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=paths(tree), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)} fails in {tree}: {done.stderr.strip()}")
    return done.stdout


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary folder, for as long as the context lasts."""
    git = ("git", "-C", str(ROOT), "worktree")
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "old"
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def measure(case: Case, tree: Path, chosen: Sequence[str] = ()) -> float:
    with tempfile.TemporaryDirectory() as folder:
        return case.measure(tree, Path(folder), chosen)


def use(tree: Path) -> None:
    """Check that Python finds the code of `tree`, and leave it compiled.

    Raises:
        RuntimeError: it finds other code.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = python(tree, Path(folder), "-c", "import esp_cli, esp_envs; print(esp_cli.__file__, esp_envs.__file__)")
        if any(not Path(file).is_relative_to(tree) for file in found.split()):
            raise RuntimeError(f"Python finds {found.strip()} instead of the code in {tree}")
        python(tree, Path(folder), *ESP, "train", "--steps", "1", "--out", "run")


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commit", default="1b792e9", help="what to compare with")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cases", nargs="+", default=["*"], metavar="PATTERN", help="names, or patterns as 'qmix*'")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings of the working tree alone")
    parser.add_argument("--json", type=Path, help="also write every rate to this file")
    args = parser.parse_args()
    names = [name for name in CASES if any(fnmatch(name, pattern) for pattern in args.cases)]
    if not names:
        parser.error(f"no case has such a name; the cases are: {'; '.join(CASES)}")
    rates: dict[str, dict[str, list[float]]] = {name: {"old": [], "new": []} for name in names}
    with checked_out(args.commit) as old:
        trees, chosen = {"old": old, "new": ROOT}, [word for pair in args.set for word in ("--set", pair)]
        for tree in trees.values():
            use(tree)
        for turn in range(args.rounds):
            for name in names:
                for side, tree in trees.items():
                    rates[name][side].append(measure(CASES[name], tree, chosen if side == "new" else ()))
                last = rates[name]["new"][-1] / rates[name]["old"][-1]
                print(f"round {turn + 1} of {args.rounds}: {name}: {last:.2f}", file=sys.stderr, flush=True)
    ratios = {
        name: statistics.median(new / old for old, new in zip(r["old"], r["new"], strict=True))
        for name, r in rates.items()
    }
    table = Table("case", "old, steps/s", "new, steps/s", "faster by", title=f"the working tree against {args.commit}")
    for name, by_side in rates.items():
        old_rate, new_rate = (f"{statistics.median(values):,.0f}" for values in by_side.values())
        table.add_row(name, old_rate, new_rate, f"{ratios[name]:.2f}")
    Console(width=100).print(table)
    if args.json:
        records = [{"case": name, "ratio": ratios[name], **rates[name]} for name in names]
        args.json.write_text(json.dumps({"commit": args.commit, "set": args.set, "records": records}, indent=2) + "\n")


if __name__ == "__main__":
    main()
