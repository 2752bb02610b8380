"""Check the symmetries of tasks that others wrote and of the built-in ones, and write docs/atlas.md from the findings.

    python tests/benchmarks/atlas.py [--only PATTERN] [--json docs/measured/atlas.json]
    python tests/benchmarks/atlas.py --page docs/atlas.md

A script and no command: it needs the packages of all tasks, which no user needs together. It goes on in its file: a
task that is there is not checked again. What cannot be imported is listed as not run.
"""

import argparse
import contextlib
import json
import time
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from esp_cli import machine

if __name__ == "__main__":
    machine.prepare()  # as `esp` does, before torch is imported

from esp_cli.checking import check_symmetry
from esp_envs import Environment, UserError, make, register
from esp_envs.promises import MakeWorlds
from esp_envs.views import worlds_of_role
from tests.benchmarks import atlas_tasks

_VMAS = "esp_envs.adapters.vmas_scenarios"
SCENARIOS = (
    "Balance", "BallPassage", "BallTrajectory", "BuzzWire", "Discovery", "Dispersion", "Dropout", "Flocking",
    "Football", "GiveWay", "JointPassage", "JointPassageSize", "MultiGiveWay", "Navigation", "Passage",
    "ReverseTransport", "Sampling", "Transport", "Wheel", "WindFlocking",
)  # fmt: skip
BUILT_IN = {
    "navigation": {}, "predator-prey": {}, "wildlife": {"width": 5, "height": 5, "horizon": 30},
    "formation": {"horizon": 40, "num_agents": 4, "num_obstacles": 2},
}  # fmt: skip
COMMANDS = {"vmas": "pip install vmas", "mpe2": "pip install mpe2", "sisl": "pip install 'pettingzoo[sisl]'",
            "mujoco": "pip install 'gymnasium[mujoco]'", "foraging": "pip install lbforaging"}  # fmt: skip
NOT_CARRIED = {
    "mpe2 simple_crypto": "nothing in it has a place.",
    "vmas mpe and debug": "the former are the tasks of mpe2, the latter try the simulator.",
    "vmas road_traffic": "agents steer.",
    "sisl waterworld": "it is not part of PettingZoo 1.27.",
    "sisl multiwalker": "no turn or mirror of the plane moves what walkers see.",
    "mujoco Pusher": "no element could move its arm.",
}
"""Why tasks are left out."""
TRIED = {"collect_treasure": "d4,agents"}
"""What is tried, where it is not what a check tries by default."""
SECONDS = 1200.0
"""Time for a check; what does not fit in is not covered."""


def tasks() -> Iterator[tuple[str, str, Callable[[], tuple[str, dict[str, object]]], str | None]]:
    """Return package, name, what gives the registered name and settings, and transforms, None for the default ones."""
    for name, settings in BUILT_IN.items():
        yield "esp", name, lambda name=name, settings=settings: (name, settings), None
    for name in SCENARIOS:
        yield "vmas", name, lambda name=name: (register(f"{_VMAS}:{name}"), {}), None
    for package, found in (("mpe2", atlas_tasks.MPE), ("mujoco", atlas_tasks.MUJOCO)):
        for name, task in found.items():
            yield package, name, lambda task=task: (register(task), {"workers": 0}), TRIED.get(name)
    for name in atlas_tasks.ROBOTS:
        yield "mujoco", name, lambda name=name: (name, {"workers": 0}), None
    for name in atlas_tasks.MORE_ROBOTS:
        yield "mujoco", name, lambda name=name: (register(atlas_tasks.robot(name)), {"workers": 0}), None
    yield "sisl", "pursuit_v5", lambda: (register(atlas_tasks.PURSUIT), {"workers": 0}), "d4"
    yield "foraging", "8x8-2p-3f", lambda: (register(atlas_tasks.Foraging), {"workers": 0}), "d4,agents"


def looked_at(package: str, name: str, given: Callable[[], tuple[str, Any]], texts: str | None) -> list[dict[str, Any]]:
    """Return what a check says of a task, in a row for each role, or why it was not run."""
    try:
        task, settings = given()

        def worlds(num_envs: int, seeds: Any) -> Environment:
            return make(task, num_envs, seeds, settings)

        roles = worlds(1, [0]).spec.roles
        each = [(f"{name} ({role.name})", worlds_of_role(worlds, role.name)) for role in roles] or [(name, worlds)]
        return [{"package": package, "task": own, **_found(made, texts)} for own, made in each]
    except (ImportError, ValueError) as error:
        return [{"package": package, "task": name, "not run": f"{error}", "command": COMMANDS.get(package, "")}]


