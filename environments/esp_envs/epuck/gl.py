"""Drawing without a display: which OpenGL library does it, and what to install where none can.

MuJoCo chooses a library when it is imported, by the variable MUJOCO_GL. Here the library is chosen when the first
picture is drawn, so physics may be imported long before, and on machines that cannot draw at all.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module

from esp_envs.errors import UserError
from esp_envs.scene import Painter

_LIBRARIES = {"osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"), "egl": ("libEGL.so.1", "libEGL.so")}
"""Files of each library that MuJoCo names, preferred first: OSMesa draws anywhere, EGL asks for a working driver."""
_OF_SYSTEM = {"linux": ("osmesa", "egl", "glx"), "win32": ("wgl",), "darwin": ("cgl",)}
_ANYWHERE = ("glfw", "enable", "enabled", "on", "true", "1", "disable", "disabled", "off", "false", "0")
"""What else MuJoCo takes as MUJOCO_GL."""
_MISSING = "not installed"
_ADVICE = "to draw in software, install OSMesa: apt-get install libosmesa6 (Fedora: dnf install mesa-libOSMesa)"


class NoGraphicsError(UserError):
    """No library on this machine can draw without a display."""


def is_installed(backend: str) -> bool:
    """Say whether the library of "osmesa" or "egl" can be loaded; MuJoCo's own message does not name the library."""
    for name in _LIBRARIES[backend]:
        with suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


def forget_missing_backend() -> None:
    """Take MUJOCO_GL out of the environment where the library that it names is missing, before MuJoCo is imported.

    Its import fails otherwise ("'NoneType' object has no attribute 'glGetError'"), even where nothing is drawn.
    """
    named = os.environ.get("MUJOCO_GL", "").strip().lower()
    known = _OF_SYSTEM.get(sys.platform, ())
    if named in _LIBRARIES and not is_installed(named):
        del os.environ["MUJOCO_GL"]
    elif named and named not in (*known, *_ANYWHERE):
        raise UserError(f"MUJOCO_GL is {named!r}; set it to {', '.join(known)}, glfw or disable, or unset it")


@contextmanager
def open_painter(size: int) -> Iterator[Painter]:
    """Open a painter of scenes in space, `size` pixels wide, 16 or more; MuJoCo is imported when it is opened."""
    forget_missing_backend()
    from esp_envs.epuck.view import SpacePainter  # noqa: PLC0415 - imports MuJoCo

    painter = SpacePainter(size)
    choose_library()
    try:
        yield painter
    finally:
        painter.close()


def choose_library() -> None:
    """Let `mujoco.Renderer` draw with the first library that can; NoGraphicsError where none can."""
    wished = os.environ.get("MUJOCO_GL", os.environ.get("PYOPENGL_PLATFORM", "")).strip().lower()
    reasons: list[str] = []
    for backend in sorted(_LIBRARIES, key=lambda name: name != wished):
        reason = _MISSING
        if is_installed(backend):
            try:
                _draw_with(backend)
                return
            except Exception as error:  # drivers fail in ways of their own
                reason = " ".join(f"{error}".split()) or type(error).__name__
        reasons.append(f"{backend}: {reason}")
    advice = f"; {_ADVICE}" if any(reason.endswith(_MISSING) for reason in reasons) else ""
    raise NoGraphicsError(f"nothing here can draw a view in space ({'; '.join(reasons)}){advice}")


def _draw_with(backend: str) -> None:
    mujoco = import_module("mujoco")
    chosen = import_module(mujoco.Renderer.__module__).gl_context  # by default what MUJOCO_GL named at the import
    chosen.GLContext = import_module(f"mujoco.{backend}").GLContext
    mujoco.Renderer(mujoco.MjSpec().compile(), 16, 16).close()
