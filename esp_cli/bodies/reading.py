"""Read robot models: MJCF and URDF files, by MuJoCo's own reader, after a look at what they would make it do."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import mujoco

from esp_envs.errors import UserError

MODEL_BYTES, ASSET_BYTES = 16 * 2**20, 512 * 2**20
"""Largest size of one XML file, and of all meshes and pictures together."""
MOST_ELEMENTS, MOST_DEPTH, LARGEST_COUNT = 50_000, 100, 65_536
"""Most elements of a model after replication, how deep they nest, and the largest number that asks for memory."""
MOST_DOFS = 1000
"""Degrees of freedom of the largest model that is analysed."""

_COUNTS = {"replicate", "composite", "flexcomp"}
_SIZES = ("nrow", "ncol", "width", "height", "nuser", "nkey", "resolution")
_LIMITS = (
    dict.fromkeys(_SIZES, LARGEST_COUNT) | dict.fromkeys(("njmax", "nconmax", "nstack"), 10**7) | {"memory": 2**30}
)
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def printable(text: str) -> str:
    """Return a name as messages and tables show it: quoted and escaped where it holds other than printed characters."""
    return text if text and text.isprintable() else repr(text)


def read_model(path: Path | str, root: Path | str | None = None, floating: bool = True) -> Any:
    """Return the `mujoco.MjModel` of an MJCF or URDF file.

    A world without geometry gets a floor, so that contacts can be compared.

    Args:
        path: of the file.
        root: the folder that holds all files that are read; by default that of `path`.
        floating: whether the first link of a URDF moves freely; MuJoCo would weld it to the world.

    Raises:
        UserError: the file is missing, no model, or too large; it names files outside `root`; or MuJoCo refuses it.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"there is no model file {path}; give an MJCF or URDF file")
    allowed = (path.parent if root is None else Path(root)).resolve()
    tag = _Inspection(path, allowed).inspect()
    with quiet(), _one_sentence(path):
        spec = mujoco.MjSpec.from_file(str(path))
        if tag == "robot":
            _release(spec, floating)
        if not spec.worldbody.geoms:  # something to stand on
            every = 2**31 - 1
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=every, conaffinity=every)
        model = spec.compile()
    check_size(model)
    return model


def check_size(model: Any) -> None:
    """Refuse a model with nothing that moves, or with too much.

    Raises:
        UserError: it has.
    """
    if not model.njnt:
        raise UserError("the model has no joint, so nothing of it moves; give the model of a robot")
    if model.nv > MOST_DOFS:
        raise UserError(f"the model has {model.nv} degrees of freedom, more than {MOST_DOFS}; give one robot alone")


