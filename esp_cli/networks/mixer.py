"""QMIX's mixer: a value of the team that never falls when an agent's own value rises."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn.functional import elu

from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.mixer import CompiledMixer
from esp_cli.networks.layers import SeedMLP
from esp_cli.networks.perceptron import CACHED_ROWS

HYPER_GAIN = 0.5  # orthogonal gain of the hypernetwork's last layer


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
        rows = self.hypernetwork(seen, rows_innermost=True).transpose(1, 2)
        first, bias, second, offset = rows.split((self.num_agents * self.width, self.width, self.width, 1), 1)
        weighed = first.unflatten(1, (self.num_agents, self.width)).abs() * own.transpose(1, 2).unsqueeze(2)
        hidden = elu(weighed.sum(1) + bias)
        return (hidden * second.abs()).sum(1) + offset.squeeze(1)


class _CompiledMixed(Function):
    """The mixer by the kernel, hypernetwork and all: own [S, B, N] in states [S, ..., width] to [S, B]."""

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
