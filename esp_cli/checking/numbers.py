"""Linear maps of the numbers that an agent sees and does, and a search for those that leave moments as they are.

If a map is a symmetry of starts, policy, dynamics and reward, a transition and its image have one distribution, and

    E[z z'], E[(next - obs) z'], E[r z z'], E[r z^2 z'^2],    z = what is seen and done, and 1,

are equal for both. The search sets one number after the other to a place and a sign, as the automorphisms of a coloured
graph are found, and gives up where a moment says no.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from esp_cli.checking.recorded import Transitions
from esp_cli.checking.verdicts import SIGNIFICANT

_LEAVES = 16
"""Maps that are tested for one number and one place, at most."""
_NODES = 20_000
"""Partial maps that are looked at for one number and one place, at most."""
_ROUNDING = 1e-6
_EPISODES = 16_384
"""Episodes whose moments are taken, at most."""
_STILL = 1e-5
"""Spread of a number, against its largest value, below which it does not change."""


@dataclass(frozen=True)
class NumberMap:
    """A linear map of the numbers that one agent sees and does; agents keep their places.

    Attributes:
        name: "0>1 1>-0, does 1>3 3>2": what each number becomes; "57 degrees in (0,1) (2,3)".
        matrix: [D + A, D + A], a row z becomes z matrix.
        width: D.
        centre: [D], the fixed point: zero, but for numbers whose mean is not.
    """

    name: str
    matrix: Tensor
    width: int
    centre: Tensor

    def image(self, data: Transitions) -> Transitions:
        """Return mapped transitions."""
        seen, done = self.matrix[: self.width, : self.width], self.matrix[self.width :, self.width :]
        action = data.action @ done if data.action.is_floating_point() else done.argmax(1)[data.action]
        obs, next_obs = ((part - self.centre) @ seen + self.centre for part in (data.obs, data.next_obs))
        return Transitions(obs, action, data.reward, next_obs)


def changing(rows: Tensor) -> Tensor:
    """Return which numbers of rows [..., D] are not always the same, [D] bool."""
    rows = rows.flatten(0, -2)
    return rows.std(0) > _STILL * rows.abs().amax(0)


def done(data: Transitions, actions: int | None) -> Tensor:
    """Return the numbers that say what each agent does, [M, T, N, A]; a discrete action as one number per choice."""
    return data.action if actions is None else F.one_hot(data.action, actions).float()


class Moments:
    """Moments of what is seen and done, and the maps that leave them as they are, up to chance.

    Attributes:
        live: the numbers that change, in order.
        gave_up: whether a search ended early, so that there may be maps that it did not find.
    """

    def __init__(self, data: Transitions, actions: int | None) -> None:
        self.width, self._discrete = data.obs.shape[-1], actions is not None
        acted = done(data, actions)
        mean = data.obs.mean((0, 1, 2))
        error = data.obs.mean((1, 2)).std(0) / len(data.obs) ** 0.5
        self.centre = torch.where(mean.abs() > SIGNIFICANT * error, mean, 0.0)
        seen = data.obs - self.centre
        self.size = self.width + acted.shape[-1]
        live = changing(torch.cat([data.obs, acted], -1))
        self.gave_up = False
        self.live = [number for number in range(self.size) if live[number]]
        z = torch.cat([seen, acted, torch.ones_like(seen[..., :1])], -1)
        change = F.pad(data.next_obs - data.obs, (0, z.shape[-1] - self.width))
        reward = (data.reward - data.reward.mean()).unsqueeze(-1)
        signed = [_moments(left, z) for left in (z, change, reward * z)]
        self._kinds = [(kind, True) for kind in signed] + [(_moments(reward * z.square(), z.square()), False)]

    def places(self, number: int) -> list[tuple[int, int]]:
        """Return the places, with signs, that a number can become at all."""
        seen = number < self.width
        signs = (1, -1) if seen or not self._discrete else (1,)
        return [(place, sign) for place in self.live if (place < self.width) == seen for sign in signs]

    def maps(self, number: int, place: tuple[int, int]) -> Iterator[NumberMap]:
        """Yield maps that take a number to a place, and leave those before it where they are."""
        first = [(before, 1) for before in self.live if before < number]
        if (place[0], 1) in first:
            return
        budget = [_NODES]
        for leaves, chosen in enumerate(self._extended([*first, place], budget)):
            if leaves == _LEAVES:
                self.gave_up = True
                return
            yield self._map(chosen)
        self.gave_up |= budget[0] < 0

    def _extended(self, chosen: list[tuple[int, int]], budget: list[int]) -> Iterator[list[tuple[int, int]]]:
        budget[0] -= 1
        if budget[0] < 0 or not self._fits(chosen):
            return
        if len(chosen) == len(self.live):
            yield chosen
            return
        taken = {place for place, _ in chosen}
        for place in self.places(self.live[len(chosen)]):
            if place[0] not in taken:
                yield from self._extended([*chosen, place], budget)

    def _fits(self, chosen: Sequence[tuple[int, int]]) -> bool:
        """Return whether the moments of the last number chosen with those before it agree with their images."""
        rank, (place, sign), constant = len(chosen) - 1, chosen[-1], self.size
        pairs = [(self.live[j], *chosen[j]) for j in range(rank + 1)] + [(constant, constant, 1)]
        number = self.live[rank]
        return all(
            self._same(number, other, place, there, sign * way) and self._same(other, number, there, place, sign * way)
            for other, there, way in pairs
        )

    def _same(self, i: int, j: int, a: int, b: int, sign: int) -> bool:
        """Return whether the moments of (i, j) are those of (a, b), those of squares without a sign."""
        here, there = i * (self.size + 1) + j, a * (self.size + 1) + b
        for (mean, covariance), is_signed in self._kinds:
            way = sign if is_signed else 1
            variance = covariance[here, here] + covariance[there, there] - 2 * way * covariance[here, there]
            gap, size = float((mean[here] - way * mean[there]).abs()), float(mean[here].abs() + mean[there].abs())
            if gap > SIGNIFICANT * float(variance.clamp_min(0).sqrt()) + _ROUNDING * size + 1e-12:
                return False
        return True

    def _map(self, chosen: Sequence[tuple[int, int]]) -> NumberMap:
        matrix = torch.eye(self.size)
        texts: tuple[list[str], list[str]] = ([], [])
        for number, (place, sign) in zip(self.live, chosen, strict=True):
            matrix[number] = sign * F.one_hot(torch.tensor(place), self.size)
            if (number, 1) != (place, sign):
                first = 0 if number < self.width else self.width
                texts[first > 0].append(f"{number - first}>{'-' * (sign < 0)}{place - first}")
        seen, done = (" ".join(text) for text in texts)
        name = ", ".join(part for part in (seen, f"does {done}" if done else "") if part)
        return NumberMap(name, matrix, self.width, self.centre)


def _moments(left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Return E[left right'], flat, and the covariance matrix of that estimate; steps of one episode count once."""
    left, right = left[:_EPISODES], right[:_EPISODES]
    products = torch.einsum("mtni,mtnj->mij", left, right).flatten(1).double() / (left.shape[1] * left.shape[2])
    centred = products - products.mean(0)
    return products.mean(0), centred.mT @ centred / len(products) ** 2