def _found(make_worlds: MakeWorlds, texts: str | None) -> dict[str, Any]:
    begun = time.process_time()
    try:
        report = check_symmetry(make_worlds, texts, seconds=SECONDS)
    except UserError as error:
        if (reason := str(error).partition(" can be tried on ")[2].partition(": ")[2]) and "no transform" in str(error):
            return {"found": "c1", "method": "its layouts", "elements": 0, "reason": reason}
        raise
    row: dict[str, Any] = {"found": report.found, "method": report.method, "elements": len(report.elements)}
    for element in report.elements:
        fields = [
            {
                "field": f.field,
                "gap": round(f.gap, 4),
                "error": round(f.error, 4),
                "share": None if f.share != f.share else round(f.share, 4),
            }
            for f in element.fields
            if f.outcome == element.outcome != "holds"
        ]
        row.setdefault(element.outcome, {})[element.element] = fields or element.reason
    return row | {"seconds": round(time.process_time() - begun, 1)}


def _task_of(row: dict[str, Any]) -> str:
    """Return the name of a row's task, without the role."""
    return str(row["task"]).partition(" (")[0]


def page(rows: list[dict[str, Any]]) -> str:
    text = Path(__file__).with_name("atlas_page.md").read_text()
    lines = ["| task | found | what breaks the others |", "|---|---|---|"]
    order = {(package, name): k for k, (package, name, *_) in enumerate(tasks())}
    rows = sorted(rows, key=lambda row: order.get((row["package"], _task_of(row)), len(order)))
    lines += [_line(row) for row in rows if "found" in row]
    missing = [f"- {row['package']} {row['task']}: {row['not run']}" for row in rows if "not run" in row]
    left = [f"- {names}: {why}" for names, why in NOT_CARRIED.items()]
    known = {(row["package"], _task_of(row)) for row in rows}
    left += [f"- {p} {n}: not checked yet; `{COMMANDS.get(p, '')}`." for p, n, *_ in tasks() if (p, n) not in known]
    return text.replace("TABLE", "\n".join(lines)).replace("LEFT", "\n".join(left + missing))


def _is_further_out(found: list[dict[str, Any]] | str) -> bool:
    return not isinstance(found, str) and any(field["share"] for field in found)


def _line(row: dict[str, Any]) -> str:
    worst: dict[str, tuple[float, str, str]] = {}
    for element, fields in row.get("broken", {}).items():
        found = max(fields, key=lambda field: field["gap"])
        share = "" if found["share"] is None else f", {100 * found['share']:.3g}%"
        worst.setdefault(found["field"], (found["gap"], element, share))
        worst[found["field"]] = max(worst[found["field"]], (found["gap"], element, share))
    told = [row["reason"]] if "reason" in row else []
    told += [f"{field} {gap:.3g} ({element}{share})" for field, (gap, element, share) in worst.items()]
    unseen = dict(row.get("not covered", {}))
    far = {name: unseen.pop(name) for name, found in list(unseen.items()) if _is_further_out(found)}
    for names, why in ((list(far), "only further out"), (list(unseen), "not covered")):
        told += [f"{why}: {', '.join(names[:3])}" + (" and more" if len(names) > 3 else "")] if names else []
    group = row["found"].replace(" and ", "` and `")  # code does not wrap
    how = "" if row["method"] == "paired states" else f" ({row['method']})"
    return f"| {row['package']}/{row['task']} | `{group}`{how} | {'; '.join(told[:3]) or '-'} |"


def main() -> None:
    """Check the tasks that are asked for, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="*", help="pattern of 'package task'")
    parser.add_argument("--json", type=Path, default=Path("docs/measured/atlas.json"))
    parser.add_argument("--page", type=Path, help="write this page from the file")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = json.loads(args.json.read_text()) if args.json.exists() else []
    if args.page:
        args.page.write_text(page(rows))
        return
    known = {(row["package"], _task_of(row)) for row in rows if "found" in row}
    for package, name, given, texts in tasks():
        if (package, name) in known or not fnmatch(f"{package} {name}", args.only):
            continue
        rows = [row for row in rows if (row["package"], _task_of(row)) != (package, name)]
        rows += looked_at(package, name, given, texts)
        shown = ("package", "task", "found", "not run", "seconds")
        print(*({k: row[k] for k in shown if k in row} for row in rows if _task_of(row) == name), flush=True)
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
