"""Small studies for the tests: planned as the commands plan them, their runs written by hand or by a stand-in."""

import json
import sys
from pathlib import Path
from typing import Any

from esp_cli.studies.catalogue import Request, plan
from esp_cli.studies.plan import Cell, Study
from esp_cli.studies.study import StudyFolder
from esp_cli.training.config import RunConfig
from esp_cli.training.folder_names import FINAL
from tests.training.runs import TINY

ANCHORS = {"random": -200.0, "heuristic": -100.0}
SEEDS = (0, 1, 2)


def request(**choice: Any) -> Request:
    overrides = {name: value for name, value in TINY.items() if not name.startswith("mappo.")}
    defaults = {"algorithms": ("mappo",), "steps": ((None, 200),), "seeds": SEEDS, "episodes": 4}
    return Request(**(defaults | {"overrides": overrides, "command": "esp reproduce table1 --steps 200"} | choice))


def small_study(kind: str = "table1", **choice: Any) -> Study:
    """Two runs, MAPPO with and without the prior on navigation, or what else is asked for."""
    defaults = {"tasks": ("navigation",)} if kind in ("table1", "agents") else {}
    return plan(kind, request(**(defaults | choice)))


def write_run(folder: StudyFolder, cell: Cell, rows: list[list[float | None]], finals: list[float | None]) -> None:
    run = folder.prepare(cell)
    lines = [
        {"step": 100 * k, "eval/return_greedy": row, "eval/return_stochastic": row, "time/elapsed_s": 10.0 * k}
        for k, row in enumerate(rows)
    ]
    run.metrics_path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    run.policy_path.write_bytes(b"weights")
    (folder.run_path(cell) / FINAL).write_text(json.dumps(final_evaluation(finals, cell.config)))


def final_evaluation(finals: list[float | None], config: RunConfig | None = None) -> dict[str, Any]:
    returns = {"mean": None, "sem": None, "ci95": None, "per_seed": finals}
    return {
        "esp_version": "0.0.1",
        "task": config.task if config else "navigation",
        "task_version": 1,
        "convention": "by hand",
        "step": config.steps if config else 200,
        "seeds": list(config.seeds if config else SEEDS),
        "episodes": 4,
        "greedy": returns,
        "stochastic": returns,
        "anchors": ANCHORS,
        "metrics": {"coverage": 0.5},
    }


def write_study(path: Path, study: Study, finals: dict[str, list[float | None]]) -> StudyFolder:
    """Write a study whose runs of these variants are finished, with curves that rise to where they end."""
    folder = StudyFolder.create(path, study)
    for cell in folder.study.cells:
        if cell.variant in finals:
            ends = finals[cell.variant]
            rows = [[None if x is None else x - 20.0 * (2 - k) for x in ends] for k in range(3)]
            write_run(folder, cell, rows, ends)
    return folder


_STAND_IN = r"""
import json, pathlib, signal, sys, time
from fcntl import flock, LOCK_EX, LOCK_NB
stopped = []
signal.signal(signal.SIGTERM, lambda *_: stopped.append(1))
what, run = sys.argv[1], pathlib.Path(sys.argv[-1] if sys.argv[1] == "train" else sys.argv[2])
with (run.parent.parent / "trace.txt").open("a") as trace:
    trace.write(f"{what} {run.name}\n")
if what == "eval":
    own = json.loads((run / "config.json").read_text())
    pathlib.Path(sys.argv[-1]).write_text(json.dumps(json.loads(FINAL) | {"task": own["task"]}))
    raise SystemExit
lock = (run / "run.lock").open("a+")
flock(lock, LOCK_EX | LOCK_NB)
config = json.loads((run / "config.json").read_text())
lines = (run / "metrics.jsonl").read_text().splitlines()
begin = json.loads(lines[-1])["step"] if lines else 0
for step in range(begin + 50, config["steps"] + 1, 50):
    if (run.parent.parent / f"fail-{run.name}").exists():
        print("error: the disk is on fire", file=sys.stderr)
        raise SystemExit(2)
    with (run / "metrics.jsonl").open("a") as metrics:
        metrics.write(json.dumps({"step": step, "time/elapsed_s": step / 100}) + "\n")
    time.sleep(SLEEP)
    if stopped:
        raise SystemExit(130)
(run / "policy.safetensors").write_text("weights")
"""


def stand_in(sleep_s: float = 0.0) -> tuple[str, ...]:
    """A program that does to run folders what training does, in no time: `trace.txt` says what was started."""
    final = json.dumps(final_evaluation([-1.0, -2.0, -3.0]))
    return (sys.executable, "-S", "-c", _STAND_IN.replace("SLEEP", repr(sleep_s)).replace("FINAL", repr(final)))
