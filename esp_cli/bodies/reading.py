"""Read robot models: MJCF and URDF files, by MuJoCo's own reader, after a look at what they would make it do."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import mujoco

from esp_envs.errors import UserError

mujoco.set_mju_user_warning(lambda _: None)  # by default they go to a file in the working directory
XML_MIB, ASSET_MIB = 16, 256  # largest size of an XML file, and of a mesh or picture
MOST_ELEMENTS, MOST_DEPTH, MOST_BODIES, MOST_MOVING = 50_000, 100, 1000, 200
"""Most elements of a model after replication, depth of nesting, bodies, and degrees of freedom or actuators."""
_AREA, MOST_CELLS = ("nrow", "ncol", "width", "height"), 2**25
"""What spans pictures and height fields, and most cells of all of them together."""
_LIMITS = dict.fromkeys(("nuser", "nkey"), 65_536) | {"params": 1000, "memory": 2**30}
_LIMITS |= dict.fromkeys(("njmax", "nconmax", "nstack"), 10**7)
"""Largest numbers that ask MuJoCo for memory, by how their attributes begin."""
_COUNTED = ("replicate", "composite", "flexcomp")
_UNITS = "KMGTPE"


def printable(text: str) -> str:
    """Return a name as messages and tables show it: quoted and escaped where it holds other than printed characters."""
    return text if text and text.isprintable() else repr(text)


def read_model(path: Path | str, root: Path | str | None = None, floating: bool = True, urdf_only: bool = False) -> Any:
    """Return the `mujoco.MjModel` of an MJCF or URDF file.

    A world without geometry gets a floor, so that contacts can be compared.

    Args:
        path: of the file.
        root: the folder that holds all files that are read; by default that of `path`.
        floating: whether the first link of a URDF moves freely; MuJoCo would weld it to the world.
        urdf_only: whether MJCF is refused.

    Raises:
        UserError: the file is missing, no model, or too large; it names files outside `root`; or MuJoCo refuses it.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"there is no model file {path}; give an MJCF or URDF file")
    if root is not None and not Path(root).is_dir():
        raise UserError(f"there is no folder {root}; name the one that holds all files of the model as root (--root)")
    tag = _inspected(path, (path.parent if root is None else Path(root)).resolve())
    if urdf_only and tag == "mujoco":
        raise UserError(f"{path} is MJCF, not URDF; read it with Body.from_mjcf")
    with quiet():
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            if tag == "robot":
                spec.compiler.fusestatic = False
                first = spec.worldbody.first_body()
                if floating and first is not None and first.name != "world" and not first.joints:
                    first.add_freejoint()
            if not spec.worldbody.geoms:
                every = 2**31 - 1
                plane = mujoco.mjtGeom.mjGEOM_PLANE
                spec.worldbody.add_geom(type=plane, size=[0, 0, 1], contype=every, conaffinity=every)
            return spec.compile()
        except (ValueError, mujoco.FatalError, mujoco.UnexpectedError) as error:
            words = " ".join(str(error).removeprefix("Error:").split()).rstrip(".")
            if light := re.search("mjMINVAL.* name '([^']*)'", words):
                light_one = printable(light[1]) if light[1] else "a body"
                words = f"{light_one} moves but has no mass or inertia; give it an <inertial>"
            raise UserError(f"MuJoCo cannot read {printable(str(path))}: {words[:300]}") from None


