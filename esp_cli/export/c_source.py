"""A program as C99: float32, no allocation, no library but libm; weights in constant arrays, scratch in static ones.

The functions of the layers are in runtime/layers.c, of which a source has those that it calls.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from esp_cli.export import layers
from esp_cli.export.layers import Program
from esp_cli.export.templates import RUNTIME, filled
from esp_envs.errors import UserError

_LAYERS: dict[type[layers.Layer], str] = {
    layers.Affine: "EACH affine(w{k}_0, w{k}_1, {0.inputs}, {0.outputs}, X, Y);\nSWAP;",
    layers.Activation: "EACH apply_{0.kind}(X, {0.width});",
    layers.Norm: "EACH normalise(w{k}_0, w{k}_1, {0.outputs}, X);",
    layers.Recurrent: """
        affine(w{k}_0, w{k}_1, {0.input.inputs}, 3 * {0.hidden}, x, into);
        affine(w{k}_2, w{k}_3, {0.hidden}, 3 * {0.hidden}, memory, back);
        recur({0.hidden}, into, back, memory);
        memcpy(x, memory, sizeof(float) * {0.hidden});""",
    layers.Slice: "EACH memmove(X, X + {0.begin}, sizeof(float) * ({0.end} - {0.begin}));",
    layers.Convolution: """
        EACH convolve(w{k}_0, w{k}_1, {0.channels}, {0.rows}, {0.columns}, {0.side}, {0.stride}, {0.outputs}, X, Y);
        SWAP;""",
    layers.GlobalMaxPool: "EACH global_max_pool({0.channels}, {0.places}, X, Y);\nSWAP;",
    layers.MessageAggregation: """
        aggregate(observation + {0.begin}, {0.width}, {reach_squared}, {reach}, x, y);
        SWAP;""",
}
"""The statements of a layer, in the macros of `templates/policy.c.jinja`."""


@dataclass(frozen=True)
class Cost:
    """The memory that a program in C needs on a microcontroller.

    Attributes:
        flash_bytes: of the weights; the code comes on top (about 1 kB without libm).
        ram_bytes: of the scratch and of one agent's memory; the stack needs some 100 more.
    """

    flash_bytes: int
    ram_bytes: int


def cost(program: Program) -> Cost:
    """Return what a program in C needs."""
    scratch = 2 * program.team * _row_width(program) + 6 * program.hidden
    return Cost(len(program.weights), 4 * (scratch + program.memory_width))


def c_source(program: Program, comment: str) -> dict[str, bytes]:
    """Write a program as a header and a source.

    Args:
        program: the policy.
        comment: what it is, line by line; stands at the top of the header.

    Raises:
        UserError: agents that exchange messages and have continuous actions.
    """
    if program.team > 1 and program.head != "choose":
        raise UserError(
            "C export of agents that exchange messages supports discrete actions only; use onnx, torch or numpy"
        )
    body = _body(program)
    variables = ["i", *(name for name in ("k", "best") if re.search(rf"\b{name} = ", body))]
    values = {
        **_shape(program),
        "comment": "\n".join(f" * {line}".rstrip() for line in _plain(comment).splitlines()),
        "act": _signature(program),
        "outputs": f"const float *esp_policy_outputs({'int agent' if program.team > 1 else 'void'})",
        "arrays": [
            (f"w{k}_{i}", array.size, numbers(array.ravel().tolist()))
            for k, layer in enumerate(program.layers)
            for i, array in enumerate(layer.arrays)
        ],
        "row": _row_width(program),
        "functions": "\n".join(_functions(body)),
        "variables": ", ".join(variables),
        "body": body,
    }
    return {name: filled(name, **values) for name in ("policy.h", "policy.c")}


def example_source(program: Program, observation: list[float], action: list[float], allowed: list[bool]) -> bytes:
    """Return a program that acts on the worked example and says whether the action is the right one.

    Args:
        program: the policy.
        observation: of the example; of a team all of them.
        action: that it should take.
        allowed: actions of the example; empty where there are no masks.
    """
    choose = program.head == "choose"
    return filled(
        "policy_example.c",
        **_shape(program),
        kind="int" if choose else "float",
        count=len(action),
        observation=numbers(observation),
        expected=", ".join(str(int(x)) if choose else literal(x) for x in action),
        allowed=", ".join(str(int(flag)) for flag in allowed),
        given=", ".join(["observation", *["allowed"] * program.masked, *["memory"] * (program.memory_width > 0)]),
    )


def _shape(program: Program) -> dict[str, object]:
    names = ("num_inputs", "num_outputs", "hidden", "memory_width", "head", "team", "masked")
    return {name: getattr(program, name) for name in names}


def _plain(comment: str) -> str:
    """Return text that ends no comment in C."""
    return comment.replace("*/", "* /").replace("/*", "/ *")


def literal(value: float) -> str:
    """Return a float32 in full: nine digits tell every one apart."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


