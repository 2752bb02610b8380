"""A program as a torch.export archive (.pt2): a graph of plain operations that torch or ExecuTorch runs."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from esp_cli.export import layers
from esp_cli.export.check import Numbers, Runner
from esp_cli.export.layers import Floats, Program
from esp_cli.networks.heads import masked
from esp_envs.spec import others_of


class TorchProgram(nn.Module):
    """The program in torch's own operations.

    Shape:
        observation: [rows, D]; memory: [rows, H], for recurrent policies; action_mask: [rows, A] bool, for those with
        masks.
        Returns action ([rows] int64 or [rows, width]), outputs [rows, outputs] and, if recurrent, memory [rows, H].
        A team's rows stand side by side, world after world.
    """

    def __init__(self, program: Program) -> None:
        super().__init__()
        self.program = program
        for k, layer in enumerate(program.layers):
            for i, array in enumerate(layer.arrays):
                self.register_buffer(f"w{k}_{i}", torch.from_numpy(array.copy()))

    def forward(
        self, observation: Tensor, memory: Tensor | None = None, action_mask: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """Act."""
        program, x = self.program, observation
        hidden = x[:, :0] if memory is None else memory[:, : program.hidden]
        if program.previous and memory is not None:
            x = torch.cat([x, memory[:, program.hidden :]], 1)
        for k, layer in enumerate(program.layers):
            arrays = [self.get_buffer(f"w{k}_{i}") for i in range(len(layer.arrays))]
            if isinstance(layer, layers.Recurrent):
                x = hidden = _recur(x, hidden, arrays)
            else:
                x = _LAYERS[type(layer)](x, layer, arrays, observation)
        if program.head == "choose":
            action = masked(x, action_mask).argmax(-1)
            encoded = nn.functional.one_hot(action, program.num_outputs).float()
        else:
            action = encoded = _squash(x, program.groups)
        if memory is None:
            return action, x
        return action, x, torch.cat([hidden, encoded], 1) if program.previous else hidden


def torch_archive(program: Program, description: str) -> bytes:
    """Write a program as an archive of torch.export, for any number of rows, or of worlds for a team.

    Args:
        program: the policy.
        description: JSON that goes into the archive as `policy.json`.
    """
    worlds = torch.export.Dim("worlds", min=1)
    rows = worlds if program.team == 1 else program.team * worlds
    inputs = {"observation": torch.zeros(2 * program.team, program.num_inputs)}
    if program.memory_width:
        inputs["memory"] = torch.zeros(2 * program.team, program.memory_width)
    arguments, named = tuple(inputs.values()), {}
    if program.masked:
        named["action_mask"] = torch.ones(2 * program.team, program.num_outputs, dtype=torch.bool)
    shapes = {name: {0: rows} for name in inputs | named}
    exported = torch.export.export(TorchProgram(program).eval(), arguments, named, dynamic_shapes=shapes)
    content = BytesIO()
    torch.export.save(exported, content, extra_files={"policy.json": description})
    return content.getvalue()


def torch_runner(file: Path) -> Runner:
    """Run a written torch.export archive."""
    module = torch.export.load(file).module()

    def run(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        allowed = {} if mask is None else {"action_mask": torch.from_numpy(mask)}
        inputs = [torch.from_numpy(array) for array in (obs, memory) if array.shape[1]]
        with torch.no_grad():
            results = [result.numpy() for result in module(*inputs, **allowed)]
        return results[0], results[1], results[2] if len(results) > 2 else memory

    return run


def _convolve(x: Tensor, layer: layers.Convolution, arrays: list[Tensor], _: Tensor) -> Tensor:
    weight = arrays[0].T.reshape(layer.outputs, layer.channels, layer.side, layer.side)
    pictures = x.unflatten(1, (layer.channels, layer.rows, layer.columns))
    return nn.functional.conv2d(pictures, weight, arrays[1], layer.stride).flatten(1)


def _aggregate(x: Tensor, layer: layers.MessageAggregation, _: list[Tensor], observation: Tensor) -> Tensor:
    """Concatenate own features with the neighbours' mean relative position and mean message."""
    ways = observation[:, layer.begin : layer.end].unflatten(1, (layer.others, 2))
    near = (ways.square().sum(2, keepdim=True) < layer.reach_squared).float()
    share = near / (1 + near.sum(1, keepdim=True))  # [rows, N - 1, 1]
    messages = x.unflatten(0, (-1, layer.team))[:, torch.tensor(others_of(layer.team))].flatten(0, 1)
    return torch.cat([x, (share * (ways / layer.reach)).sum(1), (share * messages).sum(1)], 1)


def _recur(x: Tensor, hidden: Tensor, arrays: list[Tensor]) -> Tensor:
    pr, pz, pn = torch.addmm(arrays[1], x, arrays[0]).chunk(3, -1)
    qr, qz, qn = torch.addmm(arrays[3], hidden, arrays[2]).chunk(3, -1)
    reset, update = torch.sigmoid(pr + qr), torch.sigmoid(pz + qz)
    candidate = torch.tanh(pn + reset * qn)
    return candidate + update * (hidden - candidate)


def _squash(x: Tensor, groups: tuple[int, ...]) -> Tensor:
    """Bring each group of numbers into its bounds: u tanh|u| / |u|."""
    parts = x.split(list(groups), -1)
    lengths = [(part.square().sum(-1, keepdim=True) + layers.SQUASH_EPSILON).sqrt() for part in parts]
    return torch.cat([part * (torch.tanh(length) / length) for part, length in zip(parts, lengths, strict=True)], -1)


_LAYERS: dict[type[layers.Layer], Callable[[Tensor, Any, list[Tensor], Tensor], Tensor]] = {
    layers.Affine: lambda x, _, arrays, __: torch.addmm(arrays[1], x, arrays[0]),
    layers.Activation: lambda x, layer, *_: torch.relu(x) if layer.kind == "relu" else torch.tanh(x),
    layers.Norm: lambda x, _, arrays, __: nn.functional.layer_norm(
        x, x.shape[-1:], arrays[0], arrays[1], layers.NORM_EPSILON
    ),
    layers.Slice: lambda x, layer, *_: x[:, layer.begin : layer.end],
    layers.Convolution: _convolve,
    layers.GlobalMaxPool: lambda x, layer, *_: x.unflatten(1, (layer.channels, layer.places)).amax(2),
    layers.MessageAggregation: _aggregate,
}
"""What a layer without memory makes of rows x [rows, width], with its arrays and the observations."""
