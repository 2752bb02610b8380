"""The kernels, compiled for the processor at hand and loaded."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

_SOURCES = sorted(Path(__file__).parent.glob("*.cpp"))
_OPTIONS = ("-O3", "-march=native", "-ffp-contract=fast", "-fopenmp", "-shared", "-fPIC", "-std=gnu++17")
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


@cache
def library() -> ctypes.CDLL:
    """Compile the kernels, which takes three seconds, in a temporary folder, and load them.

    Raises:
        ValueError: there is no C++ compiler, it fails, or what it made cannot be loaded.
    """
    compiler = shlex.split(os.environ.get("CXX", "")) or [next(filter(shutil.which, ("c++", "g++", "clang++")), "")]
    if shutil.which(compiler[0]) is None:
        raise ValueError("network.compiled needs a C++ compiler; install one (g++ or clang++), or leave it off")
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "kernel.so"
        command = [*compiler, *_OPTIONS, *map(str, _SOURCES), "-o", str(built)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            said = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip())
            raise ValueError(f"{shlex.join(compiler)} does not compile the kernels of network.compiled: {said}")
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
