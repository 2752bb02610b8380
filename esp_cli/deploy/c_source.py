"""A program as C99: float32, no allocation, no library but libm; weights in constant arrays, scratch in static ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from esp_cli.deploy.program import NORM_EPSILON, SQUASH_EPSILON, Activation, Affine, Floats, Norm, Program, Recurrent

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
    """
    scratch = _Scratch(program)
    return CSource(
        header=_header(program, comment),
        source=_source(program, scratch),
        flash_bytes=len(program.weights),
        ram_bytes=4 * (scratch.total + program.memory_width),
    )


@dataclass(frozen=True)
class _Scratch:
    """Static arrays: two rows that layers read and write in turn, and both projections of a recurrent unit."""

    program: Program

    @property
    def row(self) -> int:
        widths = [self.program.num_inputs + self.program.previous, self.program.num_outputs, self.program.hidden]
        widths += [layer.weight.shape[1] for layer in self.program.layers if isinstance(layer, Affine)]
        return max(widths)

    @property
    def total(self) -> int:
        return 2 * self.row + 6 * self.program.hidden


def example_source(program: Program, observation: Iterable[float], action: Iterable[float]) -> str:
    """Return a program that acts on the worked example and says whether the action is the right one."""
    choose, remembers = program.head == "choose", program.memory_width > 0
    memory = "    float memory[ESP_POLICY_MEMORY];\n" if remembers else ""
    reset = "    esp_policy_reset(memory);\n" if remembers else ""
    given = "observation, memory" if remembers else "observation"
    head = f"""/* Acts on the worked example: cc policy_example.c policy.c -lm && ./a.out */
#include "policy.h"

#include <math.h>
#include <stdio.h>

int main(void)
{{
    const float observation[ESP_POLICY_OBSERVATION] = {{
{_numbers(observation)}    }};
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


def _signature(program: Program) -> str:
    parameters = ["const float observation[ESP_POLICY_OBSERVATION]"]
    parameters += ["float memory[ESP_POLICY_MEMORY]"] if program.memory_width else []
    parameters += ["float action[ESP_POLICY_ACTION]"] if program.head == "squash" else []
    return f"{'int' if program.head == 'choose' else 'void'} esp_policy_act({', '.join(parameters)})"


def _header(program: Program, comment: str) -> str:
    told = "\n".join(f" * {line}".rstrip() for line in comment.replace("*/", "* /").splitlines())
    returns = (
        "Returns the index of the best action." if program.head == "choose" else "Writes the action, within its bounds."
    )
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

#define ESP_POLICY_OBSERVATION {program.num_inputs}
#define ESP_POLICY_ACTION {program.num_outputs}
{memory}
/* {returns} Not reentrant: the scratch is static. */
{_signature(program)};

/* What the last layer said in the last call: logits, values or the action before its bounds. */
const float *esp_policy_outputs(void);

#ifdef __cplusplus
}}
#endif

#endif
"""


def _source(program: Program, scratch: _Scratch) -> str:
    kinds = {type(layer) for layer in program.layers}
    names = {layer.name for layer in program.layers if isinstance(layer, Activation)}
    parts = ['#include "policy.h"\n\n#include <math.h>\n#include <string.h>\n']
    parts += [_array(f"w{k}_{i}", a) for k, layer in enumerate(program.layers) for i, a in enumerate(layer.arrays)]
    parts.append(f"static float row_a[{scratch.row}], row_b[{scratch.row}];")
    if program.hidden:
        parts.append(f"static float into[{3 * program.hidden}], back[{3 * program.hidden}];")
    parts.append("static const float *last = row_a;\n")
    parts.append(_AFFINE)
    parts += [_ACTIVATIONS[name] for name in sorted(names)]
    parts += [_NORM] if Norm in kinds else []
    parts += [_RECUR.replace("HIDDEN", str(program.hidden))] if program.hidden else []
    parts.append(_act(program))
    parts.append("const float *esp_policy_outputs(void)\n{\n    return last;\n}")
    if program.memory_width:
        parts.append(
            "void esp_policy_reset(float memory[ESP_POLICY_MEMORY])\n"
            "{\n    int k;\n    for (k = 0; k < ESP_POLICY_MEMORY; k++) memory[k] = 0.0f;\n}"
        )
    return "\n".join(parts) + "\n"


