"""A program as C99: float32, no allocation, no library but libm; weights in constant arrays, scratch in static ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from esp_cli.deploy import c_parts
from esp_cli.deploy.program import (
    NORM_EPSILON,
    SQUASH_EPSILON,
    Activation,
    Affine,
    Convolution,
    Cut,
    Floats,
    Hear,
    Largest,
    Layer,
    Norm,
    Program,
    Recurrent,
)

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
"""With which the source compiles without a word."""


@dataclass(frozen=True)
class CSource:
    """The two files, and what they take of a microcontroller.

    Attributes:
        flash_bytes: of the weights; the code comes on top (about 1 kB without libm).
        ram_bytes: of the scratch and of one agent's memory; the stack needs some 100 more.
    """

    header: str
    source: str
    flash_bytes: int
    ram_bytes: int


def c_source(program: Program, comment: str) -> CSource:
    """Write a program as a header and a source.

    Args:
        program: the policy.
        comment: what it is, line by line; stands at the top of the header.

    Raises:
        ValueError: agents that hear each other, and whose actions are no choices.
    """
    if program.team > 1 and program.head != "choose":
        raise ValueError("of agents that hear each other, only choices are written as C; use onnx, torch or numpy")
    scratch = _Scratch(program)
    return CSource(
        header=_header(program, comment),
        source=_source(program, scratch),
        flash_bytes=len(program.weights),
        ram_bytes=4 * (scratch.total + program.memory_width),
    )


@dataclass(frozen=True)
class _Scratch:
    """Static arrays: two rows an agent that layers read and write in turn, both projections of a recurrent unit."""

    program: Program

    @property
    def row(self) -> int:
        widths = [self.program.num_inputs + self.program.previous, self.program.num_outputs, self.program.hidden]
        widths += [layer.weight.shape[1] for layer in self.program.layers if isinstance(layer, Affine)]
        widths += [layer.weight.shape[0] for layer in self.program.layers if isinstance(layer, Affine)]
        widths += [layer.width for layer in self.program.layers if isinstance(layer, Convolution)]
        return max(widths)

    @property
    def total(self) -> int:
        return 2 * self.program.team * self.row + 6 * self.program.hidden


def example_source(program: Program, observation: Iterable[float], action: Iterable[float]) -> str:
    """Return a program that acts on the worked example and says whether the action is the right one."""
    choose, remembers, team = program.head == "choose", program.memory_width > 0, program.team > 1
    memory = "    float memory[ESP_POLICY_MEMORY];\n" if remembers else ""
    reset = "    esp_policy_reset(memory);\n" if remembers else ""
    given = "observation, memory" if remembers else "observation"
    head = f"""/* Acts on the worked example: cc policy_example.c policy.c -lm && ./a.out */
#include "policy.h"

#include <math.h>
#include <stdio.h>

int main(void)
{{
    const float observation[{_seen(program)}] = {{
{_numbers(observation)}    }};
"""
    if team:
        indices = ", ".join(str(int(index)) for index in action)
        return f"""{head}    const int expected[ESP_POLICY_AGENTS] = {{{indices}}};
    int action[ESP_POLICY_AGENTS];
    int i, wrong = 0;

    esp_policy_act(observation, action);
    for (i = 0; i < ESP_POLICY_AGENTS; i++) {{
        printf("action %d, expected %d\\n", action[i], expected[i]);
        wrong |= action[i] != expected[i];
    }}
    return wrong;
}}
"""
    if choose:
        (index,) = action
        return f"""{head}    const int expected = {int(index)};
{memory}    int action;

{reset}    action = esp_policy_act({given});
    printf("action %d, expected %d\\n", action, expected);
    return action == expected ? 0 : 1;
}}
"""
    return f"""{head}    const float expected[ESP_POLICY_ACTION] = {{
{_numbers(action)}    }};
{memory}    float action[ESP_POLICY_ACTION];
    int k, wrong = 0;

