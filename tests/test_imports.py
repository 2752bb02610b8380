"""Imports point one way, heavy or chatty libraries stay in their rooms, and no file format can run code.

commands -> export, reporting -> drawing -> policies -> training -> algorithms -> prior, networks -> symmetry
reporting -> studies -> policies; all that knows tasks by their contract alone -> esp_envs.spec

The environment classes behind the contract (`esp_envs.spec` and `esp_envs.base`) are known to training and above only.
"""

import ast
import re
import runpy
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

RANKS = {
    "defaults": 0,
    "files": 0,
    "machine": 0,
    "console": 0.5,
    "symmetry": 1,
    "prior": 2,
    "networks": 2,
    "algorithms": 3,
    "training": 4,
    "policies": 5,
    "checking": 6,
    "bodies": 6.5,
    "loop": 6.7,
    "drawing": 6,
    "studies": 6.5,
    "export": 7,
    "reporting": 7,
    "run": 7.5,
    "": 7.7,  # esp_cli itself: what other programs use
    "commands": 8,
    "app": 9,
    "__main__": 10,
}
"""A part may import parts of a lower rank, and itself; parts of one rank do not know each other."""
CONTRACT_ONLY_UP_TO = RANKS["algorithms"]
"""Up to this rank, tasks are known by their contract alone; those above make environments by name."""
CONTRACT = tuple(f"esp_envs.{name}." for name in ("spec", "base", "roles", "views", "installed", "scene", "errors"))
PRINTING = {"app", "commands", "console"}
STUDIES = {"studies", "reporting"}
ROOMS = {"typer": PRINTING, "rich": PRINTING, "esp_cli.console": PRINTING, "ray": STUDIES}
SIMULATORS = {"mujoco": ("esp_envs.epuck", "esp_cli.bodies"), "pymunk": ("esp_envs.epuck",)}
CODE_IN_DATA = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "shelve", "marshal", "torch.load", "torch.save"}
_TARGET = re.compile(r"(esp_(?:cli|envs)[\w.]*):\w+")


def imports_of(source: str, module: str, is_package: bool) -> Iterator[tuple[int, str]]:
    """Yield (line, dotted name) of all that a module imports, wherever in it.

    `from a import b` yields a.b, which is right for modules and harmless for names; lazy "module:function" targets
    and uses of `torch.load` and `torch.save` count as imports too.
    """
    package = module.split(".") if is_package else module.split(".")[:-1]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{stem}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "torch":
            yield node.lineno, f"torch.{node.attr}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _TARGET.fullmatch(node.value):
            yield node.lineno, node.value.split(":")[0]


def forbidden(module: str, imported: str) -> str | None:
    """Say which rule an import breaks, or None."""
    package, _, rest = module.partition(".")
    part, top = rest.partition(".")[0], imported.partition(".")[0]
    if top in CODE_IN_DATA or imported in CODE_IN_DATA:
        return "loading a file must never run code"
    if not module.startswith(SIMULATORS.get(top, "")):
        return f"{top} belongs in {' and '.join(SIMULATORS[top])}"
    if package == "esp_envs":
        kept_out = {"esp_cli": "esp_envs knows nothing of esp_cli", "typer": "esp_envs does not print"}
        return kept_out.get("typer" if top == "rich" else top)
    for room, parts in ROOMS.items():
        if (imported + ".").startswith(room + ".") and part not in parts:
            return f"{room} belongs in {', '.join(sorted(parts))}"
    if top == "esp_envs" and RANKS.get(part, 99) <= CONTRACT_ONLY_UP_TO:
        return None if f"{imported}.".startswith(CONTRACT) else "below training, only the contract of tasks is known"
    if top != "esp_cli" or imported.startswith("esp_cli.console"):
        return None
    if part == "console":
        known = f"{imported}.".startswith(("esp_cli.files.formatting.", "esp_cli.files."))
        return None if known else "the console knows nothing of the application"
    wanted = imported.split(".")[1] if "." in imported else ""
    if wanted == part or wanted.startswith("__"):
        return None
    if part not in RANKS or wanted not in RANKS:
        return f"{part if part not in RANKS else wanted} has no place in the order of imports"
    return None if RANKS[wanted] < RANKS[part] else f"{part} may not import {wanted}"


def modules(root: Path) -> Iterator[tuple[Path, str, bool]]:
    """Yield path, dotted name and whether it is a package of every module under the source roots of `root`."""
    for source_root, package in ((root, "esp_cli"), (root / "environments", "esp_envs")):
        for path in sorted((source_root / package).rglob("*.py")):
            is_package = path.name == "__init__.py"
            parts = path.relative_to(source_root).with_suffix("").parts
            yield path, ".".join(parts[:-1] if is_package else parts), is_package


def violations(root: Path) -> list[str]:
    found = []
    for path, module, is_package in modules(root):
        for line, imported in imports_of(path.read_text(encoding="utf-8"), module, is_package):
            rule = forbidden(module, imported)
            if rule:
                found.append(f"{path.relative_to(root)}:{line} imports {imported}: {rule}")
    return found


def circle(root: Path) -> list[str]:
    """Return modules that import each other in a circle, lazily or not; none where there is no circle.

    The package `esp_cli` itself is left out: all know its version, and it loads policies by a lazy import.
    """
    files = {module: (path, is_package) for path, module, is_package in modules(root) if module != "esp_cli"}
    known = {}
    for module, (path, is_package) in files.items():
        names = [name for _, name in imports_of(path.read_text(encoding="utf-8"), module, is_package)]
        wanted = {name if name in files else name.rpartition(".")[0] for name in names}
        known[module] = wanted & set(files) - {module}
    try:
        TopologicalSorter(known).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert circle(ROOT) == []


