"""What a policy's outputs mean: a categorical choice or a bounded Gaussian, chosen by the task's action space.

The heads of learners that explore by a schedule of their own are in `exploration`.

A head first normalises a network's outputs (once), then turns them into actions, log-probabilities, entropies and
divergences. What it normalised is one number per action, or the numbers of one, so that any symmetry pulls it back.
Shapes: outputs [S, ..., N, outputs], action [S, ..., N] (discrete) or [S, ..., N, width].
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding

from esp_cli.networks.contract import WithVJP
from esp_cli.networks.kernels.library import computes
from esp_cli.networks.policies import (
    CategoricalPolicies,
    CompiledCategoricalPolicies,
    GaussianPolicies,
    Policies,
)
from esp_cli.symmetry.frame import Frame
from esp_envs.spec import Continuous, Discrete

_INITIAL_STD = 0.6
MASKED = -1e9  # output of an action that is not allowed: its probability is exactly 0, and it is never the best


def masked(outputs: Tensor, action_mask: Tensor | None) -> Tensor:
    """Return outputs [..., A], without gradient `MASKED` where the mask forbids; a row that allows nothing stays."""
    if action_mask is None:
        return outputs
    return outputs.masked_fill(~action_mask & action_mask.any(-1, keepdim=True), MASKED)


def drawn(draw: Callable[..., Tensor], shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
    """Return [S, *shape] numbers, by `torch.rand` or `torch.randn`, per seed from its own generator, on its device."""
    return torch.stack([draw(tuple(shape), generator=g, device=g.device) for g in generators])


class Head(nn.Module, ABC):
    """Reads actions out of a network's outputs; what every learner's policy has at its end."""

    num_outputs: int  # numbers that it reads of an agent; an encoded action has as many
    masks: bool = False  # whether outputs come with masked actions
    compiled: bool = False  # whether losses of outputs on the CPU go through the compiled kernel

    @abstractmethod
    def noise(self, shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
        """Draw what `sample` needs for actions of `shape`, per seed from its own generator: [S, *shape(, ...)]."""

    def normalise(self, outputs: Tensor) -> Tensor:
        """Return the form of the outputs that all other methods take: as they are, unless a head says more."""
        return outputs

    @abstractmethod
    def sample(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Return a drawn action."""

    @abstractmethod
    def mode(self, outputs: Tensor) -> Tensor:
        """Return the greedy action."""

    def to_environment(self, action: Tensor) -> Tensor:
        """Return what `Environment.step` takes: the action as it is, unless a head says more."""
        return action

    def encode(self, action: Tensor) -> Tensor:
        """Return actions as numbers that a network can read [..., N, outputs]: those of a continuous one."""
        return self.to_environment(action)


class Choice(Head):
    """A head that chooses one of A actions."""

    def __init__(self, space: Discrete, num_seeds: int = 1) -> None:
        super().__init__()
        self.num_outputs = space.count

    def encode(self, action: Tensor) -> Tensor:
        return embedding(action, torch.eye(self.num_outputs, device=action.device))


class Categorical(Choice):
    """One of A actions with probabilities softmax(outputs)."""

    def noise(self, shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
        return drawn(torch.rand, shape, generators)

    def normalise(self, outputs: Tensor) -> Tensor:
        # With the action axis outermost in memory: over so few actions, softmax along the contiguous axis is 25 times
        # slower on a CPU than over vectors of rows.
        return torch.log_softmax(outputs.movedim(-1, 1).contiguous(), 1).movedim(1, -1)

    def sample(self, log_probs: Tensor, noise: Tensor) -> Tensor:
        """Draw an action by inverting the cumulative distribution at `noise`."""
        cumulative = log_probs.exp().cumsum(-1)
        if not self.masks:
            return (cumulative < noise.unsqueeze(-1)).sum(-1).clamp_(max=self.num_outputs - 1)
        # Within the sum of the probabilities and above 0, so that rounding chooses no action of probability 0.
        inside = noise.unsqueeze(-1).clamp_min(torch.finfo(noise.dtype).tiny).minimum(cumulative[..., -1:])
        return (cumulative < inside).sum(-1)

    def mode(self, log_probs: Tensor) -> Tensor:
        return best(log_probs)

    def log_prob(self, log_probs: Tensor, action: Tensor) -> Tensor:
        return log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)

    def entropy(self, log_probs: Tensor) -> Tensor:
        """Return - sum_a pi(a) log pi(a): [S, B, N]."""
        return -(log_probs.exp() * log_probs).sum(-1)

    def policies(self, outputs: WithVJP, frame: Frame) -> Policies:
        """Return the policies that outputs [S, P B, T, N, A] are, for losses with slopes."""
        compiled = outputs.waits or computes(self.compiled, outputs.tensor)
        orders = frame.orders(self.num_outputs) if compiled else None
        if orders is None:
            return CategoricalPolicies(outputs, frame)
        return CompiledCategoricalPolicies(outputs, frame, orders)


