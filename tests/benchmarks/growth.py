"""Measure whether a command grows in memory or in open files the longer it runs.

    python tests/benchmarks/growth.py [--minutes 60] [--every 10] [--warmup 10] [--json growth.json] [-- COMMAND ...]

The default command trains MAPPO with the prior on navigation, with checkpoints, evaluations and metrics as users have
them. Memory and descriptors are those of the command and all its children, as /proc counts them (Linux alone). The
growth of memory is the median of all slopes between two samples after the warm-up (Theil and Sen), so that peaks do not
count. The growth of files is the difference between the medians of the last and the first third of these samples.
The command gets SIGTERM at the end. The exit code is 1 if a growth is above its bound.
"""

import argparse
import contextlib
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from scipy.stats import theilslopes

BOUND_MB_PER_HOUR = 8.0
"""A leak of one row of metrics per evaluation is above it; what the allocator moves around in an hour is below."""
PATIENCE_S = 120.0


@dataclass(frozen=True)
class Sample:
    """What a command held at a moment: resident and anonymous memory in MB (2^20 bytes), files, threads, processes."""

    minute: float
    rss_mb: float
    anonymous_mb: float
    files: int
    threads: int
    processes: int


@dataclass(frozen=True)
class Growth:
    """How a command grew after the warm-up, and how it ended."""

    rss_mb_per_hour: float
    anonymous_mb_per_hour: float
    files: float
    exit_code: int

    def exceeds(self, bound: float) -> bool:
        """Return whether memory grew by more than `bound` MB an hour, or files by one."""
        return max(self.rss_mb_per_hour, self.anonymous_mb_per_hour) > bound or self.files >= 1


def family(pid: int) -> Iterator[int]:
    """Yield a process and all its descendants; those that end meanwhile may be missing."""
    yield pid
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for children in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in children.read_text().split():
                yield from family(int(child))


def take(pid: int, minute: float) -> Sample | None:
    """Return what a process and its descendants hold; None if one of them ended meanwhile."""
    total = {"VmRSS": 0, "RssAnon": 0, "Threads": 0}
    files = processes = 0
    try:
        for member in family(pid):
            status = Path(f"/proc/{member}/status").read_text().splitlines()
            lines = dict(line.split(":", 1) for line in status if ":" in line)
            for name in total:
                total[name] += int(lines[name].split()[0])
            files += len(list(Path(f"/proc/{member}/fd").iterdir()))
            processes += 1
    except (FileNotFoundError, ProcessLookupError, KeyError):
        return None
    return Sample(minute, total["VmRSS"] / 1024, total["RssAnon"] / 1024, files, total["Threads"], processes)


def watch(command: Sequence[str], minutes: float, every_s: float, log: Path) -> tuple[list[Sample], int]:
    """Run a command for some minutes; return a sample every few seconds, and its exit code.

    Raises:
        ValueError: the command failed before the time was over.
    """
    samples: list[Sample] = []
    begun = time.monotonic()
    with (
        log.open("wb") as output,
        subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True) as child,
    ):
        try:
            while child.poll() is None and time.monotonic() - begun < 60 * minutes:
                time.sleep(every_s)
                sample = take(child.pid, (time.monotonic() - begun) / 60)
                if sample is not None:
                    samples.append(sample)
            early = child.poll()
            if early is None:
                child.send_signal(signal.SIGTERM)
            code = child.wait(PATIENCE_S)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # what the command left behind too
    if early:
        raise ValueError(f"the command ended with exit code {early} after {len(samples)} samples; see {log}")
    return samples, code


def fit(samples: Sequence[Sample], warmup_min: float, exit_code: int) -> Growth:
    """Return the growth after the warm-up.

    Raises:
        ValueError: too few samples are left.
    """
    late = [sample for sample in samples if sample.minute >= warmup_min]
    if len(late) < 6:
        raise ValueError(f"{len(late)} samples after a warm-up of {warmup_min:g} min are too few; give more --minutes")
    hours = [sample.minute / 60 for sample in late]
    rss, anonymous = (
        float(theilslopes([getattr(sample, name) for sample in late], hours).slope)
        for name in ("rss_mb", "anonymous_mb")
    )
    third = len(late) // 3
    files = statistics.median(s.files for s in late[-third:]) - statistics.median(s.files for s in late[:third])
    return Growth(rss, anonymous, files, exit_code)


def table(samples: Sequence[Sample], rows: int = 13) -> str:
    step = max(1, (len(samples) - 1) // (rows - 1))
    lines = [f"{'minute':>8} {'RSS MB':>9} {'anon MB':>9} {'files':>6} {'threads':>8} {'processes':>10}"]
    lines += [
        f"{s.minute:8.1f} {s.rss_mb:9.1f} {s.anonymous_mb:9.1f} {s.files:6d} {s.threads:8d} {s.processes:10d}"
        for s in samples[::step]
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Watch the command, print table and fit, write JSON; return the exit code."""
    parser = argparse.ArgumentParser(prog="python tests/benchmarks/growth.py")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between samples")
    parser.add_argument("--warmup", type=float, default=10.0, help="minutes that do not count")
    parser.add_argument("--bound", type=float, default=BOUND_MB_PER_HOUR, help="MB per hour that are no growth")
    parser.add_argument("--json", type=Path)
    parser.add_argument("command", nargs="*")
    chosen = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        out = str(Path(scratch) / "run")
        esp = [str(Path(sys.executable).with_name("esp")), "train", "--task", "navigation", "--algo", "mappo"]
        command = chosen.command or [*esp, "--steps", "1000M", "--out", out]
        log = (chosen.json or Path(scratch) / "growth.json").with_suffix(".log")
        samples, code = watch(command, chosen.minutes, chosen.every, log)
    growth = fit(samples, chosen.warmup, code)
    print(table(samples))
    print(
        f"after {chosen.warmup:g} min: RSS {growth.rss_mb_per_hour:+.2f} MB/hour, anonymous "
        f"{growth.anonymous_mb_per_hour:+.2f} MB/hour, files {growth.files:+g}; exit code {code}"
    )
    if chosen.json is not None:
        found = {"command": command, "samples": [asdict(s) for s in samples], "growth": asdict(growth)}
        chosen.json.write_text(json.dumps(found, indent=1))
    return int(growth.exceeds(chosen.bound))


if __name__ == "__main__":
    sys.exit(main())
