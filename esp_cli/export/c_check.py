"""Compiling and running exported C, where this machine has a compiler."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np

from esp_cli.export.check import Numbers, Runner
from esp_cli.export.layers import Floats, Program

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
"""The source compiles without warnings under these."""


def compiler() -> str | None:
    """Return this machine's C compiler, or None."""
    return shutil.which("cc")


def compiled(*files: Path) -> ctypes.CDLL:
    """Compile written C sources into a library beside the first, with every warning an error.

    Raises:
        RuntimeError: they do not compile, which is a bug.
    """
    shared = files[0].with_suffix(".so")
    command = [compiler() or "cc", *FLAGS, "-shared", "-fPIC", *map(str, files), "-o", str(shared), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"the exported C does not compile; this is a bug\n{result.stderr}")
    return ctypes.CDLL(str(shared))


def c_runner(file: Path, program: Program) -> Runner:
    """Compile a written C source and call it row by row, or of a team world by world.

    Raises:
        RuntimeError: it does not compile, which is a bug.
    """
    code = compiled(file)
    floats = ctypes.POINTER(ctypes.c_float)
    choose, team, width = program.head == "choose", program.team, program.num_outputs
    code.esp_policy_outputs.restype = floats
    code.esp_policy_act.restype = ctypes.c_int if choose and team == 1 else None

    def run(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        obs, after = np.ascontiguousarray(obs), memory.copy()
        outputs = np.empty((len(obs), width), np.float32)
        action: Numbers = np.empty(len(obs), np.intc) if choose else np.empty_like(outputs)
        written = [after] * (program.memory_width > 0) + [action] * (not choose or team > 1)
        arrays = [obs, *([] if mask is None else [mask.astype(np.uint8)]), *written]
        for k in range(0, len(obs), team):
            chosen = code.esp_policy_act(*(ctypes.c_void_p(array[k:].ctypes.data) for array in arrays))
            if choose and team == 1:
                action[k] = chosen
            for i in range(team):
                agent = [i] if team > 1 else []
                outputs[k + i] = np.ctypeslib.as_array(code.esp_policy_outputs(*agent), (width,))
        return action, outputs, after

    return run


def example_runs(folder: Path) -> bool:
    """Compile and run the worked example of a C export; return whether it gives the expected action."""
    program = folder / "example"
    files = [str(folder / name) for name in ("policy_example.c", "policy.c")]
    subprocess.run([compiler() or "cc", *FLAGS, *files, "-o", str(program), "-lm"], check=True, capture_output=True)
    return subprocess.run([str(program)], check=False, capture_output=True).returncode == 0