class Bounded(Head):
    """A head whose actions are numbers within bounds."""

    def __init__(self, space: Continuous, num_seeds: int) -> None:
        super().__init__()
        self.num_outputs = space.width
        self.disc: Tensor
        self.register_buffer("disc", same_disc(space), False)

    def noise(self, shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
        return drawn(torch.randn, (*shape, self.num_outputs), generators)


class BoundedGaussian(Bounded):
    """A Gaussian over an unbounded latent action, squashed to the task's bounds when it is sent to the task.

    outputs are the latent means; the log standard deviation is one learned number per item of the action layout (so
    that rotations and reflections only move the mean). Log-probability, entropy and divergence are those of the
    latent: the squash is a fixed bijection, so ratios and divergences are the same after it.
    A planar vector u is squashed radially, u tanh|u| / |u|, which commutes with every rotation; other numbers by tanh.
    """

    def __init__(self, space: Continuous, num_seeds: int) -> None:
        super().__init__(space, num_seeds)
        items = [f.kind for f in space.layout.fields for _ in range(f.count)]
        self.log_std = nn.Parameter(torch.full((num_seeds, len(items)), math.log(_INITIAL_STD)))
        self.item: Tensor
        item = torch.tensor([k for k, kind in enumerate(items) for _ in range(kind.width)])
        self.register_buffer("item", item, False)

    def log_deviation(self, like: Tensor) -> Tensor:
        """Return the log deviation of each number, shaped to stand beside `like`: [S, ..., width]."""
        return self.log_std[:, self.item].view(-1, *[1] * (like.dim() - 2), self.num_outputs)

    def policies(self, outputs: WithVJP, frame: Frame) -> GaussianPolicies:
        """Return the policies that outputs [S, P B, T, N, width] are, for losses with slopes."""
        return GaussianPolicies(outputs, frame, self.log_std, self.item)

    def sample(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Return the latent action mean + std * noise."""
        return outputs + self.log_deviation(outputs).exp() * noise

    def mode(self, outputs: Tensor) -> Tensor:
        return outputs

    def log_prob(self, outputs: Tensor, action: Tensor) -> Tensor:
        log_std = self.log_deviation(outputs)
        z = (action - outputs) * (-log_std).exp()
        return -(0.5 * z.square() + log_std + 0.5 * math.log(2 * math.pi)).sum(-1)

    def entropy(self, outputs: Tensor) -> Tensor:
        entropy = (self.log_deviation(outputs) + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)
        return entropy.expand(outputs.shape[:-1])

    def to_environment(self, action: Tensor) -> Tensor:
        return squash(action, self.disc)


def best(values: Tensor) -> Tensor:
    """Return the index of the largest number along the last axis (argmax is 8 times slower on these layouts)."""
    return values.max(-1).indices


def same_disc(space: Continuous) -> Tensor:
    """Return the [width, width] 0/1 matrix that is 1 between numbers of one vector, and on the diagonal."""
    items = [f.kind for f in space.layout.fields for _ in range(f.count)]
    blocks = [torch.ones(k.width, k.width) if k.is_vector else torch.eye(k.width) for k in items]
    return torch.block_diag(*blocks)


def squash(action: Tensor, disc: Tensor) -> Tensor:
    """Map unbounded actions [..., width] into the bounds, vectors along their length: u tanh|u| / |u|."""
    length = (action.square() @ disc + 1e-18).sqrt()
    return action * (torch.tanh(length) / length)