def test_a_lazy_circle_is_found(tmp_path: Path) -> None:
    room = tmp_path / "environments" / "esp_envs"
    room.mkdir(parents=True)
    (room / "gl.py").write_text("def open():\n    from esp_envs.view import paint")
    (room / "view.py").write_text("import esp_envs.base")
    assert circle(tmp_path) == []
    (room / "view.py").write_text("import esp_envs.gl")
    assert set(circle(tmp_path)) == {"esp_envs.gl", "esp_envs.view"}


def test_the_imports_keep_their_direction() -> None:
    assert violations(ROOT) == []


def test_both_packages_are_looked_at() -> None:
    assert (ROOT / "esp_cli" / "app.py").exists()
    assert (ROOT / "environments" / "esp_envs" / "spec.py").exists()


@pytest.mark.parametrize(
    ("path", "source", "rule"),
    [
        ("esp_cli/symmetry/groups.py", "from esp_cli.prior import losses", "symmetry may not import prior"),
        ("esp_cli/symmetry/groups.py", "from ..training import loop", "symmetry may not import training"),
        ("esp_cli/symmetry/__init__.py", "from ..training import loop", "symmetry may not import training"),
        ("esp_cli/prior/losses.py", "from esp_cli.networks.layers import Linear", "prior may not import networks"),
        ("esp_cli/algorithms/mappo.py", "from esp_cli import training", "algorithms may not import training"),
        ("esp_cli/algorithms/learner.py", "T = {'a': 'esp_cli.training.loop:run'}", "may not import training"),
        ("esp_cli/training/loop.py", "def f():\n    import esp_cli.commands.train", "training may not import commands"),
        ("esp_cli/training/loop.py", "from esp_cli.console import say", "esp_cli.console belongs in"),
        ("esp_cli/training/loop.py", "from rich.table import Table", "rich belongs in"),
        ("esp_cli/misc.py", "import esp_cli.training", "misc has no place"),
        ("esp_cli/console.py", "from esp_cli.commands import COMMANDS", "the console knows nothing"),
        ("esp_cli/algorithms/mappo.py", "from esp_envs.mpe.navigation import Navigation", "only the contract"),
        ("esp_cli/training/checkpoint.py", "import pickle", "never run code"),
        ("esp_cli/training/checkpoint.py", "import torch\nx = torch.load('f')", "never run code"),
        ("esp_cli/training/checkpoint.py", "from torch import load", "never run code"),
        ("environments/esp_envs/base.py", "from esp_cli.symmetry import groups", "knows nothing of esp_cli"),
        ("environments/esp_envs/mpe/world.py", "import mujoco", "mujoco belongs in esp_envs.epuck"),
        ("esp_cli/export/export.py", "from pymunk import Body", "pymunk belongs in esp_envs.epuck"),
    ],
)
def test_a_forbidden_import_is_found(tmp_path: Path, path: str, source: str, rule: str) -> None:
    (tmp_path / path).parent.mkdir(parents=True)
    (tmp_path / path).write_text(source)
    found = violations(tmp_path)
    assert len(found) == 1
    assert path in found[0]
    assert rule in found[0]


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("esp_cli/app.py", "import typer\nfrom esp_cli import __version__, console\nfrom esp_cli.commands import X"),
        (
            "esp_cli/commands/train.py",
            "from esp_cli import console\nfrom esp_cli.training import loop\nimport esp_envs",
        ),
        ("esp_cli/prior/losses.py", "from esp_cli.symmetry.groups import Group\nfrom esp_envs.spec import Layout"),
        ("esp_cli/console.py", "from esp_cli.files.formatting import format_count as format_count"),
        ("esp_cli/training/loop.py", "import torch\nfrom esp_envs import make\nfrom esp_cli.prior import losses"),
        ("esp_cli/symmetry/transforms.py", "from esp_cli.symmetry.groups import Group\nfrom .groups import Element"),
        ("environments/esp_envs/epuck/planar.py", "import mujoco\nfrom esp_envs.spec import Layout"),
    ],
)
def test_an_allowed_import_is_let_through(tmp_path: Path, path: str, source: str) -> None:
    (tmp_path / path).parent.mkdir(parents=True)
    (tmp_path / path).write_text(source)
    assert violations(tmp_path) == []


def upward(rooms: dict[str, tuple[float, float, str]], arrows: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Return the arrows of a picture of rooms that point up, on the paper or by the ranks."""
    ranks = RANKS | {"tasks": -1, "spec": -2}  # both in esp_envs, which stands below all of esp_cli
    return [(a, b) for a, b in arrows if ranks[a] <= ranks[b] or rooms[a][1] <= rooms[b][1]]


def test_the_picture_of_the_rooms_shows_every_room_and_points_down() -> None:
    rooms, arrows = runpy.run_path(str(ROOT / "docs" / "make_pictures.py"))["ROOMS"]
    assert upward(rooms, arrows) == []
    assert {path.parent.name for path in (ROOT / "esp_cli").glob("*/__init__.py")} <= {
        n for pair in arrows for n in pair
    }


def test_an_arrow_that_points_up_is_seen() -> None:
    rooms = {"prior": (0.0, 1.0, "prior"), "training": (0.0, 2.0, "training"), "symmetry": (0.0, 3.0, "symmetry")}
    pairs = [("training", "prior"), ("prior", "training"), ("prior", "symmetry")]
    assert upward(rooms, pairs) == [("prior", "training"), ("prior", "symmetry")]
