"""A program as C99: float32, no allocation, no library but libm; weights in constant arrays, scratch in static ones.

The functions of the layers are in layers.c, of which a source has those that it calls.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from esp_cli.export.check import Numbers, Runner, Sample
from esp_cli.export.program import Program
from esp_cli.export.sets import named
from esp_cli.export.templates import RUNTIME, filled

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
"""The source compiles without warnings under these."""


def c_source(program: Program, comment: str) -> dict[str, bytes]:
    """Write a program as a source and a header that begins with a comment."""
    values = {
        "program": program,
        "returns": _returns(program),
        "comment": comment.replace("*/", "* /").replace("/*", "/ *").splitlines(),
        "sets": named(name for name, _ in program.sets).values(),
        "layers": [re.sub(r"\bw(\d+)\b", rf"w{k}_\1", layer.c) for k, layer in enumerate(program.layers)],
        "widths": [
            *(program.num_inputs + program.previous, program.num_outputs, program.hidden),
            *(layer.width for layer in program.layers),
        ],
        "numbers": numbers,
        "functions": _functions,
    }
    return {name: filled(name, **values) for name in ("policy.h", "policy.c")}


def example_source(program: Program, example: dict[str, Any]) -> bytes:
    """Return a program that acts on the worked example, and says whether it acts as it should."""
    sets = {name: example["sets"][given] for given, name in named(example.get("sets", ())).items()}
    allowed = np.ravel(example.get("action_mask", ())).astype(int).tolist()
    given = {"program": program, "returns": _returns(program), "example": example, "sets": sets, "allowed": allowed}
    return filled("policy_example.c", **given, numbers=numbers)


def of_role(source: bytes, role: str | None) -> bytes:
    """Return a source whose names have that of a role, so that one program may have the policies of all roles."""
    name = re.sub(r"\W", "_", role or "policy", flags=re.ASCII)
    return source.replace(b"esp_policy", f"esp_{name}".encode()).replace(b"ESP_POLICY", f"ESP_{name}".upper().encode())


def _returns(program: Program) -> bool:
    """Whether the function that acts returns the action, a single choice; else it writes it."""
    return program.head == "choose" and program.team == 1


def numbers(values: Any) -> str:
    """Return the items of an array, eight a line."""
    literals = [literal(value) for value in np.ravel(values).tolist()]
    return "".join(f"    {', '.join(literals[k : k + 8])},\n" for k in range(0, len(literals), 8))


def literal(value: float) -> str:
    """Return a float32 in C in full: nine digits tell every one apart."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def _functions(code: str) -> str:
    """Return the functions of layers.c that a piece of code calls, and those that they call."""
    called: list[str] = []
    for function in reversed((RUNTIME / "layers.c").read_text().split("}\n\n")):
        name = re.findall(r"(\w+)\(", function)[0]
        if any(re.search(rf"\b{name}\(", text) for text in (code, *called)):
            called.insert(0, function.rstrip().removesuffix("\n}") + "\n}\n")
    return "\n".join(called)


def compiler() -> str | None:
    """Return this machine's C compiler, or None."""
    return shutil.which("cc")


def _compiled(made: Path, *arguments: str | Path) -> Path:
    """Compile written C sources, with every warning an error."""
    command = ["cc", *FLAGS, *map(str, arguments), "-o", str(made), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"the exported C does not compile; this is a bug\n{result.stderr}")
    return made


def c_runner(file: Path, program: Program) -> Runner:
    """Compile a written C source and call it row by row, or of a team world by world."""
    code = ctypes.CDLL(str(_compiled(file.with_suffix(".so"), "-shared", "-fPIC", file)))
    returns, team, width = _returns(program), program.team, program.num_outputs
    name = re.findall(r"(\w+)_act\(const", file.with_suffix(".h").read_text())[0]
    act, outputs_of = code[f"{name}_act"], code[f"{name}_outputs"]
    act.restype, outputs_of.restype = ctypes.c_int if returns else None, ctypes.POINTER(ctypes.c_float)

    def run(sample: Sample) -> tuple[Numbers, Numbers, Numbers]:
        obs, after = np.ascontiguousarray(sample.obs), sample.memory.copy()
        outputs = np.empty((len(obs), width), np.float32)
        action: Numbers = np.empty(len(obs), np.intc) if program.head == "choose" else np.empty_like(outputs)
        tables = [np.ascontiguousarray(table) for table in sample.sets.values()]
        arrays: list[Numbers] = [] if sample.mask is None else [sample.mask.astype(np.uint8)]
        arrays += [after] * (program.memory_width > 0) + [action] * (not returns)
        for k in range(0, len(obs), team):
            given = [part for table in tables for part in (table[k:].ctypes, table.shape[1])]
            chosen = act(obs[k:].ctypes, *given, *(array[k:].ctypes for array in arrays))
            if returns:
                action[k] = chosen
            for i in range(team):
                outputs[k + i] = np.ctypeslib.as_array(outputs_of(*[i] * (team > 1)), (width,))
        return action, outputs, after

    return run


def example_runs(folder: Path) -> bool:
    """Compile and run the worked example of a C export; return whether it gives the expected action."""
    program = _compiled(folder / "example", folder / "policy_example.c", folder / "policy.c")
    return subprocess.run([str(program)], check=False, capture_output=True).returncode == 0