{reset}    esp_policy_act({given}, action);
    for (k = 0; k < ESP_POLICY_ACTION; k++) {{
        printf("action %.6f, expected %.6f\\n", (double)action[k], (double)expected[k]);
        wrong |= fabsf(action[k] - expected[k]) > 1e-4f;
    }}
    return wrong;
}}
"""


def _seen(program: Program) -> str:
    """Return how many numbers one call looks at."""
    return "ESP_POLICY_AGENTS * ESP_POLICY_OBSERVATION" if program.team > 1 else "ESP_POLICY_OBSERVATION"


def _signature(program: Program) -> str:
    parameters = [f"const float observation[{_seen(program)}]"]
    if program.team > 1:
        return f"void esp_policy_act({parameters[0]}, int action[ESP_POLICY_AGENTS])"
    parameters += ["float memory[ESP_POLICY_MEMORY]"] if program.memory_width else []
    parameters += ["float action[ESP_POLICY_ACTION]"] if program.head == "squash" else []
    return f"{'int' if program.head == 'choose' else 'void'} esp_policy_act({', '.join(parameters)})"


def _header(program: Program, comment: str) -> str:
    told = "\n".join(f" * {line}".rstrip() for line in comment.replace("*/", "* /").splitlines())
    if program.team > 1:
        returns = "Writes the index of each agent's best action; the observations stand side by side."
    elif program.head == "choose":
        returns = "Returns the index of the best action."
    else:
        returns = "Writes the action, within its bounds."
    agents = f"#define ESP_POLICY_AGENTS {program.team}\n" if program.team > 1 else ""
    memory = (
        f"#define ESP_POLICY_MEMORY {program.memory_width}\n\n"
        "/* Begins an episode of one agent, whose memory the caller keeps. */\n"
        "void esp_policy_reset(float memory[ESP_POLICY_MEMORY]);\n"
        if program.memory_width
        else ""
    )
    return f"""/*
{told}
 */
#ifndef ESP_POLICY_H
#define ESP_POLICY_H

#ifdef __cplusplus
extern "C" {{
#endif

{agents}#define ESP_POLICY_OBSERVATION {program.num_inputs}
#define ESP_POLICY_ACTION {program.num_outputs}
{memory}
/* {returns} Not reentrant: the scratch is static. */
{_signature(program)};

/* What the last layer said in the last call: logits, values or the action before its bounds. */
{_outputs(program)};

#ifdef __cplusplus
}}
#endif

#endif
"""


def _outputs(program: Program) -> str:
    return f"const float *esp_policy_outputs({'int agent' if program.team > 1 else 'void'})"


def _source(program: Program, scratch: _Scratch) -> str:
    kinds = {type(layer) for layer in program.layers}
    names = {layer.name for layer in program.layers if isinstance(layer, Activation)}
    parts = ['#include "policy.h"\n\n#include <math.h>\n#include <string.h>\n']
    parts += [_array(f"w{k}_{i}", a) for k, layer in enumerate(program.layers) for i, a in enumerate(layer.arrays)]
    row = str(scratch.row)
    if program.team > 1:
        parts.append(f"#define ROW {row}")
        row = "ESP_POLICY_AGENTS * ROW"
    parts.append(f"static float row_a[{row}], row_b[{row}];")
    if program.hidden:
        parts.append(f"static float into[{3 * program.hidden}], back[{3 * program.hidden}];")
    parts.append("static const float *last = row_a;\n")
    parts.append(c_parts.AFFINE)
    parts += [c_parts.ACTIVATIONS[name] for name in sorted(names)]
    parts += [code for kind, code in _PARTS.items() if kind in kinds]
    parts += [_hear(layer) for layer in program.layers if isinstance(layer, Hear)][:1]
    parts += [c_parts.RECUR.replace("HIDDEN", str(program.hidden))] if program.hidden else []
    parts += [c_parts.CHOOSE] if program.head == "choose" else []
    parts.append(_act(program))
    parts.append(f"{_outputs(program)}\n{{\n    return last{' + agent * ROW' if program.team > 1 else ''};\n}}")
    if program.memory_width:
        parts.append(
            "void esp_policy_reset(float memory[ESP_POLICY_MEMORY])\n"
            "{\n    int k;\n    for (k = 0; k < ESP_POLICY_MEMORY; k++) memory[k] = 0.0f;\n}"
        )
    return "\n".join(parts) + "\n"


def _act(program: Program) -> str:
    """Write the function that acts: one line a layer."""
    row = _Row(program.team > 1)
    lines = [
        row.each(
            f"memcpy({row.here}, observation{' + i * ESP_POLICY_OBSERVATION' if row.team else ''}, "
            "sizeof(float) * ESP_POLICY_OBSERVATION);"
        )
    ]
    if program.previous:
        copied = f"memory + {program.hidden}, sizeof(float) * {program.previous}"
        lines.append(f"    memcpy(row_a + ESP_POLICY_OBSERVATION, {copied});")
    for k, layer in enumerate(program.layers):
        lines += _layer_lines(k, layer, row)
    lines.append(f"    last = {row.name};")
    if row.team:
        variables = "    int i;\n"
        lines.append(row.each(f"action[i] = choose({row.here});"))
    elif program.head == "choose":
        variables = "    int best;\n" if not program.previous else "    int k, best;\n"
        lines += _choose_lines(program, row.name)
    else:
        variables = "    int k;\n    float length;\n"
        lines += _squash_lines(program, row.name)
    return f"{_signature(program)}\n{{\n{variables}\n" + "\n".join(lines) + "\n}\n"


class _Row:
    """Which of the two rows holds what the layers have made so far; of a team each agent has its part of them."""

    def __init__(self, team: bool) -> None:
        self.team, self.name, self.other = team, "row_a", "row_b"

    @property
    def here(self) -> str:
        """Where one agent's part begins."""
        return f"{self.name} + i * ROW" if self.team else self.name

    @property
    def there(self) -> str:
        """Where the next layer may write."""
        return f"{self.other} + i * ROW" if self.team else self.other

    def each(self, statement: str) -> str:
        """Return a statement, done for every agent."""
        return f"    for (i = 0; i < ESP_POLICY_AGENTS; i++) {statement}" if self.team else f"    {statement}"

    def turn(self) -> None:
        """Go on with the other row, which has just been written."""
        self.name, self.other = self.other, self.name


