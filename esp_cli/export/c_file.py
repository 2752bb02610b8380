"""A program as C99: float32, no allocation, no library but libm; weights in constant arrays, scratch in static ones.

The functions of the layers are in layers.c, of which a source has those that it calls.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from esp_cli.export.check import Numbers, Runner
from esp_cli.export.layers import Floats, literal
from esp_cli.export.program import SQUASH_EPSILON, Program
from esp_cli.export.sets import named
from esp_cli.export.templates import RUNTIME, filled
from esp_envs.errors import UserError

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
"""The source compiles without warnings under these."""


def c_source(program: Program, comment: str) -> dict[str, bytes]:
    """Write a program as a source and a header that begins with a comment."""
    if program.team > 1 and program.head != "choose":
        raise UserError(
            "C export of agents that exchange messages supports discrete actions only; use onnx, torch or numpy"
        )
    body = _body(program)
    comment = comment.replace("*/", "* /").replace("/*", "/ *")
    values = {
        "program": program,
        "comment": "\n".join(f" * {line}".rstrip() for line in comment.splitlines()),
        "act": _signature(program),
        "outputs": f"const float *esp_policy_outputs({'int agent' if program.team > 1 else 'void'})",
        "arrays": [
            (f"w{k}_{i}", array.size, numbers(array.ravel().tolist()))
            for k, layer in enumerate(program.layers)
            for i, array in enumerate(layer.arrays)
        ],
        "row": _row_width(program),
        "functions": "\n".join(_functions(body)),
        "variables": ", ".join(["i", *(name for name in ("k", "best") if re.search(rf"\b{name} = ", body))]),
        "body": body,
    }
    return {name: filled(name, **values) for name in ("policy.h", "policy.c")}


def example_source(
    program: Program,
    sets: Mapping[str, Sequence[Sequence[float]]],
    observation: list[float],
    action: list[float],
    allowed: list[bool],
) -> bytes:
    """Return a program that acts on the worked example (of a team all rows), and says whether it acts as it should."""
    choose = program.head == "choose"
    tables = dict(zip(named([*sets]), sets.values(), strict=True))
    beside = [part for name, rows in tables.items() for part in (f"set_{name}", str(len(rows)))]
    return filled(
        "policy_example.c",
        program=program,
        kind="int" if choose else "float",
        count=len(action),
        observation=numbers(observation),
        expected=", ".join(str(int(x)) if choose else literal(x) for x in action),
        allowed=", ".join(str(int(flag)) for flag in allowed),
        sets=[(f"set_{name}", numbers(number for row in rows for number in row)) for name, rows in tables.items()],
        given=", ".join(
            ["observation", *beside, *["allowed"] * program.masked, *["memory"] * (program.memory_width > 0)]
        ),
    )


def numbers(values: Iterable[float]) -> str:
    """Return the items of an array, eight a line."""
    literals = [literal(value) for value in values]
    return "".join(f"    {', '.join(literals[k : k + 8])},\n" for k in range(0, len(literals), 8))


def _row_width(program: Program) -> int:
    """Return the width of the two rows, an agent each, that layers read and write in turn."""
    own = (program.num_inputs + program.previous, program.num_outputs, program.hidden)
    return max(*own, *(layer.width for layer in program.layers))


def _signature(program: Program) -> str:
    agents = "ESP_POLICY_AGENTS * " if program.team > 1 else ""
    parameters = [f"const float observation[{agents}ESP_POLICY_OBSERVATION]"]
    for name in named([name for name, _ in program.sets]):
        parameters += [f"const float *set_{name}", f"int num_{name}"]
    parameters += [f"const unsigned char allowed[{agents}ESP_POLICY_ACTION]"] if program.masked else []
    parameters += ["float memory[ESP_POLICY_MEMORY]"] if program.memory_width else []
    parameters += ["float action[ESP_POLICY_ACTION]"] if program.head == "squash" else []
    parameters += ["int action[ESP_POLICY_AGENTS]"] if program.team > 1 else []
    returned = "int" if program.head == "choose" and program.team == 1 else "void"
    return f"{returned} esp_policy_act({', '.join(parameters)})"


def _functions(code: str) -> list[str]:
    """Return the functions of layers.c that a piece of code calls, and those that they call."""
    called: list[str] = []
    for function in reversed((RUNTIME / "layers.c").read_text().split("}\n\n")):
        name = re.findall(r"(\w+)\(", function)[0]
        if any(re.search(rf"\b{name}\(", text) for text in (code, *called)):
            called.insert(0, function.rstrip().removesuffix("\n}") + "\n}\n")
    return called


def _body(program: Program) -> str:
    lines = ["EACH memcpy(X, observation + i * ESP_POLICY_OBSERVATION, sizeof(float) * ESP_POLICY_OBSERVATION);"]
    if program.previous:
        copied = f"memory + {program.hidden}, sizeof(float) * {program.previous}"
        lines.append(f"memcpy(x + ESP_POLICY_OBSERVATION, {copied});")
    for k, layer in enumerate(program.layers):
        lines += re.sub(r"\bw(\d+)\b", rf"w{k}_\1", layer.c).splitlines()
    lines.append("last = x;")
    if program.team > 1:
        call = "choose_allowed(X, allowed + i * ESP_POLICY_ACTION)" if program.masked else "choose(X)"
        lines.append(f"EACH action[i] = {call};")
    elif program.head == "choose":
        lines.append(f"best = {'choose_allowed(x, allowed)' if program.masked else 'choose(x)'};")
    start = 0
    for width in program.groups:
        squares = " + ".join(f"x[{i}] * x[{i}]" for i in range(start, start + width))
        lines.append(f"length = sqrtf({squares} + {literal(SQUASH_EPSILON)});")
        lines.append(f"for (k = {start}; k < {start + width}; k++) action[k] = x[k] * (tanhf(length) / length);")
        start += width
    if program.previous:
        value = "action[k]" if program.head == "squash" else "k == best ? 1.0f : 0.0f"
        lines.append(f"for (k = 0; k < ESP_POLICY_ACTION; k++) memory[{program.hidden} + k] = {value};")
    lines += ["return best;"] if program.head == "choose" and program.team == 1 else []
    return "\n".join(f"    {line.strip()}" for line in lines if line.strip())


def compiler() -> str | None:
    """Return this machine's C compiler, or None."""
    return shutil.which("cc")


