"""QMIX's mixer: a value of the team that never falls when an agent's own value rises."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn.functional import elu_

from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.mixer import CompiledMixer
from esp_cli.networks.layers import SeedMLP
from esp_cli.networks.perceptron import CACHED_ROWS


class MonotonicMixer(nn.Module):
    """Q_tot = w_2(s)' elu(W_1(s)' q + b_1(s)) + b_2(s) with w, W >= 0 (Rashid et al., 2018), for S seeds.

    One hypernetwork reads the state and gives all weights and biases; absolute values make the weights non-negative.

    Args:
        generators: one per seed; they draw the initial weights.
        num_agents: N.
        state_width: width of what the hypernetwork sees.
        width: M, hidden units of the mixer.
        hidden: hidden units of the hypernetwork.
        compiled: whether the hypernetwork is; see `SeedMLP`.
    """

    def __init__(
        self,
        generators: Sequence[torch.Generator],
        num_agents: int,
        state_width: int,
        width: int,
        hidden: int,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        self.num_agents, self.width = num_agents, width
        if compiled:
            begin("mixer")
        outputs = num_agents * width + 2 * width + 1
        self.hypernetwork = SeedMLP(generators, (state_width, hidden, outputs), "relu", HYPER_GAIN, compiled=compiled)

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        """Mix the agents' values.

        Shape:
            values [S, ..., N], state [S, ..., state width] -> [S, ...].
        """
        own = values.reshape(values.shape[0], -1, values.shape[-1])
        if computes(self.hypernetwork.compiled, state):
            given = (own.contiguous(), state, *self.hypernetwork.parameters())
            return _CompiledMixed.apply(self.width, torch.is_grad_enabled(), *given).view(values.shape[:-1])  # type: ignore[no-untyped-call]
        seen, size = state.reshape(len(state), -1, state.shape[-1]), max(1, CACHED_ROWS // values.shape[0])
        pieces = [self._mixed(*piece) for piece in zip(own.split(size, 1), seen.split(size, 1), strict=True)]
        return torch.cat(pieces, 1).view(values.shape[:-1])

    def _mixed(self, own: Tensor, seen: Tensor) -> Tensor:
        """Return the team's values [S, B] of own [S, B, N] in states as they are seen [S, B, width]."""
        rows = self.hypernetwork(seen, rows_innermost=True)
        return _Mixed.apply(own.transpose(1, 2), rows.transpose(1, 2), self.width)  # type: ignore[no-untyped-call]


class _Mixed(Function):
    """What the hypernetwork says, applied: own [S, N, B] and rows [S, N M + M + M + 1, B] to [S, B].

    Autograd through the formula is the reference in the tests.
    """

    @staticmethod
    def forward(ctx, own, rows, width):  # type: ignore[no-untyped-def]
        first, bias, second, offset = _parts(rows, own.shape[1], width)
        hidden = bias
        for weight, value in zip(first.unbind(1), own.unsqueeze(2).unbind(1), strict=True):
            hidden = torch.addcmul(hidden, weight.abs(), value)
        hidden = elu_(hidden)
        ctx.save_for_backward(own, rows, hidden)
        return (hidden * second.abs()).sum(1).add_(offset.squeeze(1))

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        own, rows, hidden = ctx.saved_tensors
        by_rows, above = torch.empty_like(rows), grad.unsqueeze(1)
        first, _, second, _ = _parts(rows, own.shape[1], hidden.shape[1])
        by_first, by_bias, by_second, by_offset = _parts(by_rows, own.shape[1], hidden.shape[1])
        by_offset.copy_(above)
        torch.sgn(second, out=by_second).mul_(above)  # of w_2, where the team's value goes by |w_2|
        inner = by_second * second  # = |w_2| times the gradient above: by the hidden units
        by_second.mul_(hidden)
        torch.ops.aten.elu_backward.grad_input(inner, 1.0, 1.0, 1.0, True, hidden, grad_input=by_bias)
        torch.sgn(first, out=by_first).mul_(by_bias.unsqueeze(1))
        by_own = (by_first * first).sum(2)
        by_first.mul_(own.unsqueeze(2))
        return by_own, by_rows, None


class _CompiledMixed(Function):
    """The same by the kernel, hypernetwork and all: own [S, B, N] in states [S, ..., width] to [S, B]."""

    @staticmethod
    def forward(ctx, width, keep, own, state, *parameters):  # type: ignore[no-untyped-def]
        ctx.run = CompiledMixer(own, [state], parameters, width, keep)
        ctx.save_for_backward(own, state, *parameters)  # so that autograd notices a change of them
        return ctx.run.outputs.detach()  # the tensor itself would hold, by its grad_fn, what holds it

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        _, state, *_ = ctx.saved_tensors
        by_own, grads, (by_state,) = ctx.run.unmix(grad, ctx.needs_input_grad[4:], ctx.needs_input_grad[3:4])
        return None, None, by_own, None if by_state is None else by_state.view(state.shape), *grads


def _parts(rows: Tensor, num_agents: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return W_1 [S, N, M, B], b_1 [S, M, B], w_2 [S, M, B] and b_2 [S, 1, B]."""
    first, bias, second, offset = rows.split((num_agents * width, width, width, 1), 1)
    return first.unflatten(1, (num_agents, width)), bias, second, offset


HYPER_GAIN = 0.5  # orthogonal gain of the hypernetwork's last layer
