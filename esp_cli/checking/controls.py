"""Breakings of known size that are planted in transitions, to see whether a procedure would have found them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from esp_cli.checking.recorded import Transitions
from esp_cli.checking.shifting import leaves
from esp_envs.spec import Layout

STILL = 1e-6  # standard deviation below which a number does not change
_PLANES = 12  # vectors that are looked at one by one, at most
_COUNT = 28
_FEWEST = 0.8  # difference of a function from its image, squared, in variances, from which an element faces it


_PLACES = torch.tensor([[1.2, 0.3], [-0.8, 1.0], [-0.3, -1.4]])


def _angle(w: Tensor) -> Tensor:
    return torch.atan2(w[..., 1], w[..., 0])


def _away(w: Tensor) -> Tensor:
    """Return the distances from three places about the middle, [..., 3]."""
    return (w.unsqueeze(-2) - _PLACES).norm(dim=-1)


_SHAPES: tuple[Callable[[Tensor], Tensor], ...] = (
    lambda w: w[..., 0],
    lambda w: (w[..., 0] > 0.3).float(),
    lambda w: torch.cos(2 * _angle(w)),
    lambda w: torch.cos(3 * _angle(w)),
    lambda w: _away(w).amin(-1),
    lambda w: (_away(w) < 0.8).any(-1).float(),
    lambda w: w.abs().amax(-1),
)
"""Of a vector of unit variance: linear, a threshold, two harmonics, nearest place, one of three places, the larger."""


def planes(layout: Layout, obs: Tensor) -> list[list[int]]:
    """Return the numbers of obs [M, T, N, D] that change: vectors' two by two, and the others; of many, every k-th."""
    live = (obs.std((0, 1, 2)) > STILL).tolist()
    pairs, single = list[list[int]](), list[int]()
    for field, where in leaves(layout.fields):
        numbers = range(where.start, where.stop)
        if field.kind.is_vector:
            pairs += [[a, a + 1] for a in numbers[::2] if live[a] or live[a + 1]]
        else:
            single += [number for number in numbers if live[number]]
    pairs += [[a, single[k - 1]] for k, a in enumerate(single)]
    return pairs[:: -(-len(pairs) // _PLANES)] if pairs else [[0, 0]]


class Controls:
    """Functions of what an agent sees that most elements change, each of mean 0 and variance 1.

    Each is of one of seven shapes in one vector, turned by any angle; or it says which agent it is.
    """

    def __init__(self, layout: Layout, data: Transitions) -> None:
        self._pairs, self._agents = planes(layout, data.obs), data.obs.shape[2]
        self._centre, self._width = data.obs.mean((0, 1, 2)), data.obs.std((0, 1, 2)).clamp_min(STILL)
        angles = torch.rand(_COUNT, generator=torch.Generator().manual_seed(0)) * 2 * math.pi
        self._turns = torch.stack([angles.cos(), angles.sin(), -angles.sin(), angles.cos()], -1).view(-1, 2, 2)
        self._mean, self._scale = torch.zeros(()), torch.ones(())
        drawn = self(data)
        self._mean, self._scale = drawn.mean((0, 1, 2)), drawn.std((0, 1, 2)).clamp_min(STILL)

    def __call__(self, data: Transitions) -> Tensor:
        """Return the functions of some transitions, [M, T, N, functions]."""
        seen, found = (data.obs - self._centre) / self._width, []
        for k, turn in enumerate(self._turns):
            shape = _SHAPES[(k + k // len(self._pairs) // len(_SHAPES)) % len(_SHAPES)]
            found.append(shape(seen[..., self._pairs[k % len(self._pairs)]] @ turn))
        if self._agents > 1:
            found += torch.eye(self._agents)[: _COUNT // 4].expand(*seen.shape[:2], -1, -1).unbind(-2)
        return (torch.stack(found, -1) - self._mean) / self._scale


def strength(function: Tensor, image: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean squared change [functions] of each function [M, T, N, functions] by an element, and which count.

    The functions move along with the transitions to images, of which `image` are theirs; weights [M, T, N, 1] of steps.
    """
    size = (weight * (image - function).square()).mean((0, 1, 2))
    return size.clamp_min(_FEWEST), size > _FEWEST


class Sides(NamedTuple):
    """Predictions of what follows and of the controls, and what they are, [M, T, N, numbers] each."""

    said: Tensor
    true: Tensor
    planted_said: Tensor
    planted_true: Tensor

    def planted(self, number: int, amounts: Tensor) -> tuple[Tensor, Tensor]:
        """Return what is predicted of a number and what it is, with an amount [B] of each control added."""
        said, true = self.said[..., number, None], self.true[..., number, None]
        return said + amounts * self.planted_said, true + amounts * self.planted_true


def trust_in(said: Tensor, true: Tensor) -> Tensor:
    """Return by how much to shrink predictions so that they err least, 0 to 1: a predictor takes some noise for law."""
    return ((said * true).mean((0, 1, 2)) / said.square().mean((0, 1, 2)).clamp_min(1e-20)).clamp(0, 1)
