"""An assault on the application that never ends by itself: kills, spoilt files, wrong command lines, hostile
robots, wrong mirrors, odd data of foreign loops.

    python -m tests.torture --minutes 10 [--seed 0] [--part kills|files|lines|models|mirrors|hosts] [--record FILE]

Every case follows from the seed and its number alone, so that a finding is repeated by `--only NUMBER`. The record is a
JSON file; the next call with the same file goes on where this one ended. The exit code is 1 if there are findings.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import argparse
import sys
import tempfile
import time
from pathlib import Path

import torch

from tests.torture import files, hosts, kills, lines, mirrors, models
from tests.torture.record import Record

PARTS = {
    "files": files.Files,
    "kills": kills.Kills,
    "lines": lines.Lines,
    "models": models.Models,
    "mirrors": mirrors.Mirrors,
    "hosts": hosts.Hosts,
}
SHARES = {"kills": 0.52, "files": 0.2, "lines": 0.12, "models": 0.1, "mirrors": 0.03, "hosts": 0.03}
"""Of the time; a kill takes longest."""


def main() -> int:
    """Run the parts for as long as was asked for, and say what was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.torture")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part", choices=PARTS, action="append")
    parser.add_argument("--until", type=int, default=sys.maxsize, help="end a part after this many cases in all")
    parser.add_argument("--only", type=int, help="this case alone, without a record")
    parser.add_argument("--record", type=Path, help="go on where this file ends, and write it")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    print(f"seed {chosen.seed}", flush=True)
    names = chosen.part or list(PARTS)
    shares = sum(SHARES[name] for name in names)
    record = Record.open(chosen.record, chosen.seed)
    with tempfile.TemporaryDirectory(prefix="esp-torture-", dir=_memory_folder()) as scratch:
        for name in names:
            part = PARTS[name](Path(scratch), chosen.seed)
            if chosen.only is not None:
                print(part.run(chosen.only) or "no finding")
                continue
            end = time.monotonic() + 60 * chosen.minutes * SHARES[name] / shares
            record.run(name, part, end, chosen.until)
    print(record.summary())
    return 1 if record.findings else 0


def _memory_folder() -> str | None:
    """Return a folder in memory, so that the disk is spared; None where there is none."""
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


if __name__ == "__main__":
    sys.exit(main())