@contextmanager
def quiet() -> Iterator[None]:
    """Keep MuJoCo from writing its warnings to a file in the working directory."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        mujoco.set_mju_user_warning(before)


@contextmanager
def _one_sentence(path: Path) -> Iterator[None]:
    """Turn what MuJoCo refuses into one sentence."""
    try:
        yield
    except (ValueError, mujoco.FatalError, mujoco.UnexpectedError) as error:
        words = " ".join(str(error).removeprefix("Error:").split()).rstrip(".")
        raise UserError(f"MuJoCo cannot read {printable(str(path))}: {words[:300]}") from None


def _release(spec: Any, floating: bool) -> None:
    """Let the first link of a URDF move freely, unless the file welds it to a link that is called "world"."""
    spec.compiler.fusestatic = False
    first = spec.worldbody.first_body()
    if floating and first is not None and first.name != "world" and not first.joints:
        first.add_freejoint()


class _Inspection:
    """What a model file and its includes ask for, found before MuJoCo reads any of it."""

    def __init__(self, path: Path, allowed: Path) -> None:
        self.path, self.allowed = path, allowed
        self.seen: set[Path] = set()
        self.elements = self.bytes = 0
        self.folders = {path.parent}

    def inspect(self) -> str:
        """Return the tag of the file's first element after checking everything.

        Raises:
            UserError: something is out of bounds.
        """
        trees = list(self._trees(self.path))
        if trees[0].tag not in ("mujoco", "robot"):
            raise UserError(f"{self.path} is neither MJCF nor URDF: its first element is {printable(trees[0].tag)}")
        for tree in trees:
            for compiler in tree.iter("compiler"):
                self.folders |= {self.path.parent / compiler.attrib[x] for x in _FOLDERS if x in compiler.attrib}
        for tree in trees:
            self._check(tree)
        return trees[0].tag

    def _trees(self, path: Path) -> Iterator[ElementTree.Element]:
        """Yield the first elements of a file and of all that it includes."""
        self.seen.add(path.resolve())
        tree = _parsed(path)
        yield tree
        for part in (*tree.iter("include"), *tree.iter("model")):
            for found in self._files(part.attrib.get("file", ""), {self.path.parent, path.parent}):
                self.folders.add(found.parent)
                if found.resolve() not in self.seen:
                    yield from self._trees(found)

    def _files(self, name: str, folders: set[Path]) -> list[Path]:
        """Return the files that a name may stand for; MuJoCo may also take the last part of it alone.

        Raises:
            UserError: one lies outside the folder that may be read.
        """
        name = name.removeprefix("package://").replace("\\", "/")
        found = [folder / one for folder in folders for one in {name, PurePosixPath(name).name} if one]
        found = [path for path in found if _exists(path)]
        for path in found:
            if not path.resolve().is_relative_to(self.allowed):
                raise UserError(
                    f"{self.path} names the file {printable(name)}, which lies outside {self.allowed}; name the folder "
                    "that holds all its files as root (--root)"
                )
        return found

    def _check(self, tree: ElementTree.Element) -> None:
        """Refuse files outside, and numbers that would fill the memory."""
        waiting = [(tree, 1, 1)]
        while waiting:
            element, times, depth = waiting.pop()
            if element.tag in _COUNTS:
                for word in element.attrib.get("count", "1").split():
                    times *= _whole(word)
            self.elements += times
            if self.elements > MOST_ELEMENTS or depth > MOST_DEPTH:
                raise UserError(f"{self.path} has more than {MOST_ELEMENTS} elements, or nests too deep")
            for key, value in element.attrib.items():
                if key.startswith("file") and element.tag not in ("include", "model"):
                    self.bytes += max((found.stat().st_size for found in self._files(value, self.folders)), default=0)
                limit = next((most for name, most in _LIMITS.items() if key.startswith(name)), None)
                if limit is not None and max(map(_whole, value.split()), default=0) > limit:
                    raise UserError(f"{self.path}: {key}={value[:40]!r} is more than {limit}; give a smaller one")
            waiting += [(child, times, depth + 1) for child in element]
        if self.bytes > ASSET_BYTES:
            raise UserError(f"{self.path} names more than {ASSET_BYTES >> 20} MiB of meshes and pictures")


def _exists(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that is too long, or holds a zero byte
        return False


def _whole(word: str) -> int:
    """Return a whole number of an attribute, with its unit as in memory="2M"; 1 for any other word."""
    unit = "KMGTPE".find(word[-1:].upper()) + 1
    digits = word[:-1] if word and unit else word
    if not digits.lstrip("+").isdecimal():
        return 1
    return int(digits[:20]) * 1024**unit


def _parsed(path: Path) -> ElementTree.Element:
    """Parse one XML file without a document type, so that no entity is defined.

    Raises:
        UserError: it is none, or too large.
    """
    if path.stat().st_size > MODEL_BYTES:
        raise UserError(f"{path} has {path.stat().st_size >> 20} MiB; a model file has at most {MODEL_BYTES >> 20}")
    builder = _Builder()
    try:
        return ElementTree.fromstring(path.read_bytes(), ElementTree.XMLParser(target=builder))
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        if isinstance(error, UserError):
            raise UserError(f"{path}: {error}") from None
        raise UserError(f"{path} is not an XML file: {' '.join(str(error).split())}") from None


class _Builder(ElementTree.TreeBuilder):
    """Builds elements, and refuses a document type before its entities are read."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """Refuse.

        Raises:
            UserError: always.
        """
        raise UserError("it declares a document type, which models do not need; remove <!DOCTYPE ...>")
