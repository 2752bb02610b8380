"""What decides whether two machines compute the same: versions of the program and of the libraries under it."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import esp_envs
from esp_cli.defaults import __version__
from esp_envs.errors import UserError

_LIBRARIES = ("torch", "numpy", "mujoco", "pymunk")


@cache
def versions() -> Mapping[str, str]:
    """Return versions by name; that of esp itself holds a digest of its source files."""
    found = {"esp": f"{__version__} ({_source_digest()})", "Python": platform.python_version()}
    return found | {name: _version(name) for name in _LIBRARIES}


def refuse_difference(node: str, theirs: Mapping[str, str]) -> None:
    """Refuse a node whose versions are not those of this machine.

    Args:
        node: its name.
        theirs: versions of the node.

    Raises:
        UserError: they differ; the message names all that do.
    """
    ours = versions()
    unlike = [name for name in ours if theirs.get(name) != ours[name]]
    if unlike:
        there = ", ".join(f"{name} {theirs.get(name, 'missing')}" for name in unlike)
        here = ", ".join(ours[name] for name in unlike)
        raise UserError(f"the node {node} has {there}, but this machine has {here}; install the same versions on both")


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def _source_digest() -> str:
    """Return a digest of all source files, so that two checkouts of one version are told apart."""
    digest = hashlib.sha256()
    for root in (Path(__file__).parents[1], Path(esp_envs.__path__[0])):
        for file in sorted(root.rglob("*.py")):
            digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:10]