def _act(program: Program) -> str:
    """Write the function that acts: one line a layer."""
    lines = ["    memcpy(row_a, observation, sizeof(float) * ESP_POLICY_OBSERVATION);"]
    if program.previous:
        copied = f"memory + {program.hidden}, sizeof(float) * {program.previous}"
        lines.append(f"    memcpy(row_a + ESP_POLICY_OBSERVATION, {copied});")
    here, there = "row_a", "row_b"
    for k, layer in enumerate(program.layers):
        if isinstance(layer, Affine):
            inputs, outputs = layer.weight.shape
            lines.append(f"    affine(w{k}_0, w{k}_1, {inputs}, {outputs}, {here}, {there});")
            here, there = there, here
        elif isinstance(layer, Activation):
            lines.append(f"    apply_{layer.name}({here}, {layer.width});")
        elif isinstance(layer, Norm):
            lines.append(f"    normalise(w{k}_0, w{k}_1, {layer.weight.size}, {here});")
        else:
            lines += _recur_lines(k, layer, here)
    lines.append(f"    last = {here};")
    lines += _choose_lines(program, here) if program.head == "choose" else _squash_lines(program, here)
    variables = "    int k, best = 0;\n" if program.head == "choose" else "    int k;\n    float length;\n"
    return f"{_signature(program)}\n{{\n{variables}\n" + "\n".join(lines) + "\n}\n"


def _recur_lines(k: int, layer: Recurrent, here: str) -> list[str]:
    inputs, wide = layer.input.weight.shape
    return [
        f"    affine(w{k}_0, w{k}_1, {inputs}, {wide}, {here}, into);",
        f"    affine(w{k}_2, w{k}_3, {layer.hidden}, {wide}, memory, back);",
        "    recur(memory);",
        f"    memcpy({here}, memory, sizeof(float) * {layer.hidden});",
    ]


def _choose_lines(program: Program, here: str) -> list[str]:
    lines = [
        "    for (k = 1; k < ESP_POLICY_ACTION; k++) {",
        f"        if ({here}[k] > {here}[best]) best = k;",
        "    }",
    ]
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


def _array(name: str, array: Floats) -> str:
    return f"static const float {name}[{array.size}] = {{\n{_numbers(array.ravel().tolist())}}};"


def _numbers(values: Iterable[float]) -> str:
    literals = [_literal(value) for value in values]
    return "".join(f"    {', '.join(literals[k : k + 8])},\n" for k in range(0, len(literals), 8))


def _literal(value: float) -> str:
    """Return a float32 in full: nine digits tell every one apart."""
    text = f"{value:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"


_AFFINE = """static void affine(const float *weight, const float *bias, int inputs, int outputs,
                   const float *x, float *y)
{
    int i, j;
    for (j = 0; j < outputs; j++) y[j] = bias[j];
    for (i = 0; i < inputs; i++) {
        for (j = 0; j < outputs; j++) y[j] += x[i] * weight[i * outputs + j];
    }
}
"""

_ACTIVATIONS = {
    "relu": """static void apply_relu(float *x, int width)
{
    int k;
    for (k = 0; k < width; k++) x[k] = x[k] > 0.0f ? x[k] : 0.0f;
}
""",
    "tanh": """static void apply_tanh(float *x, int width)
{
    int k;
    for (k = 0; k < width; k++) x[k] = tanhf(x[k]);
}
""",
}

_NORM = f"""static void normalise(const float *weight, const float *bias, int width, float *x)
{{
    int k;
    float mean = 0.0f, variance = 0.0f, scale;
    for (k = 0; k < width; k++) mean += x[k];
    mean /= (float)width;
    for (k = 0; k < width; k++) variance += (x[k] - mean) * (x[k] - mean);
    scale = 1.0f / sqrtf(variance / (float)width + {_literal(NORM_EPSILON)});
    for (k = 0; k < width; k++) x[k] = (x[k] - mean) * scale * weight[k] + bias[k];
}}
"""

_RECUR = """static float sigmoid(float x)
{
    return 0.5f + 0.5f * tanhf(0.5f * x);
}

static void recur(float *hidden)
{
    int k;
    for (k = 0; k < HIDDEN; k++) {
        const float reset = sigmoid(into[k] + back[k]);
        const float update = sigmoid(into[HIDDEN + k] + back[HIDDEN + k]);
        const float candidate = tanhf(into[2 * HIDDEN + k] + reset * back[2 * HIDDEN + k]);
        hidden[k] = candidate + update * (hidden[k] - candidate);
    }
}
"""
