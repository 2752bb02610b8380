"""Message passing networks on pictures (van der Pol et al., 2022), plain and equivariant: one class for any group.

Each drone encodes its picture by two convolutions and a maximum over all places. Near drones then exchange features
and relative positions. With the group of one element the layers are plain; this is the standard network. With C4 or D4
every layer is equivariant: group convolutions, regular features, relative positions as planar vectors, invariant
values, permuted actions.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from pydantic import Field as Setting
from torch import Tensor, nn
from torch.autograd import Function

from esp_cli.networks.constrained import ConstrainedLinear, copies_for
from esp_cli.networks.contract import Generators, IoSpec, Memoryless, Network, NetworkConfig
from esp_cli.networks.layers import GAINS
from esp_cli.networks.perceptron import affine
from esp_cli.symmetry import FiniteGroup
from esp_cli.symmetry.maps import Block, layout_blocks, regular, trivial, with_pixels
from esp_envs.errors import UserError
from esp_envs.spec import Field, Items, Kind, Layout, others_of

# of the two convolutions; van der Pol's script. A filter shrinks to a picture that is smaller.
CHANNELS, FILTERS, STRIDES = (16, 32), (7, 5), (2, 1)
REACH_SQUARED = 18.0
"""Square of the communication range in cells, 3 sqrt(2) cells; van der Pol's code. Drones at exactly this range do not
exchange messages. Squared distances are integers, so the comparison is exact."""
_LOT = 16  # the number of encoded pictures is a multiple of this, so that few shapes of matrix products occur


class PictureEncoder(nn.Module):
    """Convolutions for S seeds, each before a relu, then a maximum over places: [S, B, pixels] -> [S, B, width]."""

    def __init__(self, generators: Generators, field: Field, group: FiniteGroup) -> None:
        super().__init__()
        assert field.pixels is not None
        self.shape = (field.count, *field.pixels)
        lengths = list(field.pixels)
        block = trivial(group, field.count)
        self.sides, self.strides, layers = [], [], []
        for channels, filter_side, stride in zip(CHANNELS, FILTERS, STRIDES, strict=True):
            used = min(filter_side, *lengths)
            # a stride that skips the last pixels would break the symmetry between the edges
            step = stride if all((length - used) % stride == 0 for length in lengths) else 1
            following = regular(group, copies_for(channels, group))
            layers.append(ConstrainedLinear(generators, [with_pixels(block, used, group)], [following], GAINS["relu"]))
            self.sides.append(used)
            self.strides.append(step)
            lengths = [(length - used) // step + 1 for length in lengths]
            block = following
        self.layers = nn.ModuleList(layers)
        self.output = block
        keys = torch.randn(2, field.width, generator=torch.Generator().manual_seed(0))
        self.keys: Tensor
        self.register_buffer("keys", keys, False)

    def forward(self, pictures: Tensor) -> Tensor:
        """Encode pictures; equal pictures are encoded once. No gradient reaches a picture."""
        which, place = distinct(pictures.detach(), self.keys)
        num_seeds, batch = place.shape
        seeds = torch.arange(num_seeds, device=place.device).unsqueeze(1)
        rows = pictures.detach().flatten(0, 1).index_select(0, (which + batch * seeds).flatten())
        features = self.encode(rows.unflatten(0, which.shape))
        index = (place + which.shape[1] * seeds).flatten()
        return features.flatten(0, 1).index_select(0, index).unflatten(0, place.shape)

    def encode(self, pictures: Tensor) -> Tensor:
        return self.responses(self.as_pictures(pictures))[-1].flatten(2, 3).amax(2)

    def as_pictures(self, rows: Tensor) -> Tensor:
        """Shape rows of numbers [S, B, D] as pictures [S, B, rows, columns, channels]."""
        return rows.unflatten(-1, self.shape).movedim(2, -1)

    def responses(self, x: Tensor) -> list[Tensor]:
        """Return the output of each layer for pictures [S, B, rows, columns, channels], in the same layout."""
        out = []
        for layer, side, stride in zip(self.layers, self.sides, self.strides, strict=True):
            assert isinstance(layer, ConstrainedLinear)
            num_seeds, batch = x.shape[:2]
            rows, columns = ((length - side) // stride + 1 for length in x.shape[2:4])
            patches = _Patches.apply(x, side, stride)  # type: ignore[no-untyped-call]
            # a constrained weight orders channels, then pixels; a patch orders pixels, then channels, for long copies
            weight = layer.weight().unflatten(1, (-1, side * side)).transpose(1, 2).flatten(1, 2)
            x = torch.relu(affine(layer.bias(), patches, weight)).view(num_seeds, batch, rows, columns, -1)
            out.append(x)
        return out


class _Patches(Function):
    """Every patch that a filter looks at: [S, B, H, W, C] to [S, B * h * w, side * side * C]; adds rows backward."""

    @staticmethod
    def forward(ctx, x, side, stride):  # type: ignore[no-untyped-def]
        patches = x.unfold(2, side, stride).unfold(3, side, stride).permute(0, 1, 2, 3, 5, 6, 4)
        ctx.shape, ctx.patches, ctx.stride = x.shape, patches.shape, stride
        return patches.reshape(x.shape[0], -1, side * side * x.shape[-1])

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        if not ctx.needs_input_grad[0]:
            return None, None, None
        (_, _, rows, columns, side, _, _), stride = ctx.patches, ctx.stride
        grad, out = grad.reshape(ctx.patches), grad.new_zeros(ctx.shape)
        for i in range(side):
            for j in range(side):
                last_row, last_column = i + (rows - 1) * stride + 1, j + (columns - 1) * stride + 1
                out[:, :, i:last_row:stride, j:last_column:stride] += grad[:, :, :, :, i, j]
        return out, None, None


def distinct(rows: Tensor, keys: Tensor) -> tuple[Tensor, Tensor]:
    """Find the different rows of [S, B, D]; a batch of thousands of pictures of a torus with 49 cells has 49.

    Two fixed random projections, `keys` [2, D], identify a row; two different rows collide with probability 2^-46.
    Returned are, for each seed, the index of one row of each kind [S, U], padded, and the kind of each row [S, B].
    """
    num_seeds, batch, width = rows.shape
    flat = rows.reshape(-1, width)
    first, second = ((flat @ key).view(torch.int32).long() for key in keys)
    marks, order = ((first << 32) ^ (second & 0xFFFFFFFF)).view(num_seeds, batch).sort(1)
    sort = torch.zeros_like(order)
    sort[:, 1:] = (marks[:, 1:] != marks[:, :-1]).cumsum(1)
    sorts = min(batch, -(-(int(sort[:, -1].max()) + 1) // _LOT) * _LOT)
    place = torch.empty_like(order).scatter_(1, order, sort)
    which = torch.zeros(num_seeds, sorts, dtype=torch.int64, device=rows.device).scatter_(1, sort, order)
    return which, place


class MpnConfig(NetworkConfig):
    """The settings of the plain message passing network."""

    name: Literal["mpn"] = "mpn"

    def build(
        self, generators: Generators, inputs: int, outputs: int, output_gain: float, io: IoSpec | None
    ) -> Network:
        return MessagePassing(generators, self.io_or_refuse(io), self, getattr(self, "group", "c1"), output_gain)


class EmpnConfig(MpnConfig):
    """The settings of the equivariant message passing network."""

    name: Literal["empn"] = "empn"  # type: ignore[assignment]
    group: str = Setting("c4", max_length=100, description="the layers commute with this group")


class MessagePassing(Memoryless):
    """Encoder, message passing layers, head; see the module.

    A layer maps [own features, mean of (relative position, features) over near drones] through a linear layer and relu.
    The mean divides by the number of near drones plus one, for the drone itself.
    """

    def __init__(
        self, generators: Generators, io: IoSpec, config: NetworkConfig, group: str, output_gain: float
    ) -> None:
        super().__init__()
        if io.reads != "own":
            raise UserError(
                f"{config.name} passes messages between drones, each with what it sees: set mappo.critic_input=own"
            )
        picture, others = _fields(io)
        self.group = io.group(group)
        self.team = io.spaces.num_agents
        self.picture, self.others = (io.layout.slices()[field.name] for field in (picture, others))
        self.encoder = PictureEncoder(generators, picture, self.group)
        (vector,) = layout_blocks(Layout((Field("way", Kind.VECTOR),)), self.group)
        block: Block = self.encoder.output
        layers = []
        for width in config.hidden:
            following = regular(self.group, copies_for(width, self.group))
            layers.append(ConstrainedLinear(generators, [block, vector, block], [following], GAINS["relu"]))
            block = following
        self.layers = nn.ModuleList(layers)
        self.head = ConstrainedLinear(generators, [block], io.outputs(self.group), output_gain)
        self.index: Tensor
        self.register_buffer("index", torch.tensor(others_of(self.team)), False)

    def forward(self, x: Tensor) -> Tensor:
        """Map [S, W * N, D] to [S, W * N, out]; the N rows of a world are adjacent."""
        return self.head(self.features(x)[-1])

    def features(self, x: Tensor) -> list[Tensor]:
        """Return the features [S, W * N, C] after the encoder and after each message passing layer."""
        way = x[..., self.others].unflatten(-1, (-1, 2))
        near = (way.square().sum(-1) < REACH_SQUARED).float()
        share = near / (1 + near.sum(-1, keepdim=True))  # [S, W * N, N - 1]
        mean_way = (share.unsqueeze(-1) * (way / math.sqrt(REACH_SQUARED))).sum(-2)
        features = [self.encoder(x[..., self.picture])]
        for layer in self.layers:
            own = features[-1]
            messages = self._aggregate(own, share)
            features.append(torch.relu(layer(torch.cat([own, mean_way, messages], -1))))
        return features

    def _aggregate(self, own: Tensor, share: Tensor) -> Tensor:
        """Return for each drone the sum of the others' features by their shares: [S, W * N, C]."""
        worlds = own.unflatten(1, (-1, self.team))
        shares = share.unflatten(1, (-1, self.team)).unsqueeze(-1)
        total = torch.zeros_like(worlds)
        for k in range(self.team - 1):
            total = torch.addcmul(total, shares[:, :, :, k], worlds[:, :, self.index[:, k]])
        return total.flatten(1, 2)

    def unroll(self, x: Tensor, truncation: int = 0) -> Tensor:
        worlds = x.unflatten(1, (-1, self.team)).transpose(2, 3)  # [S, W, T, N, D]
        return self(worlds.flatten(1, 3)).unflatten(1, worlds.shape[1:4]).transpose(2, 3).flatten(1, 2)


def _fields(io: IoSpec) -> tuple[Field, Field]:
    """Return the field of pictures and that of relative positions."""
    fields = io.layout.fields
    pictures = [f for f in fields if f.kind == Kind.PICTURE and not f.parts]
    others = [f for f in fields if f.kind == Kind.VECTOR and f.items is Items.OTHERS]
    if (len(pictures), len(others)) == (1, 1) and len(fields) > 2:
        more = ", ".join(field.name for field in fields if field not in (*pictures, *others))
        raise UserError(
            f"message passing takes a picture and the way to each other agent, but {io.spaces.label} shows {more} too; "
            "use mlp"
        )
    if (len(pictures), len(others), len(fields)) != (1, 1, 2) or others[0].count != io.spaces.num_agents - 1:
        raise UserError(
            f"message passing needs a picture and the way to each other agent, but {io.spaces.label} does not show "
            "them; use mlp, gru or equivariant"
        )
    return pictures[0], others[0]