def compiled(*files: Path) -> ctypes.CDLL:
    """Compile written C sources into a library beside the first, with every warning an error."""
    shared = files[0].with_suffix(".so")
    command = [compiler() or "cc", *FLAGS, "-shared", "-fPIC", *map(str, files), "-o", str(shared), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"the exported C does not compile; this is a bug\n{result.stderr}")
    return ctypes.CDLL(str(shared))


def c_runner(file: Path, program: Program) -> Runner:
    """Compile a written C source and call it row by row, or of a team world by world."""
    code = compiled(file)
    choose, team, width = program.head == "choose", program.team, program.num_outputs
    code.esp_policy_outputs.restype = ctypes.POINTER(ctypes.c_float)
    code.esp_policy_act.restype = ctypes.c_int if choose and team == 1 else None

    def run(
        obs: Floats, memory: Floats, mask: Numbers | None = None, sets: dict[str, Floats] | None = None
    ) -> tuple[Numbers, Numbers, Numbers]:
        obs, after = np.ascontiguousarray(obs), memory.copy()
        outputs = np.empty((len(obs), width), np.float32)
        action: Numbers = np.empty(len(obs), np.intc) if choose else np.empty_like(outputs)
        written = [after] * (program.memory_width > 0) + [action] * (not choose or team > 1)
        tables = [np.ascontiguousarray(table) for table in (sets or {}).values()]
        arrays: list[Numbers] = [*([] if mask is None else [mask.astype(np.uint8)]), *written]
        for k in range(0, len(obs), team):
            given = [part for table in tables for part in (_address(table, k), table.shape[1])]
            chosen = code.esp_policy_act(_address(obs, k), *given, *(_address(array, k) for array in arrays))
            if choose and team == 1:
                action[k] = chosen
            for i in range(team):
                agent = [i] if team > 1 else []
                outputs[k + i] = np.ctypeslib.as_array(code.esp_policy_outputs(*agent), (width,))
        return action, outputs, after

    return run


def _address(array: Numbers, row: int) -> ctypes.c_void_p:
    return ctypes.c_void_p(array[row:].ctypes.data)


def example_runs(folder: Path) -> bool:
    """Compile and run the worked example of a C export; return whether it gives the expected action."""
    program = folder / "example"
    files = [str(folder / name) for name in ("policy_example.c", "policy.c")]
    subprocess.run([compiler() or "cc", *FLAGS, *files, "-o", str(program), "-lm"], check=True, capture_output=True)
    return subprocess.run([str(program)], check=False, capture_output=True).returncode == 0