def numbers(values: Iterable[float]) -> str:
    """Return the items of an array, eight a line."""
    literals = [literal(value) for value in values]
    return "".join(f"    {', '.join(literals[k : k + 8])},\n" for k in range(0, len(literals), 8))


def _row_width(program: Program) -> int:
    """Return the width of the two rows, an agent each, that layers read and write in turn."""
    widths = [program.num_inputs + program.previous, program.num_outputs, program.hidden]
    for layer in program.layers:
        if isinstance(layer, layers.Affine):
            widths += [layer.inputs, layer.outputs]
        elif isinstance(layer, layers.Convolution):
            widths.append(layer.width)
    return max(widths)


def _signature(program: Program) -> str:
    """Return the declaration of the function that acts, without a semicolon."""
    agents = "ESP_POLICY_AGENTS * " if program.team > 1 else ""
    parameters = [f"const float observation[{agents}ESP_POLICY_OBSERVATION]"]
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
    """Write the statements of the function that acts."""
    lines = ["EACH memcpy(X, observation + i * ESP_POLICY_OBSERVATION, sizeof(float) * ESP_POLICY_OBSERVATION);"]
    if program.previous:
        copied = f"memory + {program.hidden}, sizeof(float) * {program.previous}"
        lines.append(f"memcpy(x + ESP_POLICY_OBSERVATION, {copied});")
    for k, layer in enumerate(program.layers):
        reach = {name: literal(getattr(layer, name, 0.0)) for name in ("reach", "reach_squared")}
        lines += _LAYERS[type(layer)].format(layer, k=k, **reach).splitlines()
    lines.append("last = x;")
    if program.team > 1:
        call = "choose_allowed(X, allowed + i * ESP_POLICY_ACTION)" if program.masked else "choose(X)"
        lines.append(f"EACH action[i] = {call};")
    elif program.head == "choose":
        lines.append(f"best = {'choose_allowed(x, allowed)' if program.masked else 'choose(x)'};")
    else:
        lines += _squash(program.groups)
    if program.previous:
        value = "action[k]" if program.head == "squash" else "k == best ? 1.0f : 0.0f"
        lines.append(f"for (k = 0; k < ESP_POLICY_ACTION; k++) memory[{program.hidden} + k] = {value};")
    lines += ["return best;"] if program.head == "choose" and program.team == 1 else []
    return "\n".join(f"    {line.strip()}" for line in lines if line.strip())


def _squash(groups: Iterable[int]) -> list[str]:
    lines, start = [], 0
    for width in groups:
        squares = " + ".join(f"x[{i}] * x[{i}]" for i in range(start, start + width))
        lines.append(f"length = sqrtf({squares} + {literal(layers.SQUASH_EPSILON)});")
        lines.append(f"for (k = {start}; k < {start + width}; k++) action[k] = x[k] * (tanhf(length) / length);")
        start += width
    return lines
