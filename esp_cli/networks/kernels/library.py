"""Kernels, compiled for the processor at hand and loaded."""

from __future__ import annotations

import atexit
import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from esp_envs.errors import UserError

if TYPE_CHECKING:  # a kernel may be begun before torch is imported
    from torch import Tensor

_OPTIONS = ("-O2", "-march=native", "-ffp-contract=fast", "-fopenmp", "-fPIC", "-shared", "-std=gnu++17")

PADDING = 16  # PAD of vectors.h
WORTH_COMPILING = 100_000  # steps per seed from which kernels save more seconds than they take to compile

_folders: set[str] = set()  # of kernels that were begun and are not loaded


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
    """Load a kernel, which takes up to a second to compile where nothing began it before."""
    try:
        folder = begin(name).result()
        try:
            return ctypes.CDLL(f"{folder}/{name}")  # after torch, whose OpenMP it takes
        finally:
            _remove(folder)
    except (ValueError, OSError) as error:
        begin.cache_clear()  # so that it may be tried again
        if isinstance(error, ValueError):
            raise
        raise UserError(
            f"the kernels of network.compiled cannot be loaded ({error}); set TMPDIR to a folder that programs "
            "may run from, or leave it off"
        ) from None


@cache
def begin(name: str) -> Future[str]:
    """Begin to compile a kernel, beside whatever else there is to do, in a temporary folder."""
    workers = ThreadPoolExecutor(1)
    compiling = workers.submit(_compile, name)
    workers.shutdown(wait=False)
    return compiling


def has_compiler() -> bool:
    """Return whether there is a C++ compiler: that of the environment variable CXX, or one on the path."""
    try:
        return shutil.which(_compiler()[0]) is not None
    except UserError:
        return False


def _compiler() -> list[str]:
    """Return the command of the compiler; its program may not exist."""
    try:
        named = shlex.split(os.environ.get("CXX", ""))
    except ValueError as error:
        raise UserError(f"the environment variable CXX is no command ({error}); name a C++ compiler in it") from None
    return named or [next(filter(shutil.which, ("c++", "g++", "clang++")), "")]


def _compile(name: str) -> str:
    compiler = _compiler()
    if shutil.which(compiler[0]) is None:
        raise UserError("network.compiled needs a C++ compiler; install one (g++ or clang++), or leave it off")
    folder = tempfile.mkdtemp()
    _folders.add(folder)
    built, log = Path(folder) / name, Path(folder) / "log"
    command = [*compiler, *_OPTIONS, str(Path(__file__).with_name(f"{name}.cpp")), "-o", str(built)]
    with log.open("wb") as said:  # not a pipe, which a process forked meanwhile would hold open
        failed = subprocess.run(command, check=False, stderr=said).returncode
    if failed:
        lines = log.read_text(errors="replace").strip().splitlines() or ["it says nothing"]
        line = next((line for line in lines if "error" in line), lines[-1])
        _remove(folder)
        raise UserError(f"{compiler[0]} does not compile the kernels of network.compiled: {line}")
    return folder


def _remove(folder: str) -> None:
    _folders.discard(folder)
    shutil.rmtree(folder, ignore_errors=True)


@atexit.register
def _remove_all() -> None:
    for folder in list(_folders):
        _remove(folder)


def _forget() -> None:
    """Leave what a parent process began to the parent: its thread would never end it here, and its folders stay."""
    begin.cache_clear()
    _folders.clear()


os.register_at_fork(after_in_child=_forget)


def call(kernel: str, function: str, *arguments: ctypes.Structure | ctypes.Array[Any] | Tensor | None) -> None:
    """Call a function of a kernel with addresses: of structures, of tensors' first numbers, or of nothing."""
    structures = (ctypes.Structure, ctypes.Array)
    addresses = [
        ctypes.byref(x) if isinstance(x, structures) else ctypes.c_void_p(None if x is None else x.data_ptr())
        for x in arguments
    ]
    getattr(library(kernel), function)(*addresses)
