"""Any network made equivariant: by all images of its input, or by the one image in the input's own frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import torch
from torch import Tensor

from esp_cli.networks.contract import IoSpec, Memoryless, Network
from esp_cli.networks.ordering import items_of
from esp_cli.symmetry.maps import map_of
from esp_cli.symmetry.plane import PlaneElement
from esp_cli.symmetry.representation import layout_operator
from esp_envs.errors import UserError
from esp_envs.spec import ActionSpace, Discrete, Kind

_LESS, _ROUNDING = 0.37, 1e-5  # how much less each further vector counts, and the share of its parts that makes a sum 0
LOCAL = "local-"  # begins the name of a group whose elements are chosen by the input's frame, as "local-d4"


class Symmetrised(Network):
    """y = 1 / G sum_g rho_out(g)^-1 f(rho_in(g) x): equivariant whatever f is, at G times its cost."""

    def __init__(self, network: Network, io: IoSpec, group: str) -> None:
        super().__init__()
        self.network = network
        self.group = io.group(group)
        self.memory_width = network.memory_width * self.group.order
        self.team = network.team
        self.image = map_of(layout_operator(io.layout, self.group.elements))
        blocks = [b for b in io.outputs(self.group) for _ in range(b.copies)]
        matrices = zip(*(torch.as_tensor(b.matrices, dtype=torch.float32) for b in blocks), strict=True)
        self.back: Tensor
        self.register_buffer("back", torch.stack([torch.block_diag(*each) for each in matrices]), False)

    def _images(self, x: Tensor) -> Tensor:
        num_seeds, batch, width = x.shape
        rows = x.reshape(1, -1, width).expand(self.group.order, -1, -1)
        return self.image.push(rows).view(-1, num_seeds, batch, width).transpose(0, 1).flatten(1, 2)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Symmetrised:
        """Move the map with the module, as torch moves its buffers."""
        self.image = self.image.apply(fn)
        return super()._apply(fn, recurse)  # type: ignore[no-untyped-call]

    def _mean(self, y: Tensor) -> Tensor:
        """Pull outputs [S, G * B, out] back and average them: [S, B, out]."""
        return torch.matmul(y.unflatten(1, (self.group.order, -1)), self.back).mean(1)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        order, width = self.group.order, self.network.memory_width
        apart = memory.unflatten(-1, (order, width)).permute(0, 2, 1, 3).flatten(1, 2)
        y, apart = self.network.step(self._images(x), apart)
        return self._mean(y), apart.unflatten(1, (order, -1)).permute(0, 2, 1, 3).flatten(2)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        images = self._images(x.flatten(1, 2)).unflatten(1, (self.group.order * x.shape[1], x.shape[2]))
        return self._mean(self.network.unroll(images, truncation).flatten(1, 2)).unflatten(1, x.shape[1:3])


class LocalFrame(Memoryless, Symmetrised):
    """y = rho_out(g)^-1 f(rho_in(g) x) with g = g(x), the frame of x: equivariant, at the cost of f alone.

    g(x) is the element whose image of the sum of all vectors of x lies nearest to a direction within one sector of the
    group, so that g(h x) = g(x) h^-1. That is the idea of LEGO (Wang et al., 2025), whose frame is the agent's velocity
    and the side of the centre of all. Where that sum is 0, as of the ways between agents in a row of all of them, the
    vectors count less one after the other. Where two images are as near, the first is taken.
    """

    def __init__(self, network: Network, io: IoSpec, group: str) -> None:
        super().__init__(network, io, group)
        if network.memory_width or network.team > 1:
            raise UserError(
                f"network.symmetrise={LOCAL}{group} is for networks without memory and messages; use {group}"
            )
        sector, planar = Fraction(1, self.group.order), {PlaneElement.of(element) for element in self.group.elements}
        if len(planar) < self.group.order:
            raise UserError(f"network.symmetrise={LOCAL}{group} moves items, which no frame tells apart; use {group}")
        on_axis = PlaneElement(sector, mirrored=True) in planar
        angle = math.pi * sector * (2 if on_axis else 1)  # a mirror leaves a direction on its axis alone
        vectors = [column for field, column in items_of(io.layout.fields) if field.kind == Kind.VECTOR]
        if not vectors:
            raise UserError(f"network.symmetrise={LOCAL}{group} needs vectors, and {io.spaces.label} shows none")
        along = torch.zeros(io.layout.width)
        along[vectors], along[[column + 1 for column in vectors]] = math.cos(angle), math.sin(angle)
        weights = torch.zeros_like(along)
        for k, column in enumerate(vectors):
            weights[column : column + 2] = 1 / (1 + _LESS * k)
        self.along: Tensor
        self.along_weighed: Tensor
        self.register_buffer("along", along, False)
        self.register_buffer("along_weighed", along * weights, False)

    def forward(self, x: Tensor) -> Tensor:
        images = self._images(x).unflatten(1, (self.group.order, -1))  # [S, G, B, in]
        sums = images @ self.along  # [S, G, B]
        is_none = sums.amax(1) <= _ROUNDING * (images[:, 0].abs() @ self.along.abs())
        if is_none.any():
            sums = torch.where(is_none.unsqueeze(1), images @ self.along_weighed, sums)
        chosen = sums.argmax(1)  # [S, B]
        own = images.gather(1, chosen[:, None, :, None].expand(-1, 1, -1, x.shape[-1]))
        y = self.network.unroll(own.transpose(1, 2))  # [S, B, 1, out]
        return (y @ self.back[chosen]).squeeze(-2)


def action_parts(space: ActionSpace) -> Tensor:
    """Return the 0/1 matrix [values of all parts, actions] of the part values that make up each action."""
    if isinstance(space, Discrete):
        columns = list(zip(*space.points, strict=True))
        values = [sorted(set(column)) for column in columns]
        if len(values) > 1 and math.prod(map(len, values)) == space.count:
            parts = [(column, value) for column, choices in zip(columns, values, strict=True) for value in choices]
            return torch.tensor([[x == value for x in column] for column, value in parts], dtype=torch.float32)
    raise UserError(
        "network.separate_parts is for discrete actions that are all combinations of part values, "
        "such as pairs of wheel speeds; leave it off"
    )


class Separate(Network):
    """y_j = sum over the parts p of action j of f(x)_p: the values (or logits) of an action's parts add up to its own.

    Greedy parts make the greedy action, and a softmax of the sums is a product of one distribution per part. A
    permutation of the parts, such as a mirror that swaps the wheels, permutes the sums.
    """

    def __init__(self, network: Network, parts: Tensor) -> None:
        super().__init__()
        self.network = network
        self.memory_width = network.memory_width
        self.parts: Tensor
        self.register_buffer("parts", parts, False)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        y, memory = self.network.step(x, memory)
        return y @ self.parts, memory

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        return self.network.unroll(x, truncation) @ self.parts
