"""The kernels, compiled for the processor at hand and loaded."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from torch import Tensor

_SOURCES = sorted(Path(__file__).parent.glob("*.cpp"))
_OPTIONS = ("-O3", "-march=native", "-ffp-contract=fast", "-fopenmp", "-fPIC", "-std=gnu++17")
_ARGUMENTS = {
    "forward": 2,
    "backward": 4,
    "gru_forward": 1,
    "gru_backward": 5,
    "mix_forward": 2,
    "mix_backward": 4,
    "policy_gradient": 1,
}

PADDING = 16
"""PAD of vectors.h."""


def padded(width: int) -> int:
    """Return a width filled up to a multiple of PADDING."""
    return -(-width // PADDING) * PADDING


def fields(kind: type, *names: str) -> list[tuple[str, type]]:
    """Return fields of a structure that are all of one kind."""
    return [(name, kind) for name in names]


def computes(compiled: bool, x: Tensor) -> bool:
    """Return whether kernels compute what begins with x, where they are chosen: on the CPU."""
    return compiled and x.device.type == "cpu"


@cache
def library() -> ctypes.CDLL:
    """Compile the kernels, which takes two seconds, in a temporary folder, and load them.

    Raises:
        ValueError: there is no C++ compiler, it fails, or what it made cannot be loaded.
    """
    compiler = shlex.split(os.environ.get("CXX", "")) or [next(filter(shutil.which, ("c++", "g++", "clang++")), "")]
    if shutil.which(compiler[0]) is None:
        raise ValueError("network.compiled needs a C++ compiler; install one (g++ or clang++), or leave it off")
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "kernels.so"
        objects = [str(built.with_name(f"{source.stem}.o")) for source in _SOURCES]
        each = [("-c", str(source), "-o", to) for source, to in zip(_SOURCES, objects, strict=True)]
        _run(*([*compiler, *_OPTIONS, *options] for options in each))
        _run([*compiler, *_OPTIONS, "-shared", *objects, "-o", str(built)])
        try:
            loaded = ctypes.CDLL(str(built))
        except OSError as error:
            raise ValueError(
                f"the kernels of network.compiled cannot be loaded ({error}); set TMPDIR to a folder that programs "
                "may run from, or leave it off"
            ) from None
    for name, count in _ARGUMENTS.items():
        getattr(loaded, name).argtypes = (ctypes.c_void_p,) * count  # else addresses would be cut to 32 bits
    return loaded


def _run(*commands: Sequence[str]) -> None:
    """Run commands of the compiler side by side.

    Raises:
        ValueError: one fails.
    """
    running = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for command in commands]
    errors = [process.communicate()[1] for process in running]
    for command, process, said in zip(commands, running, errors, strict=True):
        if process.returncode:
            line = next((line for line in said.splitlines() if "error" in line), said.strip())
            raise ValueError(f"{command[0]} does not compile the kernels of network.compiled: {line}")
