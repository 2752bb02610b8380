"""Rows of a centralised critic of joint actions: one value for the team, or one per agent with its own reward.

Shape letters: S seeds, W agents' scenes (any axes), N agents, C values (1 or N), A numbers of an encoded action.
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn
from torch.autograd import Function
from torch.nn.functional import elu

from esp_cli.networks.contract import Generators
from esp_cli.networks.kernels.library import begin, computes
from esp_cli.networks.kernels.mixer import CompiledMixer
from esp_cli.networks.layers import SeedLinear, SeedMLP
from esp_cli.networks.perceptron import CACHED_ROWS, affine, passed
from esp_envs.spec import Spaces


class SharedCriticInput:
    """One value for agents that share their reward: the critic sees a scene once, with all actions in agent order."""

    def __init__(self, spec: Spaces, reads: Literal["state", "observations"]) -> None:
        self.spec, self.reads = spec, reads

    @property
    def width(self) -> int:
        """Numbers that the critic sees of a scene, without actions and time."""
        spec = self.spec
        return spec.state.width if self.reads == "state" else spec.num_agents * spec.observation.width

    def rows(self, obs: Tensor, state: Tensor) -> Tensor:
        """Return what the critic sees of scenes with obs [S, W, N, D] and state [S, W, G]: [S, W, width]."""
        return state if self.reads == "state" else obs.flatten(-2)

    def value(self, critic: nn.Module, seen: Tensor, action: Tensor) -> Tensor:
        """Return Q [S, W, C] of encoded joint actions [S, W, N, A]; `seen` is what the critic sees of the scenes."""
        return critic(seen, action.flatten(-2))

    def exchanged(self, critic: nn.Module, seen: Tensor, joint: Tensor, others: Tensor) -> Tensor:
        """Return each agent's Q [S, W, N, K] for its other actions, with the actions of all others fixed.

        The critic's parameters are frozen; `joint` [S, W, N, A] and `others` [S, W, N, K, A] are encoded actions.
        """
        shape = joint.shape[1:-2]
        rows = (x.flatten(1, len(shape)) for x in (seen, joint, others))
        return counterfactual_values(critic, *rows).unflatten(1, shape).squeeze(-1)


class PerAgentCriticInput(SharedCriticInput):
    """One value per agent, for agents with their own rewards: one shared critic sees a scene once per agent.

    A row lists all agents in circular order, its own the last. Beside a global state, the critic sees its observation.
    """

    @property
    def width(self) -> int:
        return super().width + (self.spec.observation.width if self.reads == "state" else 0)

    def rows(self, obs: Tensor, state: Tensor) -> Tensor:
        """Return what the critic sees of scenes, for each agent: [S, W, N, width]."""
        if self.reads == "observations":
            return in_circular_order(obs)
        return torch.cat([state.unsqueeze(-2).expand(*obs.shape[:-1], -1), obs], -1)

    def value(self, critic: nn.Module, seen: Tensor, action: Tensor) -> Tensor:
        return critic(seen, in_circular_order(action)).squeeze(-1)

    def exchanged(self, critic: nn.Module, seen: Tensor, joint: Tensor, others: Tensor) -> Tensor:
        """Return each agent's own Q for its other actions: [S, W, N, K]; arguments as of `SharedCriticInput`."""
        # the agent's own action is the last of its row, and the only one that is exchanged
        seen = torch.cat([seen, in_circular_order(joint)[..., : -joint.shape[-1]]], -1)
        return super().exchanged(critic, seen, joint.unsqueeze(-2), others.unsqueeze(-3)).squeeze(-2)


def in_circular_order(items: Tensor) -> Tensor:
    """Return N rows [..., N, N A] of all items [..., N, A]: row i holds items i + 1, ..., N, 1, ..., i."""
    count = items.shape[-2]
    agents = torch.arange(count, device=items.device)
    order = (agents.unsqueeze(1) + agents + 1) % count
    return items[..., order, :].flatten(-2)


def counterfactual_values(network: nn.Module, rows: Tensor, items: Tensor, others: Tensor) -> Tensor:
    """Return the outputs for rows that end in N items, with one item at a time replaced by each of K others.

    The N K rows share nearly all of the first layer's sums, which are computed once. Gradients flow to `others` alone;
    the network's own parameters have to be frozen. Rows [S, R, D] before the items, items [S, R, N, A], others [S, R,
    N, K, A] give [S, R, N, K, outputs].
    """
    # normalisation changes the whole input with every exchange
    if not isinstance(network, SeedMLP) or network.norms is not None:
        return _one_by_one(network, rows, items, others)
    first: SeedLinear = network.layers[0]  # type: ignore[assignment]
    precision, (num_rows, num_items, num_others, width) = network.precision, others.shape[1:]
    weight = first.weight.to(precision)
    with torch.no_grad():
        common = affine(first.bias.to(precision), torch.cat([rows, items.flatten(2)], -1).to(precision), weight)
    columns = weight[:, rows.shape[-1] :].unflatten(1, (num_items, width)).flatten(0, 1)
    change = (others - items.unsqueeze(3)).to(precision).transpose(1, 2)  # [S, N, R, K, A]
    change = torch.bmm(change.flatten(0, 1).flatten(1, 2), columns).view(
        -1, num_items, num_rows, num_others, columns.shape[-1]
    )
    sums = change.add_(common.view(-1, 1, num_rows, 1, columns.shape[-1]))
    values = network.from_first_sums(sums.flatten(1, 3))
    return values.unflatten(1, (num_items, num_rows, num_others)).transpose(1, 2)


