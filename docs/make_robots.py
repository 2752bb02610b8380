"""Write docs/robot-models.md: the symmetries of every robot model that installed packages bring.

    python docs/make_robots.py mjlab gymnasium dm_control gymnasium_robotics mujoco

What was found is put in docs/measured/robot-models.json, of which the page is made; without a package, the page alone
is made anew. A package that is not installed is left out.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from esp_cli.bodies import Body, read_model
from esp_envs.errors import UserError

PAGE = Path(__file__).parent / "robot-models.md"
RECORD = Path(__file__).parent / "measured" / "robot-models.json"
_HEAD = """# Robot models

What `esp mirror` finds in the models that packages bring: {held} of {tried} models with joints have a mirror or turn.
`python docs/make_robots.py PACKAGE...` writes this page ([JSON](measured/robot-models.json)); [Legged
robots](legged-robots.md) says how a mirror is derived and proven. Seconds are of one core, without reading the file,
for all elements. A gap is that of the worst joint's accelerations, as a share of them, for the first element; the
median is of the states. Then stands the gap of the least mistake that was planted, and last, where a sensor has no
image under an element, the worst of them. The packages are {packages}. {left} files are [left out](#left-out).

| model | joints | seconds | symmetry | verdict | gap | median | of a planted mistake | sensors |
|---|---:|---:|---|---|---:|---:|---:|---|
"""
_NONE = """
## Without a symmetry

| model | joints | seconds | what is in the way |
|---|---:|---:|---|
"""
_LEFT = """
## Left out

| files | why |
|---:|---|
"""
_REASONS = {
    " 0 degrees of freedom": "nothing moves",
    "has no mass or inertia": "something moves and has no mass or inertia",
    "neither MJCF nor URDF": "a part that models include, or other XML",
    "Error opening file": "a file that it names is not there",
}


def reason(error: UserError) -> str:
    """Return why a file is left out, as many have it in common, or in MuJoCo's words."""
    text = str(error)
    told = text.partition("MuJoCo cannot read ")[2].partition(": ")[2].partition(" Element ")[0] or text
    return next((why for words, why in _REASONS.items() if words in text), f"MuJoCo refuses it: {told}")


def found(package: str, root: Path) -> Iterator[dict[str, Any]]:
    """Yield what is found of each model of a package, what is in the way, or why a file is left out."""
    for path in sorted([*root.rglob("*.xml"), *root.rglob("*.urdf")]):
        name = path.relative_to(root).as_posix().removeprefix("envs/").replace("/assets/", "/")
        row: dict[str, Any] = {"model": f"{package}/{name}"}
        try:
            model, start = read_model(path, root), time.process_time()
            body = Body.from_mjcf(model)
        except UserError as error:
            print(f"{path}: {error}", file=sys.stderr)
            yield row | {"left out": reason(error)}
            continue
        row |= {"joints": len(body.joints), "seconds": float(f"{time.process_time() - start:.2g}")}
        if body.found:
            yield row | {"symmetry": body.group, **{name: one.proof.summary for name, one in body.found.items()}}
        else:
            told = [f"{element}: {why}" for element, why in body.refused.items()]
            yield row | {"in the way": (told or ["no element of the plane moves anything of it"])[0]}


def cells(row: dict[str, Any]) -> list[str]:
    """Return the cells of a table: nine of a model with a symmetry, four of one without."""
    start = [row["model"], str(row["joints"]), f"{row['seconds']:.2g}"]
    if "in the way" in row:
        return [*start, row["in the way"]]
    proofs = {name: proof for name, proof in row.items() if isinstance(proof, dict)}
    one = next(iter(proofs.values()))
    gaps = [(gap, f"{sensor} {gap:.2g} ({name})") for name, p in proofs.items() for sensor, gap in p["sensors"].items()]
    worst = max(gaps, default=(0.0, ""))
    sensors = worst[1] if any(proof["verdict"] == "broken sensors" for proof in proofs.values()) else ""
    numbers = [f"{one['gap']:.1g}", f"{one['median']:.1g}", f"{one['smallest_planted']:.2g}"]
    return [*start, row["symmetry"], one["verdict"], *numbers, sensors]


def page(record: dict[str, Any]) -> str:
    """Return the page of what was found."""
    models = record["models"]
    table = [cells(row) for row in models if "left out" not in row]
    held, none = ([row for row in table if len(row) == count] for count in (9, 4))
    left = Counter(row["left out"] for row in models if "left out" in row)
    parts = (held, none, [[str(count), why] for why, count in left.most_common()])
    tables = ["".join(f"|{'|'.join(row)}|\n" for row in part) for part in parts]
    packages = ", ".join(f"{name} {number}" for name, number in record["packages"].items())
    head = _HEAD.format(held=len(held), tried=len(table), left=left.total(), packages=packages)
    return head + tables[0] + _NONE + tables[1] + _LEFT + tables[2]


def main() -> None:
    """Look at the packages, and write the page."""
    if len(sys.argv) > 1:
        models, packages = list[dict[str, Any]](), dict[str, str]()
        for package in sys.argv[1:]:
            spec = importlib.util.find_spec(package)
            if spec is None or not spec.submodule_search_locations:
                print(f"{package} is not installed")
                continue
            packages[package] = version(package)
            models += found(package, Path(spec.submodule_search_locations[0]))
        command = f"python docs/make_robots.py {' '.join(sys.argv[1:])}"
        record = {"command": command, "packages": packages, "models": models}
        RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(json.loads(RECORD.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
