"""Write docs/robot-models.md: the symmetries of every robot model that installed packages bring.

    python docs/make_robots.py mjlab gymnasium dm_control gymnasium_robotics mujoco

A package that is not installed is left out.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from esp_cli.bodies import Body, read_model
from esp_envs.errors import UserError

PAGE = Path(__file__).parent / "robot-models.md"
_HEAD = """# Robot models

What `esp mirror` finds in the models that packages bring: {held} of {tried} models with joints have a mirror or turn.
`python docs/make_robots.py PACKAGE...` writes this page; [Legged robots](legged-robots.md) says how a mirror is
derived and proven. Seconds are of one core, without reading the file, for all elements. A gap is that of the worst
joint's accelerations, as a share of them, for the first element; the median is of the states. Last stands the gap of
the least mistake that was planted. {left} files are [left out](#left-out).

| model | joints | seconds | symmetry | verdict | gap | median | of a planted mistake |
|---|---:|---:|---|---|---:|---:|---:|
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
    "neither MJCF nor URDF": "a part that models include, or other XML",
    "Error opening file": "a file that it names is not there",
}


def reason(error: UserError) -> str:
    """Return why a file is left out, as many have it in common, or in MuJoCo's words."""
    text = str(error)
    told = text.partition("MuJoCo cannot read ")[2].partition(": ")[2].partition(" Element ")[0] or text
    return next((why for words, why in _REASONS.items() if words in text), f"MuJoCo refuses it: {told}")


def rows(package: str, root: Path) -> Iterator[list[str]]:
    """Yield a row of a table for each model of a package, of eight cells or four, or why a file is none, in one."""
    for path in sorted([*root.rglob("*.xml"), *root.rglob("*.urdf")]):
        try:
            model, start = read_model(path, root), time.process_time()
            body = Body.from_mjcf(model)
        except UserError as error:
            print(f"{path}: {error}", file=sys.stderr)
            yield [reason(error)]
            continue
        spent = time.process_time() - start
        name = path.relative_to(root).as_posix().removeprefix("envs/").replace("/assets/", "/")
        cells = [f"{package}/{name}", str(len(body.joints)), f"{spent:.2g}"]
        if body.found:
            proof = next(iter(body.found.values())).proof
            yield [
                *cells,
                body.group,
                proof.verdict,
                f"{proof.gap:.1g}",
                f"{proof.median:.1g}",
                f"{proof.planted.min():.2g}",
            ]
        else:
            told = [f"{element}: {why}" for element, why in body.refused.items()]
            yield [*cells, (told or ["no element of the plane moves anything of it"])[0]]


def page(table: list[list[str]]) -> str:
    """Return the page of these rows."""
    held, none, left = ([row for row in table if len(row) in cells] for cells in ((8,), (4,), (1,)))
    counts = Counter(row[0] for row in left).most_common()
    parts = (held, none, [[str(count), why] for why, count in counts])
    tables = ["".join(f"|{'|'.join(row)}|\n" for row in part) for part in parts]
    head = _HEAD.format(held=len(held), tried=len(held) + len(none), left=len(left))
    return head + tables[0] + _NONE + tables[1] + _LEFT + tables[2]


def main() -> None:
    """Write the page."""
    table: list[list[str]] = []
    for package in sys.argv[1:]:
        spec = importlib.util.find_spec(package)
        if spec is None or not spec.submodule_search_locations:
            print(f"{package} is not installed")
            continue
        table += rows(package, Path(spec.submodule_search_locations[0]))
    PAGE.write_text(page(table), encoding="utf-8")


if __name__ == "__main__":
    main()
