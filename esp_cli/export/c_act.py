"""The function of an exported C source that acts: one line for each layer of the program."""

from __future__ import annotations

from esp_cli.export import layers
from esp_cli.export.c_parts import literal
from esp_cli.export.program import Program


def seen(program: Program) -> str:
    """Return the length of the observation of one call, as C writes it."""
    return "ESP_POLICY_AGENTS * ESP_POLICY_OBSERVATION" if program.team > 1 else "ESP_POLICY_OBSERVATION"


def signature(program: Program) -> str:
    """Return the declaration of the function, without a semicolon."""
    parameters = [f"const float observation[{seen(program)}]"]
    if program.masked:
        agents = "ESP_POLICY_AGENTS * " if program.team > 1 else ""
        parameters.append(f"const unsigned char allowed[{agents}ESP_POLICY_ACTION]")
    if program.team > 1:
        return f"void esp_policy_act({', '.join(parameters)}, int action[ESP_POLICY_AGENTS])"
    parameters += ["float memory[ESP_POLICY_MEMORY]"] if program.memory_width else []
    parameters += ["float action[ESP_POLICY_ACTION]"] if program.head == "squash" else []
    return f"{'int' if program.head == 'choose' else 'void'} esp_policy_act({', '.join(parameters)})"


def act_function(program: Program) -> str:
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
        allowed = ", allowed + i * ESP_POLICY_ACTION" if program.masked else ""
        lines.append(row.each(f"action[i] = choose({row.here}{allowed});"))
    elif program.head == "choose":
        variables = "    int best;\n" if not program.previous else "    int k, best;\n"
        lines += _choose_lines(program, row.name)
    else:
        variables = "    int k;\n    float length;\n"
        lines += _squash_lines(program, row.name)
    return f"{signature(program)}\n{{\n{variables}\n" + "\n".join(lines) + "\n}\n"


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


def _layer_lines(k: int, layer: layers.Layer, row: _Row) -> list[str]:
    if isinstance(layer, layers.Activation):
        return [row.each(f"apply_{layer.name}({row.here}, {layer.width});")]
    if isinstance(layer, layers.Norm):
        return [row.each(f"normalise(w{k}_0, w{k}_1, {layer.weight.size}, {row.here});")]
    if isinstance(layer, layers.Recurrent):
        return _recur_lines(k, layer, row.name)
    if isinstance(layer, layers.Slice):
        moved = f"memmove({row.here}, {row.here} + {layer.begin}, sizeof(float) * {layer.end - layer.begin});"
        return [row.each(moved)] if layer.begin else []
    if isinstance(layer, layers.MessageAggregation):
        line = f"    aggregate(observation + {layer.begin}, {layer.width}, {row.name}, {row.other});"
    elif isinstance(layer, layers.Affine):
        inputs, outputs = layer.weight.shape
        line = row.each(f"affine(w{k}_0, w{k}_1, {inputs}, {outputs}, {row.here}, {row.there});")
    elif isinstance(layer, layers.Convolution):
        shape = f"{layer.channels}, {layer.rows}, {layer.columns}, {layer.side}, {layer.stride}, {layer.outputs}"
        line = row.each(f"convolve(w{k}_0, w{k}_1, {shape}, {row.here}, {row.there});")
    else:
        line = row.each(f"global_max_pool({layer.channels}, {layer.places}, {row.here}, {row.there});")
    row.turn()
    return [line]


def _recur_lines(k: int, layer: layers.Recurrent, here: str) -> list[str]:
    inputs, wide = layer.input.weight.shape
    return [
        f"    affine(w{k}_0, w{k}_1, {inputs}, {wide}, {here}, into);",
        f"    affine(w{k}_2, w{k}_3, {layer.hidden}, {wide}, memory, back);",
        "    recur(memory);",
        f"    memcpy({here}, memory, sizeof(float) * {layer.hidden});",
    ]


def _choose_lines(program: Program, here: str) -> list[str]:
    lines = [f"    best = choose({here}{', allowed' if program.masked else ''});"]
    if program.previous:
        lines.append(
            f"    for (k = 0; k < ESP_POLICY_ACTION; k++) memory[{program.hidden} + k] = k == best ? 1.0f : 0.0f;"
        )
    return [*lines, "    return best;"]


def _squash_lines(program: Program, here: str) -> list[str]:
    lines, place = [], 0
    for width in program.groups:
        squares = " + ".join(f"{here}[{i}] * {here}[{i}]" for i in range(place, place + width))
        lines.append(f"    length = sqrtf({squares} + {literal(layers.SQUASH_EPSILON)});")
        lines.append(
            f"    for (k = {place}; k < {place + width}; k++) action[k] = {here}[k] * (tanhf(length) / length);"
        )
        place += width
    if program.previous:
        lines.append(f"    for (k = 0; k < ESP_POLICY_ACTION; k++) memory[{program.hidden} + k] = action[k];")
    return lines
