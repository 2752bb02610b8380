"""Parameters, gradients and moments of S seeds, each in one buffer: a clip, a step or a copy is one operation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from esp_cli.prior.losses import Loss

# numbers per seed are filled up to a multiple of this, so that no seed begins within a vector of the processor
_ALIGNED = 16
BETAS = (0.9, 0.999)


class SeedParameters:
    """Parameters of S seeds as views of one buffer [S, P]; changing the buffer changes the networks."""

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self.parameters = list(parameters)
        ends = torch.tensor([p[0].numel() for p in self.parameters]).cumsum(0).tolist()
        self._parts = list(pairwise([0, *ends]))
        self._places = {id(p): k for k, p in enumerate(self.parameters)}
        first = self.parameters[0]
        self._rest = first.new_zeros(first.shape[0], -ends[-1] % _ALIGNED)
        self.buffer = self.flat([p.detach() for p in self.parameters])
        for parameter, view in zip(self.parameters, self.views(self.buffer), strict=True):
            parameter.data = view

    def flat(self, tensors: Sequence[Tensor]) -> Tensor:
        """Return a new buffer [S, P] of tensors [S, ...] in the order of the parameters."""
        return torch.cat([*(tensor.flatten(1) for tensor in tensors), self._rest], 1)

    def sum(self, gradients: Sequence[tuple[Sequence[Tensor], Sequence[Tensor]]]) -> Tensor:
        """Return a new buffer [S, P] of the sum of gradients by some of the parameters.

        These follow each other here, with the gradients by each of them, or one by all side by side.
        """
        parts, rest = [], []
        at = 0
        for parameters, by_parameters in sorted(gradients, key=lambda pair: self._places[id(pair[0][0])]):
            first = self._places[id(parameters[0])]
            if first < at:
                rest.append((parameters, by_parameters))
                continue
            parts += [torch.zeros_like(p) for p in self.parameters[at:first]] + [*by_parameters]
            at = first + len(parameters)
        total = self.flat([*parts, *(torch.zeros_like(p) for p in self.parameters[at:])])
        return total.add_(self.sum(rest)) if rest else total

    def views(self, buffer: Tensor) -> list[Tensor]:
        """Return the part of a buffer [S, P] that belongs to each parameter, in its shape."""
        return [
            buffer[:, begin:end].unflatten(1, parameter.shape[1:])
            for (begin, end), parameter in zip(self._parts, self.parameters, strict=True)
        ]


class SeedAdam:
    """Adam (Kingma and Ba, 2015) for S seeds, with the gradients of each seed clipped to a joint norm in each group.

    m <- b1 m + (1 - b1) g, v <- b2 v + (1 - b2) g^2, p <- p - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + epsilon).
    `learning_rate` is lr of the next step, as it may be annealed.
    """

    def __init__(
        self, *groups: Sequence[nn.Parameter], learning_rate: float, epsilon: float, max_grad_norm: float
    ) -> None:
        self.parameters = SeedParameters([parameter for group in groups for parameter in group])
        self.learning_rate = self.initial_learning_rate = learning_rate
        self.epsilon, self.max_grad_norm = epsilon, max_grad_norm
        ends = torch.tensor([sum(p[0].numel() for p in group) for group in groups]).cumsum(0).tolist()
        self._groups = list(pairwise([0, *ends]))
        buffer = self.parameters.buffer
        self.mean, self.square = torch.zeros_like(buffer), torch.zeros_like(buffer)
        self.count = buffer.new_zeros(())

    def anneal(self, remaining: float) -> None:
        """Set the learning rate to this share of what it was made with."""
        self.learning_rate = self.initial_learning_rate * remaining

    def gradient(self, loss: Loss | Tensor) -> Tensor:
        """Return the gradients [S, P] of the losses [S] of all seeds."""
        loss = loss if isinstance(loss, Loss) else Loss.of(loss)
        return self.parameters.sum(loss.gradients(self.parameters.parameters))

    def step(self, loss: Loss | Tensor) -> list[Tensor]:
        """Take one step down the losses [S] of all seeds; return each group's gradient norms [S] before clipping."""
        return self.apply(self.gradient(loss))

    @torch.no_grad()
    def apply(self, gradient: Tensor) -> list[Tensor]:
        """Clip the gradients [S, P] in place and take one step; return each group's norms [S] before clipping."""
        norms = clip_per_seed([gradient[:, begin:end] for begin, end in self._groups], self.max_grad_norm)
        self.count += 1
        torch._fused_adam_(  # what torch.optim.Adam calls, whose Python takes longer than the step
            [self.parameters.buffer],
            [gradient],
            [self.mean],
            [self.square],
            [],
            [self.count],
            lr=self.learning_rate,
            beta1=BETAS[0],
            beta2=BETAS[1],
            weight_decay=0.0,
            eps=self.epsilon,
            amsgrad=False,
            maximize=False,
        )
        return norms

    def state_dict(self) -> dict[str, Tensor]:
        """Return the moments of every parameter under its number; nothing before the first step."""
        return self._moments() if self.count else {}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        own = self._moments()
        for name in own.keys() | tensors.keys() if tensors else ():
            if name not in own or name not in tensors or tensors[name].shape != own[name].shape:
                raise KeyError(f"the moments of parameter {name.partition('.')[0]}")
        for name, moment in own.items():
            moment.copy_(tensors.get(name, torch.zeros_like(moment)))

    def _moments(self) -> dict[str, Tensor]:
        out: dict[str, Tensor] = {}
        moments = zip(self.parameters.views(self.mean), self.parameters.views(self.square), strict=True)
        for k, (mean, square) in enumerate(moments):
            out |= {f"{k}.step": self.count, f"{k}.exp_avg": mean, f"{k}.exp_avg_sq": square}
        return out


def clip_per_seed(groups: Sequence[Tensor], max_norm: float) -> list[Tensor]:
    """Scale each seed's gradients of every group [S, P] in place to at most `max_norm`; return norms [S] before."""
    norms = torch.stack([torch.linalg.vector_norm(gradient, dim=1) for gradient in groups])
    if norms.is_cpu and norms.max().item() + 1e-6 <= max_norm:  # a GPU would be waited for
        return [*norms.unbind(0)]
    scales = (norms + 1e-6).reciprocal_().mul_(max_norm).clamp_max_(1.0).unsqueeze(2)
    for gradient, scale in zip(groups, scales.unbind(0), strict=True):
        gradient.mul_(scale)
    return [*norms.unbind(0)]
