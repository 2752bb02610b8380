"""Measure how fast this working tree trains against an older commit, on this machine.

    python tests/benchmarks/against.py [--commit 0f974cc] [--rounds 5] [--cases NAME ...] [--set NAME=VALUE ...]
                                       [--json ratios.json]

The older commit is checked out beside the working tree, in a temporary folder. Each code runs in processes of its own.
A case of training is `esp train` of both, which take turns, an iteration each, so that a machine whose speed drifts is
the same for both; a round has some turns. Other cases run once a round with the old and once with the new code. The
figure of a case is the median over all turns of new / old; above 1 the working tree is faster. Ratios mean something on
an idle machine only.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[2]
WARM_UP, TURNS = 3, 8
"""Iterations at the start of a run that do not count, and those of a round."""
ESP = ("-c", "from esp_cli.app import main; main()")
IN_TURNS = """
import os, sys
from esp_cli.algorithms import mappo, off_policy
from esp_cli.app import main

ready = os.fdopen(os.dup(1), "w")
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)

def in_turns(iterate):
    def turn(*arguments):
        print("ready", file=ready, flush=True)
        if not sys.stdin.readline():
            os._exit(0)
        return iterate(*arguments)
    return turn

for learner in (mappo.Mappo, off_policy.OffPolicyLearner):
    learner.iterate = in_turns(learner.iterate)
main()
"""
"""`esp train` that waits for a line before each iteration."""
NO_EVALUATION = "--set evaluation.every_steps=1000000000 --set evaluation.episodes=1"


Rates = dict[str, list[float]]  # seed-steps per second of the "old" and the "new" code


@dataclass(frozen=True)
class Training:
    """`esp train`, iteration by iteration.

    Attributes:
        options: of the command line.
        seeds: trained at once.
        per_iteration: environment steps per seed of an iteration.
    """

    options: str
    seeds: int
    per_iteration: int

    def compare(self, trees: Mapping[str, Path], rounds: int, chosen: Sequence[str]) -> Rates:
        """Return the rates of all turns, with more options behind those of the case for the new code."""
        done = self.seeds * self.per_iteration
        rates: Rates = {side: [] for side in trees}
        for _ in range(rounds):  # with new processes, whose memory lies elsewhere
            with ExitStack() as stack:
                options = {"old": (), "new": chosen}
                runs = {side: stack.enter_context(self._started(trees[side], options[side])) for side in trees}
                for turn in range(-WARM_UP, TURNS):
                    for side in list(runs) if turn % 2 else reversed(runs):  # so that neither gains by its place
                        seconds = _take_turn(runs[side])
                        if turn >= 0:
                            rates[side].append(done / seconds)
        return rates

    @contextmanager
    def _started(self, tree: Path, chosen: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
        steps = self.per_iteration * (WARM_UP + TURNS + 1)  # so few that network.compiled=auto is off
        size = ("--seeds", str(self.seeds), "--steps", str(steps), "--out", "run")
        words = ("train", *self.options.split(), *NO_EVALUATION.split(), *size, *chosen)
        with tempfile.TemporaryDirectory() as folder:
            run = subprocess.Popen(
                [sys.executable, "-c", IN_TURNS, *words],
                cwd=folder,
                env=paths(tree),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            try:
                _await(run)
                yield run
            finally:
                run.kill()
                run.communicate()


def _take_turn(run: subprocess.Popen[str]) -> float:
    """Let a run do an iteration and return the seconds that it took."""
    begin = time.perf_counter()
    assert run.stdin is not None
    run.stdin.write("go\n")
    run.stdin.flush()
    _await(run)
    return time.perf_counter() - begin


def _await(run: subprocess.Popen[str]) -> None:
    assert run.stdout is not None
    if not run.stdout.readline():
        raise RuntimeError(f"esp train ends before its first turn, or fails: {run.communicate()[1].strip()}")


class _Alternating:
    """A case that is measured whole, once a round with each code."""

    def compare(self, trees: Mapping[str, Path], rounds: int, chosen: Sequence[str]) -> Rates:
        rates: Rates = {side: [] for side in trees}
        for _ in range(rounds):
            for side, tree in trees.items():
                with tempfile.TemporaryDirectory() as folder:
                    rates[side].append(self.measure(tree, Path(folder), chosen if side == "new" else ()))
        return rates

    def measure(self, tree: Path, folder: Path, chosen: Sequence[str]) -> float:
        """Return steps per second with the code of `tree`."""
        raise NotImplementedError


@dataclass(frozen=True)
class WholeTraining(_Alternating):
    """`esp train` from its start to its end, with start and evaluations."""

    options: str
    steps: int

    def measure(self, tree: Path, folder: Path, chosen: Sequence[str]) -> float:
        begin = time.perf_counter()
        python(tree, folder, *ESP, "train", *self.options.split(), "--steps", str(self.steps), "--out", "run", *chosen)
        return self.steps / (time.perf_counter() - begin)


@dataclass(frozen=True)
class Worlds(_Alternating):
    """The worlds of a task alone, measured by the tree's own env_speed.py."""

    task: str

    def measure(self, tree: Path, folder: Path, _: Sequence[str]) -> float:
        script = str(tree / "tests" / "benchmarks" / "env_speed.py")
        python(tree, folder, script, "--task", self.task, "--worlds", "1024", "--json", "speed.json")
        return float(json.loads((folder / "speed.json").read_text())["records"][0]["steps_per_second"])


Case = Training | WholeTraining | Worlds


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
        yield f"{name}, 10 seeds", Training(options, 10, per_iteration)
        yield f"{name}, 1 seed", Training(options, 1, per_iteration)
    for name in ("maddpg", "qmix", "qmix gru"):
        algorithm, _, network = name.partition(" ")
        options = f"--algo {algorithm} --network {network or 'mlp'}"
        yield f"{name}, plain, 10 seeds", Training(f"{options} --prior none", 10, 200)
        yield f"{name}, esp, 10 seeds", Training(options, 10, 200)
    yield "formation, esp train end to end, 1 seed", WholeTraining("--task formation", 48_000)
    for task in ("navigation", "predator-prey", "wildlife"):
        yield f"{task} worlds", Worlds(task)


CASES: dict[str, Case] = dict(_cases())


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
    parser.add_argument("--commit", default="0f974cc", help="what to compare with")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cases", nargs="+", default=["*"], metavar="PATTERN", help="names, or patterns as 'qmix*'")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings of the working tree alone")
    parser.add_argument("--json", type=Path, help="also write every rate to this file")
    args = parser.parse_args()
    names = [name for name in CASES if any(fnmatch(name, pattern) for pattern in args.cases)]
    if not names:
        parser.error(f"no case has such a name; the cases are: {'; '.join(CASES)}")
    rates: dict[str, Rates] = {}
    ratios: dict[str, float] = {}
    with checked_out(args.commit) as old:
        trees, chosen = {"old": old, "new": ROOT}, [word for pair in args.set for word in ("--set", pair)]
        for tree in trees.values():
            use(tree)
        for name in names:
            rates[name] = found = CASES[name].compare(trees, args.rounds, chosen)
            ratios[name] = statistics.median(new / old for old, new in zip(found["old"], found["new"], strict=True))
            print(f"{name}: {ratios[name]:.2f}", file=sys.stderr, flush=True)
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
