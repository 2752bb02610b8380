"""Drawing without a display: which OpenGL library does it, and what to install where none can.

MuJoCo chooses a library when it is imported, by the variable MUJOCO_GL. Here the library is chosen when the first
picture is drawn, so physics may be imported long before, and on machines that cannot draw at all.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from esp_envs.errors import UserError

_LIBRARIES = {
    "osmesa": ("OSMesa", ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")),
    "egl": ("EGL", ("libEGL.so.1", "libEGL.so")),
}
"""MuJoCo's name of each library, preferred first: OSMesa draws on any processor, EGL asks for a working driver."""
_VARIABLE = "MUJOCO_GL"
_MISSING = "not installed"
_ADVICE = "to draw in software, install OSMesa: apt-get install libosmesa6 (Fedora: dnf install mesa-libOSMesa)"


class NoGraphicsError(UserError):
    """No library on this machine can draw without a display."""


def is_installed(backend: str) -> bool:
    """Say whether the library of "osmesa" or "egl" can be loaded; MuJoCo's own message does not name the library."""
    for name in _LIBRARIES[backend][1]:
        with suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


def forget_missing_backend() -> None:
    """Take MUJOCO_GL out of the environment where the library that it names is missing.

    `import mujoco` would otherwise fail with "'NoneType' object has no attribute 'glGetError'", even for training,
    which draws nothing. To be called before MuJoCo is imported.
    """
    named = os.environ.get(_VARIABLE, "").strip().lower()
    if named in _LIBRARIES and not is_installed(named):
        del os.environ[_VARIABLE]


@dataclass(frozen=True)
class Context:
    """An open OpenGL context.

    Attributes:
        make_current: directs all that MuJoCo draws in this thread to this context.
        note: a sentence for the user where a better library is missing, else None.
    """

    make_current: Callable[[], None]
    note: str | None


@contextmanager
def context(width: int, height: int) -> Iterator[Context]:
    """Open a context for pictures of this size (pixels), the current one until another is, and close it at the end.

    Raises:
        NoGraphicsError: nothing here can draw.
    """
    wished = os.environ.get(_VARIABLE, os.environ.get("PYOPENGL_PLATFORM", "")).strip().lower()
    reasons: dict[str, str] = {}
    for backend in sorted(_LIBRARIES, key=lambda name: name != wished):
        label = _LIBRARIES[backend][0]
        if not is_installed(backend):
            reasons[label] = _MISSING
            continue
        try:
            opened = _open(backend, width, height)
        except Exception as error:  # drivers fail in ways of their own
            reasons[label] = " ".join(f"{error}".split()) or type(error).__name__
            continue
        note = f"{label} draws{_told(reasons)}" if reasons else None
        try:
            yield Context(opened.make_current, note)
        finally:
            opened.free()
        return
    raise NoGraphicsError(f"nothing here can draw a view in space{_told(reasons)}")


def _told(reasons: dict[str, str]) -> str:
    """Return why libraries cannot draw, and what to do where that is known."""
    listed = "; ".join(f"{label}: {reason}" for label, reason in reasons.items())
    return f" ({listed})" + (f"; {_ADVICE}" if _MISSING in reasons.values() else "")


def _open(backend: str, width: int, height: int) -> Any:
    """Return a current context of this library, after MuJoCo has prepared a first picture in it."""
    mujoco = import_module("mujoco")
    made = import_module(f"mujoco.{backend}").GLContext(width, height)
    try:
        made.make_current()
        mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100.value).free()
    except Exception:
        made.free()
        raise
    return made