@contextmanager
def quiet() -> Iterator[None]:
    """Keep warnings to itself, and put MuJoCo's errors in a sentence, as where contacts need too much memory."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except mujoco.FatalError as error:
        raise UserError(f"MuJoCo cannot simulate the model ({str(error).splitlines()[0]})") from None


def _inspected(path: Path, allowed: Path) -> str:
    """Return the tag of a model's first element after checking all that it and its includes ask for."""
    trees = list(_trees(path, path, allowed, set()))
    tag = trees[0][1].tag
    if tag not in ("mujoco", "robot"):
        raise UserError(f"{path} is neither MJCF nor URDF: its first element is {printable(tag)}")
    folders = {folder for folder, _ in trees}
    told = {x for _, tree in trees for c in tree.iter("compiler") for x in c.attrib.values() if x}
    folders |= {folder / _short(path, x) for folder, _ in trees for x in told}
    elements, cells, waiting = 0, 0, [(tree, 1, 1) for _, tree in reversed(trees)]
    while waiting:
        element, times, depth = waiting.pop()
        if element.tag in _COUNTED:
            times *= math.prod(map(_whole, element.attrib.get("count", "1").split()))
        elements += times
        spans = [_whole(word) for name in _AREA if (word := element.attrib.get(name))]
        if spans:
            cells += times * math.prod(spans if len(spans) > 1 else spans * 2)  # one spans a square
        if elements > MOST_ELEMENTS or depth > MOST_DEPTH:
            raise UserError(f"{path} has more than {MOST_ELEMENTS} elements, or nests too deep")
        if cells > MOST_CELLS:
            raise UserError(f"{path} has pictures and height fields of more than {MOST_CELLS} cells; give smaller ones")
        for key, value in element.attrib.items():
            if key.startswith("file"):
                for found in _files(path, value, folders, allowed):
                    _check_size(found, ASSET_MIB)
            limit = next((most for name, most in _LIMITS.items() if key.startswith(name)), None)
            if limit is not None and max(map(_whole, value.split()), default=0) > limit:
                raise UserError(f"{path}: {key}={value[:40]!r} is more than {limit}; give a smaller one")
        waiting += [(child, times, depth + 1) for child in element]
    return tag


def _trees(path: Path, main: Path, allowed: Path, seen: set[Path]) -> Iterator[tuple[Path, ElementTree.Element]]:
    """Yield the folder and first element of a file, and of all that it includes or attaches."""
    seen.add(path.resolve())
    tree = _parsed(path)
    yield path.parent, tree
    for part in (*tree.iter("include"), *tree.iter("model")):
        for found in _files(main, part.attrib.get("file", ""), {main.parent, path.parent}, allowed):
            if found.resolve() not in seen:
                yield from _trees(found, main, allowed, seen)


def _files(main: Path, name: str, folders: set[Path], allowed: Path) -> list[Path]:
    """Return the files in the readable folder that a name may stand for; MuJoCo may also take its last part alone."""
    name = _short(main, name.removeprefix("package://").replace("\\", "/"))
    names = {name, PurePosixPath(name).name} - {""}
    found = [path for path in (folder / one for folder in folders for one in names) if path.exists()]
    if any(not path.resolve().is_relative_to(allowed) for path in found):
        raise UserError(
            f"{main} names the file {printable(name)}, which lies outside {allowed}; name the folder that holds "
            "all its files as root (--root)"
        )
    if odd := next((path for path in found if not path.is_file()), None):
        raise UserError(f"{main} names the file {printable(name)}, but {printable(str(odd))} is no regular file")
    return found


def _short(main: Path, name: str) -> str:
    """Return the name of a file or folder, which is refused where no file system takes it."""
    if len(name) > 1000 or "\0" in name:
        raise UserError(f"{main} names the file {printable(name[:40])}...; give a shorter name")
    return name


def _whole(word: str) -> int:
    """Return a number of an attribute as a whole one, with its unit as in memory="2M"; 1 for any other word."""
    power = _UNITS.find(word[-1:].upper()) + 1
    try:
        number = float(word[:-1] if power else word)
    except ValueError:
        return 1
    return int(min(max(number, 1.0), 1e18)) * 1024**power  # 1 for NaN too


def _check_size(path: Path, most: int) -> None:
    if (size := path.stat().st_size >> 20) >= most:
        raise UserError(f"{printable(str(path))} has {size} MiB; a file of this kind has less than {most}")


def _parsed(path: Path) -> ElementTree.Element:
    """Parse one XML file without a document type, so that no entity is defined."""
    _check_size(path, XML_MIB)
    try:
        return ElementTree.fromstring(path.read_bytes(), ElementTree.XMLParser(target=_Builder()))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise UserError(f"{path} is not an XML file: {' '.join(str(error).split())}") from None


class _Builder(ElementTree.TreeBuilder):
    """Builds elements, called as MuJoCo calls them, and refuses a document type before its entities are read."""

    def start(self, tag: str, attrs: dict[str, str]) -> ElementTree.Element:
        """Begin an element; MuJoCo knows no namespaces, so that of a tag hides nothing."""
        return super().start(tag.rpartition("}")[2], attrs)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse."""
        raise UserError("it declares a document type, which models do not need; remove <!DOCTYPE ...>")
