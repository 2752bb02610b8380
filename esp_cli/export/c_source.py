"""A program as C99: float32, no allocation, no library but libm; weights in constant arrays, scratch in static ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from esp_cli.export import c_parts, layers
from esp_cli.export.c_act import act_function, seen, signature
from esp_cli.export.c_parts import array, numbers
from esp_cli.export.program import Program
from esp_envs.errors import UserError

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
"""The source compiles without warnings under these."""


@dataclass(frozen=True)
class CSource:
    """The two files, and the memory that they need on a microcontroller.

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
        UserError: agents that exchange messages and have continuous actions.
    """
    if program.team > 1 and program.head != "choose":
        raise UserError(
            "C export of agents that exchange messages supports discrete actions only; use onnx, torch or numpy"
        )
    scratch = 2 * program.team * _row_width(program) + 6 * program.hidden
    return CSource(
        header=_header(program, comment),
        source=_source(program),
        flash_bytes=len(program.weights),
        ram_bytes=4 * (scratch + program.memory_width),
    )


def _row_width(program: Program) -> int:
    """Return the width of the two rows, an agent each, that layers read and write in turn."""
    widths = [program.num_inputs + program.previous, program.num_outputs, program.hidden]
    for layer in program.layers:
        if isinstance(layer, layers.Affine):
            widths += layer.weight.shape
        elif isinstance(layer, layers.Convolution):
            widths.append(layer.width)
    return max(widths)


def example_source(
    program: Program, observation: Iterable[float], action: Iterable[float], allowed: Iterable[int] = ()
) -> str:
    """Return a program that acts on the worked example and says whether the action is the right one."""
    choose, remembers, team = program.head == "choose", program.memory_width > 0, program.team > 1
    memory = "    float memory[ESP_POLICY_MEMORY];\n" if remembers else ""
    reset = "    esp_policy_reset(memory);\n" if remembers else ""
    masked = ", ".join(str(int(flag)) for flag in allowed)
    mask = f"    const unsigned char allowed[] = {{{masked}}};\n" if program.masked else ""
    given = ", ".join(["observation", *["allowed"] * program.masked, *["memory"] * remembers])
    head = f"""/* Acts on the worked example: cc policy_example.c policy.c -lm && ./a.out */
#include "policy.h"

#include <math.h>
#include <stdio.h>

int main(void)
{{
    const float observation[{seen(program)}] = {{
{numbers(observation)}    }};
{mask}"""
    if team:
        indices = ", ".join(str(int(index)) for index in action)
        return f"""{head}    const int expected[ESP_POLICY_AGENTS] = {{{indices}}};
    int action[ESP_POLICY_AGENTS];
    int i, wrong = 0;

    esp_policy_act({given}, action);
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
{numbers(action)}    }};
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


def _header(program: Program, comment: str) -> str:
    told = "\n".join(f" * {line}".rstrip() for line in comment.replace("*/", "* /").replace("/*", "/ *").splitlines())
    if program.team > 1:
        returns = "Writes the index of each agent's best action; the observations stand side by side."
    elif program.head == "choose":
        returns = "Returns the index of the best action."
    else:
        returns = "Writes the action, within its bounds."
    if program.masked:
        returns += " `allowed` is 1 for each action that may be taken, else 0."
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
{signature(program)};

/* What the last layer said in the last call: logits, values or the action before its bounds. */
{_outputs(program)};

#ifdef __cplusplus
}}
#endif

#endif
"""


def _outputs(program: Program) -> str:
    return f"const float *esp_policy_outputs({'int agent' if program.team > 1 else 'void'})"


def _source(program: Program) -> str:
    kinds = {type(layer) for layer in program.layers}
    names = {layer.name for layer in program.layers if isinstance(layer, layers.Activation)}
    parts = ['#include "policy.h"\n\n#include <math.h>\n#include <string.h>\n']
    parts += [array(f"w{k}_{i}", a) for k, layer in enumerate(program.layers) for i, a in enumerate(layer.arrays)]
    row = str(_row_width(program))
    if program.team > 1:
        parts.append(f"#define ROW {row}")
        row = "ESP_POLICY_AGENTS * ROW"
    parts.append(f"static float row_a[{row}], row_b[{row}];")
    if program.hidden:
        parts.append(f"static float into[{3 * program.hidden}], back[{3 * program.hidden}];")
    parts.append("static const float *last = row_a;\n")
    parts.append(c_parts.AFFINE)
    parts += [c_parts.ACTIVATIONS[name] for name in sorted(names)]
    parts += [code for kind, code in c_parts.LAYERS.items() if kind in kinds]
    parts += [c_parts.aggregate(layer) for layer in program.layers if isinstance(layer, layers.MessageAggregation)][:1]
    parts += [c_parts.RECUR.replace("HIDDEN", str(program.hidden))] if program.hidden else []
    choose = c_parts.CHOOSE_ALLOWED if program.masked else c_parts.CHOOSE
    parts += [choose] if program.head == "choose" else []
    parts.append(act_function(program))
    parts.append(f"{_outputs(program)}\n{{\n    return last{' + agent * ROW' if program.team > 1 else ''};\n}}")
    if program.memory_width:
        parts.append(
            "void esp_policy_reset(float memory[ESP_POLICY_MEMORY])\n"
            "{\n    int k;\n    for (k = 0; k < ESP_POLICY_MEMORY; k++) memory[k] = 0.0f;\n}"
        )
    return "\n".join(parts) + "\n"