def _layer_lines(k: int, layer: Layer, row: _Row) -> list[str]:
    if isinstance(layer, Activation):
        return [row.each(f"apply_{layer.name}({row.here}, {layer.width});")]
    if isinstance(layer, Norm):
        return [row.each(f"normalise(w{k}_0, w{k}_1, {layer.weight.size}, {row.here});")]
    if isinstance(layer, Recurrent):
        return _recur_lines(k, layer, row.name)
    if isinstance(layer, Cut):
        moved = f"memmove({row.here}, {row.here} + {layer.begin}, sizeof(float) * {layer.end - layer.begin});"
        return [row.each(moved)] if layer.begin else []
    if isinstance(layer, Hear):
        line = f"    hear(observation + {layer.begin}, {layer.width}, {row.name}, {row.other});"
    elif isinstance(layer, Affine):
        inputs, outputs = layer.weight.shape
        line = row.each(f"affine(w{k}_0, w{k}_1, {inputs}, {outputs}, {row.here}, {row.there});")
    elif isinstance(layer, Convolution):
        shape = f"{layer.channels}, {layer.rows}, {layer.columns}, {layer.side}, {layer.stride}, {layer.outputs}"
        line = row.each(f"convolve(w{k}_0, w{k}_1, {shape}, {row.here}, {row.there});")
    else:
        line = row.each(f"largest({layer.channels}, {layer.places}, {row.here}, {row.there});")
    row.turn()
    return [line]


def _recur_lines(k: int, layer: Recurrent, here: str) -> list[str]:
    inputs, wide = layer.input.weight.shape
    return [
        f"    affine(w{k}_0, w{k}_1, {inputs}, {wide}, {here}, into);",
        f"    affine(w{k}_2, w{k}_3, {layer.hidden}, {wide}, memory, back);",
        "    recur(memory);",
        f"    memcpy({here}, memory, sizeof(float) * {layer.hidden});",
    ]


def _choose_lines(program: Program, here: str) -> list[str]:
    lines = [f"    best = choose({here});"]
    if program.previous:
        lines.append(
            f"    for (k = 0; k < ESP_POLICY_ACTION; k++) memory[{program.hidden} + k] = k == best ? 1.0f : 0.0f;"
        )
    return [*lines, "    return best;"]


def _squash_lines(program: Program, here: str) -> list[str]:
    lines, place = [], 0
    for width in program.groups:
        squares = " + ".join(f"{here}[{i}] * {here}[{i}]" for i in range(place, place + width))
        lines.append(f"    length = sqrtf({squares} + {_literal(SQUASH_EPSILON)});")
        lines.append(
            f"    for (k = {place}; k < {place + width}; k++) action[k] = {here}[k] * (tanhf(length) / length);"
        )
        place += width
    if program.previous:
        lines.append(f"    for (k = 0; k < ESP_POLICY_ACTION; k++) memory[{program.hidden} + k] = action[k];")
    return lines


def _hear(layer: Hear) -> str:
    return c_parts.HEAR.replace("REACH_SQUARED", _literal(layer.reach_squared)).replace("REACH", _literal(layer.reach))


def _array(name: str, array: Floats) -> str:
    return f"static const float {name}[{array.size}] = {{\n{_numbers(array.ravel().tolist())}}};"


def _numbers(values: Iterable[float]) -> str:
    literals = [_literal(value) for value in values]
    return "".join(f"    {', '.join(literals[k : k + 8])},\n" for k in range(0, len(literals), 8))


def _literal(value: float) -> str:
    """Return a float32 in full: nine digits tell every one apart."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


_PARTS = {
    Norm: c_parts.NORM.replace("NORM_EPSILON", _literal(NORM_EPSILON)),
    Convolution: c_parts.CONVOLVE,
    Largest: c_parts.LARGEST,
}
"""Functions that stand in the source where there is such a layer."""
