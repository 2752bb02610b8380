"""Kernels, compiled for the processor at hand and loaded."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from torch import Tensor

_OPTIONS = ("-O2", "-march=native", "-ffp-contract=fast", "-fopenmp", "-fPIC", "-shared", "-std=gnu++17")

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
def library(name: str) -> ctypes.CDLL:
    """Compile a kernel, which takes up to a second, in a temporary folder, and load it.

    Raises:
        ValueError: there is no C++ compiler, it fails, or what it made cannot be loaded.
    """
    compiler = shlex.split(os.environ.get("CXX", "")) or [next(filter(shutil.which, ("c++", "g++", "clang++")), "")]
    if shutil.which(compiler[0]) is None:
        raise ValueError("network.compiled needs a C++ compiler; install one (g++ or clang++), or leave it off")
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / f"{name}.so"
        command = [*compiler, *_OPTIONS, str(Path(__file__).with_name(f"{name}.cpp")), "-o", str(built)]
        compiling = subprocess.run(command, check=False, stderr=subprocess.PIPE, text=True)
        if compiling.returncode:
            said = compiling.stderr
            line = next((line for line in said.splitlines() if "error" in line), said.strip())
            raise ValueError(f"{compiler[0]} does not compile the kernels of network.compiled: {line}")
        try:
            loaded = ctypes.CDLL(str(built))
        except OSError as error:
            raise ValueError(
                f"the kernels of network.compiled cannot be loaded ({error}); set TMPDIR to a folder that programs "
                "may run from, or leave it off"
            ) from None
    return loaded


def call(kernel: str, function: str, *arguments: ctypes.Structure | ctypes.Array[Any] | Tensor | None) -> None:
    """Call a function of a kernel with addresses: of structures, of tensors' first numbers, or of nothing."""
    addresses = [ctypes.c_void_p(x.data_ptr()) if isinstance(x, Tensor) else x and ctypes.byref(x) for x in arguments]
    getattr(library(kernel), function)(*addresses)
