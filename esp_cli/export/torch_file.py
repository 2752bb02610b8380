"""A program as a torch.export archive (.pt2): a graph of plain operations that torch or ExecuTorch runs."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.export.check import Numbers, Runner, Sample
from esp_cli.export.program import Program
from esp_cli.networks.heads import masked, squash
from esp_envs.errors import UserError


class TorchProgram(nn.Module):
    """The program in torch's own operations.

    It takes observation [rows, D]; of recurrent policies memory [rows, H]; of those with masks action_mask [rows, A]
    bool; of networks over sets tables [rows, K, W] by name. It returns action ([rows] int64 or [rows, width]), outputs
    [rows, outputs] and, if recurrent, memory [rows, H]. A team's rows stand side by side, world after world.
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.program = program
        for k, layer in enumerate(program.layers):
            for i, array in enumerate(layer.arrays):
                self.register_buffer(f"w{k}_{i}", torch.from_numpy(array.copy()))
        self.disc = torch.block_diag(*(torch.ones(width, width) for width in program.groups or (1,)))

    def forward(
        self,
        observation: Tensor,
        memory: Tensor | None = None,
        action_mask: Tensor | None = None,
        sets: dict[str, Tensor] | None = None,
    ) -> tuple[Tensor, ...]:
        program, x = self.program, observation
        hidden = x[:, :0] if memory is None else memory[:, : program.hidden]
        if program.previous and memory is not None:
            x = torch.cat([x, memory[:, program.hidden :]], 1)
        for k, layer in enumerate(program.layers):
            arrays = [self.get_buffer(f"w{k}_{i}") for i in range(len(layer.arrays))]
            x = layer.torch(x, arrays, {"gru": hidden, "sets": sets}.get(layer.kind, observation))
            hidden = x if layer.kind == "gru" else hidden
        if program.head == "choose":
            action = masked(x, action_mask).argmax(-1)
            encoded = nn.functional.one_hot(action, program.num_outputs).float()
        else:
            action = encoded = squash(x, self.disc)
        if memory is None:
            return action, x
        return action, x, torch.cat([hidden, encoded], 1) if program.previous else hidden


def exported_program(program: Program) -> torch.export.ExportedProgram:
    """Return a program as a graph of plain operations, for any number of rows, or of worlds for a team."""
    worlds = torch.export.Dim("worlds", min=1)
    rows = worlds if program.team == 1 else program.team * worlds
    inputs = {"observation": torch.zeros(2 * program.team, program.num_inputs)}
    if program.memory_width:
        inputs["memory"] = torch.zeros(2 * program.team, program.memory_width)
    named = dict[str, Any]()
    if program.masked:
        named["action_mask"] = torch.ones(2 * program.team, program.num_outputs, dtype=torch.bool)
    shapes: dict[str, Any] = {name: {0: rows} for name in inputs | named}
    if program.sets:
        widths = {name: len(columns[0]) for name, columns in program.sets}
        if bad := next((name for name in widths if {*name} & {*"\"'\\\n"}), None):  # it gets into generated code
            raise UserError(
                f"things named {bad!r} cannot be exported to torch and ONNX; leave quotes and backslashes out of it"
            )
        named["sets"] = {name: torch.zeros(2, 3 + k, width) for k, (name, width) in enumerate(widths.items())}
        shapes["sets"] = {name: {0: rows, 1: torch.export.Dim(f"things{k}")} for k, name in enumerate(widths)}
    return torch.export.export(TorchProgram(program).eval(), (*inputs.values(),), named, dynamic_shapes=shapes)


def torch_archive(program: Program, description: str) -> bytes:
    """Write a program as an archive of torch.export."""
    content, exported = BytesIO(), exported_program(program)
    for node in exported.graph.nodes:
        node.meta.pop("stack_trace", None)  # which names the folders of this machine
    torch.export.save(exported, content, extra_files={"policy.json": description})
    return content.getvalue()


def torch_runner(file: Path) -> Runner:
    """Run a written torch.export archive."""
    module = torch.export.load(file).module()

    @torch.no_grad()
    def run(sample: Sample) -> tuple[Numbers, Numbers, Numbers]:
        rows = [torch.from_numpy(array) for array in (sample.obs, sample.memory) if array.shape[1]]
        named: dict[str, Any] = {} if sample.mask is None else {"action_mask": torch.from_numpy(sample.mask)}
        if sample.sets:
            named["sets"] = {name: torch.from_numpy(table) for name, table in sample.sets.items()}
        results = [result.numpy() for result in module(*rows, **named)]
        return results[0], results[1], results[2] if len(results) > 2 else sample.memory

    return run
