"""The equivariant ensemble: any network, asked about every image of a scene, its answers brought home and averaged."""

from __future__ import annotations

import torch
from torch import Tensor

from esp_cli.networks.contract import Network
from esp_cli.networks.io_spec import IoSpec
from esp_cli.symmetry.intertwiners import planar_matrices
from esp_cli.symmetry.representation import layout_matrix, rows_permutation


class Symmetrised(Network):
    """y = 1 / G sum_g rho_out(g)^-1 f(rho_in(g) x): equivariant whatever f is, at G times its price.

    What a recurrent f remembers of each image is kept apart.

    Args:
        network: f.
        io: what it reads and writes.
        group: name of the group.

    Raises:
        ValueError: see `IoSpec.group`.
    """

    def __init__(self, network: Network, io: IoSpec, group: str) -> None:
        super().__init__()
        self.network = network
        self.group = io.group(group)
        self.memory_width = network.memory_width * self.group.order
        self.team = network.team
        planar = planar_matrices(self.group)
        self.pictured = any(field.pixels is not None for field in io.layout.fields)
        self.push: Tensor
        self.sign: Tensor
        self.home: Tensor
        if self.pictured:
            source, sign = rows_permutation(io.layout, planar, None)
            self.register_buffer("push", torch.as_tensor(source), False)
            self.register_buffer("sign", torch.as_tensor(sign, dtype=torch.float32), False)
        else:
            matrix = torch.as_tensor(layout_matrix(io.layout, planar), dtype=torch.float32)
            self.register_buffer("push", matrix.transpose(1, 2).contiguous(), False)
        blocks = io.outputs(self.group)
        home = [
            torch.block_diag(
                *(torch.as_tensor(b.matrices[g], dtype=torch.float32) for b in blocks for _ in range(b.copies))
            )
            for g in range(self.group.order)
        ]
        self.register_buffer("home", torch.stack(home), False)

    def _images(self, x: Tensor) -> Tensor:
        """Return all images of rows x [S, B, D], one behind the other: [S, G * B, D]."""
        if self.pictured:
            return torch.cat([x.index_select(-1, p) * s for p, s in zip(self.push, self.sign, strict=True)], 1)
        return torch.matmul(x.unsqueeze(1), self.push).flatten(1, 2)

    def _mean(self, y: Tensor) -> Tensor:
        """Bring outputs [S, G * B, out] home and average them: [S, B, out]."""
        return torch.matmul(y.unflatten(1, (self.group.order, -1)), self.home).mean(1)

    def step(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Advance one step with every image."""
        order, width = self.group.order, self.network.memory_width
        apart = memory.unflatten(-1, (order, width)).permute(0, 2, 1, 3).flatten(1, 2)
        y, apart = self.network.step(self._images(x), apart)
        return self._mean(y), apart.unflatten(1, (order, -1)).permute(0, 2, 1, 3).flatten(2)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        """Run over whole episodes with every image: [S, B, T, in] -> [S, B, T, out]."""
        shape = (self.group.order * x.shape[1], x.shape[2])
        images = self._images(x.flatten(1, 2)).unflatten(1, shape)
        return self._mean(self.network.unroll(images, truncation).flatten(1, 2)).unflatten(1, x.shape[1:3])
