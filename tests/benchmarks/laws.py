"""Rewards, forces and noise of random tasks, by family: some members are symmetric, others broken."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from esp_envs.batched import to_others

Rng = np.random.Generator


class Scene(NamedTuple):
    """What a law may depend on; all but `time` [..., items, 2]."""

    p: Tensor
    v: Tensor
    marks: Tensor
    a: Tensor
    hidden: Tensor
    time: Tensor

    @property
    def to_marks(self) -> Tensor:
        """[..., N, L, 2]."""
        return self.marks.unsqueeze(-3) - self.p.unsqueeze(-2)

    @property
    def apart(self) -> Tensor:
        """Distances of agents, [..., N, N - 1]; of one alone, to the middle."""
        return to_others(self.p).norm(dim=-1) if self.p.shape[-2] > 1 else self.p.norm(dim=-1, keepdim=True)


Law = Callable[[Scene], Tensor]


def _unit(angle: float) -> Tensor:
    return torch.tensor([math.cos(angle), math.sin(angle)])


def _any(rng: Rng) -> Tensor:
    return _unit(rng.uniform(0, 2 * math.pi))


def _places(rng: Rng, count: int) -> Tensor:
    """Corners of a polygon about the middle, turned by anything."""
    phase = rng.choice([0.0, math.pi / 2, rng.uniform(0, 2 * math.pi)])
    return rng.uniform(0.4, 0.9) * torch.stack([_unit(phase + 2 * math.pi * k / count) for k in range(count)])


def _angle(x: Tensor) -> Tensor:
    return torch.atan2(x[..., 1], x[..., 0])


def _cross(x: Tensor, y: Tensor) -> Tensor:
    return x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]


def _turned(x: Tensor, angle: float) -> Tensor:
    return math.cos(angle) * x + math.sin(angle) * torch.stack([-x[..., 1], x[..., 0]], -1)


def rewards(rng: Rng, agents: int) -> dict[str, Law]:
    """Return a member of each family of rewards."""
    u, w, places = _any(rng), _any(rng), _places(rng, int(rng.integers(1, 7)))
    radius, size = float(rng.uniform(0.2, 0.35)), float(rng.uniform(0.3, 1.5))
    fold, phase, turn = int(rng.integers(2, 6)), float(rng.uniform(0, 6)), float(rng.choice([0.0, rng.uniform(0, 1.5)]))
    values, frame = torch.tensor([1.0, 1 + size, 1.0]), torch.stack([u, _turned(u, math.pi / 2)])
    weights = 1 + size * torch.arange(agents) * float(rng.choice([0.0, 1.0]))

    def apart(s: Scene) -> Tensor:
        return (s.p.unsqueeze(-2) - places).norm(dim=-1)

    return {
        "distance to the first mark": lambda s: -s.to_marks[..., 0, :].norm(dim=-1),
        "nearest mark": lambda s: -s.to_marks.norm(dim=-1).amin(-1),
        "every mark's nearest agent": lambda s: -s.to_marks.norm(dim=-1).amin(-2).sum(-1, True).expand_as(s.p[..., 0]),
        "one of some places": lambda s: (apart(s) < radius).any(-1).float(),
        "nearest of some places": lambda s: -apart(s).amin(-1),
        "an angle": lambda s: torch.cos(fold * _angle(s.p) + phase) * s.p.norm(dim=-1).clamp_max(1),
        "a threshold": lambda s: (s.p @ u > 0.2).float() - 0.5 * s.p.norm(dim=-1),
        "a square": lambda s: -_turned(s.p, turn).abs().amax(-1),
        "inside a square": lambda s: (_turned(s.p, turn).abs().amax(-1) < 0.6).float(),
        "a product of three": lambda s: (s.p @ u) * (s.p @ w) * (s.v @ u),
        "a symmetric product of three": lambda s: s.p.norm(dim=-1) ** 2 * (s.p * s.v).sum(-1),
        "a handed product": lambda s: _cross(s.p, s.v) * s.p.norm(dim=-1),
        "agents that count differently": lambda s: -s.to_marks[..., 0, :].norm(dim=-1) * weights,
        "marks that count differently": lambda s: -(s.to_marks.norm(dim=-1) * values[: s.marks.shape[-2]]).sum(-1),
        "touching": lambda s: -(s.apart < 0.4).float().sum(-1) - 0.3 * s.p.norm(dim=-1),
        "a slope": lambda s: -s.p.norm(dim=-1) + size * (s.p @ u),
        "a saddle": lambda s: (s.p @ u) ** 2 - (_turned(s.p, math.pi / 2) @ u) ** 2,
        "thrift": lambda s: -0.3 * s.a.norm(dim=-1) - s.to_marks[..., 0, :].norm(dim=-1),
        "a sector of sight": lambda s: (_angle(s.to_marks[..., 0, :] @ frame.T).abs() < 1).float(),
        "a ring": lambda s: ((s.p.norm(dim=-1) - 0.7).abs() < 0.25).float(),
        "a chessboard": lambda s: torch.sign(torch.sin(3 * _turned(s.p, turn)).prod(-1)),
        "a hidden side": lambda s: (s.p * s.hidden).sum(-1) * size - s.p.norm(dim=-1),
        "a late slope": lambda s: (s.p @ u) * (s.time[..., 0] > 3).float() * 2 * size - s.p.norm(dim=-1),
        "pace": lambda s: (s.v.norm(dim=-1) > 0.4).float() + (s.v @ u) * size * float(turn > 0),
    }  # fmt: skip


def forces(rng: Rng, agents: int) -> dict[str, Law]:
    u, place, size = _any(rng), _places(rng, 1)[0], float(rng.uniform(0.1, 0.5))
    turn = float(rng.choice([0.3, 0.7, math.pi / 4]))
    weak = torch.ones(agents)
    weak[0] = 0.4

    return {
        "none": lambda s: 0.3 * s.a,
        "drag": lambda s: 0.3 * s.a - 0.3 * s.v * s.v.norm(dim=-1, keepdim=True),
        "wind": lambda s: 0.3 * s.a + size * 0.3 * u,
        "turned actions": lambda s: 0.3 * _turned(s.a, turn),
        "mud on one side": lambda s: 0.3 * s.a - 0.6 * s.v * (s.p @ u > 0).float().unsqueeze(-1),
        "mud in a place": lambda s: 0.3 * s.a - 0.7 * s.v * ((s.p - place).norm(dim=-1, keepdim=True) < 0.5).float(),
        "a whirl": lambda s: 0.3 * s.a + size * _turned(s.p, math.pi / 2),
        "a spring": lambda s: 0.3 * s.a - size * s.p,
        "a pull to a place": lambda s: 0.3 * s.a + size * (place - s.p),
        "one strong axis": lambda s: 0.3 * s.a * torch.tensor([1.0, 1 - size]),
        "a weak agent": lambda s: 0.3 * s.a * weak.unsqueeze(-1),
        "saturation": lambda s: 0.3 * torch.tanh(2 * s.a) - 0.3 * torch.tanh(s.p),
        "late wind": lambda s: 0.3 * s.a + size * 0.5 * u * (s.time > 3).float(),
        "hidden wind": lambda s: 0.3 * s.a + 0.15 * s.hidden,
    }  # fmt: skip


def noises(rng: Rng) -> dict[str, tuple[Law, Law]]:
    """Return a member of each family of noise: deviations of the reward [..., N], and of speeds [..., N, 2]."""
    u, size = _any(rng), float(rng.uniform(0.1, 0.5))
    axis = torch.tensor([1.0, 0.1]) if rng.integers(2) else torch.tensor([1.0, 1.0])

    def zero(s: Scene) -> Tensor:
        return 0 * s.p[..., 0]

    return {
        "none": (zero, lambda s: 0 * s.p),
        "of the reward": (lambda s: size + zero(s), lambda s: 0 * s.p),
        "of speeds": (zero, lambda s: 0.1 * size * torch.ones_like(s.p)),
        "of both": (lambda s: size + zero(s), lambda s: 0.1 * size * torch.ones_like(s.p)),
        "that grows outwards": (
            lambda s: size * s.p.norm(dim=-1),
            lambda s: 0.1 * size * s.p.norm(dim=-1, keepdim=True).expand_as(s.p),
        ),
        "on one side": (lambda s: size * (1 + 2 * (s.p @ u > 0).float()), lambda s: 0 * s.p),
        "along an axis": (zero, lambda s: 0.2 * size * axis.expand_as(s.p)),
    }  # fmt: skip