def _one_by_one(network: nn.Module, rows: Tensor, items: Tensor, others: Tensor) -> Tensor:
    """Build every row and apply the network to it."""
    num_rows, num_items, num_others = others.shape[1:4]
    own = torch.eye(num_items, dtype=torch.bool, device=rows.device).view(num_items, 1, num_items, 1)
    joint = torch.where(own, others.unsqueeze(4), items.view(-1, num_rows, 1, 1, *items.shape[2:])).flatten(-2)
    here = rows.view(-1, num_rows, 1, 1, rows.shape[-1]).expand(*joint.shape[:-1], -1)
    return network(here.flatten(1, 3), joint.flatten(1, 3)).unflatten(1, (num_rows, num_items, num_others))


HYPER_GAIN = 0.5  # orthogonal gain of the hypernetwork's last layer


class MonotonicMixer(nn.Module):
    """Q_tot = w_2(s)' elu(W_1(s)' q + b_1(s)) + b_2(s) with w, W >= 0 (Rashid et al., 2018), for S seeds.

    One hypernetwork reads the state and gives all weights and biases; absolute values make the weights non-negative.
    """

    def __init__(
        self, generators: Generators, num_agents: int, state_width: int, width: int, hidden: int, compiled: bool = False
    ) -> None:
        super().__init__()
        self.num_agents, self.width = num_agents, width
        if compiled:
            begin("mixer")
        outputs = num_agents * width + 2 * width + 1
        self.hypernetwork = SeedMLP(generators, (state_width, hidden, outputs), "relu", HYPER_GAIN, compiled=compiled)

    def forward(self, values: Tensor, state: Tensor) -> Tensor:
        """Mix the agents' values [S, ..., N] by the state [S, ..., state width] to [S, ...]."""
        own = values.reshape(values.shape[0], -1, values.shape[-1])
        if computes(self.hypernetwork.compiled, state):
            mixer, inputs = partial(CompiledMixer, self.width), [own.contiguous(), state]
            return passed(mixer, inputs, [*self.hypernetwork.parameters()]).view(values.shape[:-1])
        seen, size = state.reshape(len(state), -1, state.shape[-1]), max(1, CACHED_ROWS // values.shape[0])
        pieces = [self._mixed(*piece) for piece in zip(own.split(size, 1), seen.split(size, 1), strict=True)]
        return torch.cat(pieces, 1).view(values.shape[:-1])

    def _mixed(self, own: Tensor, seen: Tensor) -> Tensor:
        """Return the team's values [S, B] of own [S, B, N] in states as they are seen [S, B, width]."""
        rows = self.hypernetwork(seen, rows_innermost=True)
        return _Mixed.apply(own.transpose(1, 2), rows.transpose(1, 2), self.width)  # type: ignore[no-untyped-call]


class _Mixed(Function):
    """Q_tot with its slopes: own [S, N, B] and rows [S, N M + 2 M + 1, B] of the hypernetwork to [S, B].

    With autograd through the formula, the reference in the tests, a gradient step of QMIX takes a tenth longer.
    """

    @staticmethod
    def forward(ctx, own, rows, width):  # type: ignore[no-untyped-def]
        first, bias, second, offset = _weights(rows, own.shape[1], width)
        hidden = bias
        for weight, value in zip(first.unbind(1), own.unsqueeze(2).unbind(1), strict=True):
            hidden = torch.addcmul(hidden, weight.abs(), value)
        hidden = elu(hidden, inplace=True)
        ctx.save_for_backward(own, rows, hidden)
        return (hidden * second.abs()).sum(1).add_(offset.squeeze(1))

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        own, rows, hidden = ctx.saved_tensors
        by_rows, sizes = torch.empty_like(rows), (own.shape[1], hidden.shape[1])
        first, _, second, _ = _weights(rows, *sizes)
        by_first, by_bias, by_second, by_offset = _weights(by_rows, *sizes)
        by_offset.copy_(grad.unsqueeze(1))
        torch.sgn(second, out=by_second).mul_(by_offset)
        by_hidden = by_second * second
        by_second.mul_(hidden)
        torch.ops.aten.elu_backward.grad_input(by_hidden, 1.0, 1.0, 1.0, True, hidden, grad_input=by_bias)
        torch.sgn(first, out=by_first).mul_(by_bias.unsqueeze(1))
        by_own = (by_first * first).sum(2)
        by_first.mul_(own.unsqueeze(2))
        return by_own, by_rows, None


def _weights(rows: Tensor, num_agents: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return W_1 [S, N, M, B], b_1 [S, M, B], w_2 [S, M, B] and b_2 [S, 1, B]."""
    first, bias, second, offset = rows.split((num_agents * width, width, width, 1), 1)
    return first.unflatten(1, (num_agents, width)), bias, second, offset
