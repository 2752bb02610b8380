"""Predict what follows a step: a regression on products and bumps, cells and a network, each on what is left over."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from esp_cli.algorithms.adam import SeedAdam
from esp_cli.checking.controls import STILL, planes
from esp_cli.checking.recorded import Transitions
from esp_envs.spec import Discrete, Spaces, others_of

_HIDDEN, _BATCH, _UPDATES, _RATE = 64, 256, 600, 5e-3
_RIDGE, _LEAST = 1e-2, 1e-9
_WIDEST_PAIRS, _WIDEST_OTHERS = 48, 160  # most numbers of an agent with products, and of others that are seen
_BUMPS, _BREADTH = 32, 0.6  # bumps for each vector, and how broad one is, in standard deviations of the vector
_CELLS = 24  # parts of each number of a vector, of equally many steps, in which what has sharp edges is averaged
_ROUNDING = 1e-3
_CHUNK = 512  # episodes whose features are held at once


class Predictor:
    """Predicts `outputs` [M, T, N, O] of each agent and step from what agents see and do, and `functions` [M, T, N, B].

    The regression is on what all agents see and do, products of two of an agent's own numbers, what each agent does,
    and bumps of each vector. It alone predicts the functions.
    """

    def __init__(self, spaces: Spaces, data: Transitions, outputs: Tensor, functions: Tensor) -> None:
        self._spaces, self._count = spaces, outputs.shape[-1]
        x = self._seen(data)
        self._centre, self._width = x.mean((0, 1, 2)), x.std((0, 1, 2)).clamp_min(STILL)
        rows = self._standard(x).flatten(0, 2)
        self._range = rows.min(0).values - _ROUNDING, rows.max(0).values + _ROUNDING
        picked = torch.randint(len(rows), (_BUMPS,), generator=torch.Generator().manual_seed(0))
        self._planes = torch.tensor(planes(spaces.observation, data.obs))
        self._middles = rows[picked][:, self._planes]
        self._weights = self._regressed(data, torch.cat([outputs, functions], -1))
        rest = (outputs - self._linear(data)[..., : self._count]).flatten(0, 2)
        self._cells = _Cells(rows[:, self._planes], rest)
        rest = rest - self._cells(rows[:, self._planes])
        self._scale = torch.maximum(rest.std(0), 1e-3 * outputs.flatten(0, 2).std(0)).clamp_min(STILL)
        self._net = _Network(rows, rest / self._scale)

    @torch.no_grad()
    def __call__(self, data: Transitions) -> tuple[Tensor, Tensor]:
        """Return what is expected to follow, [M, T, N, O], and the functions, [M, T, N, B]."""
        outputs, functions = self._linear(data).tensor_split([self._count], -1)
        rows = self._standard(self._seen(data)).flatten(0, 2)
        rest = self._net(rows) * self._scale + self._cells(rows[:, self._planes])
        return outputs + rest.view_as(outputs), functions

    def covers(self, data: Transitions) -> Tensor:
        """Return for which steps [M, T, N] each number that is seen or done lies in the range of what was fitted."""
        x, (low, high) = self._standard(self._seen(data)), self._range
        return ((x >= low) & (x <= high)).all(-1)

    def _regressed(self, data: Transitions, outputs: Tensor) -> Tensor:
        """Return weights [features, O + B]."""
        gram = cross = torch.zeros(())
        for start in range(0, len(outputs), _CHUNK):
            where = slice(start, start + _CHUNK)
            x = self._features(data.episodes(where)).flatten(0, 2).unsqueeze(0)
            y = outputs[where].flatten(0, 2).unsqueeze(0)
            gram, cross = gram + (x.mT @ x).double(), cross + (x.mT @ y).double()
        held = _RIDGE * torch.diag_embed(gram.diagonal(dim1=-2, dim2=-1).clamp_min(_LEAST))
        return torch.linalg.solve(gram + held, cross).float()[0]

    def _linear(self, data: Transitions) -> Tensor:
        parts = (data.episodes(slice(start, start + _CHUNK)) for start in range(0, len(data.obs), _CHUNK))
        return torch.cat([self._features(part) @ self._weights for part in parts])

    def _features(self, data: Transitions) -> Tensor:
        agents = self._spaces.num_agents
        seen = self._standard(self._seen(data))
        vectors = seen[..., self._planes].unsqueeze(-3)
        bumps = (-(vectors - self._middles).square().sum(-1) / (2 * _BREADTH**2)).exp().flatten(-2)
        parts = [self._products(data), bumps]
        if agents > 1:
            own = torch.cat([torch.ones_like(seen[..., :1]), done(data, self._spaces)], -1)
            parts.append((torch.eye(agents).unsqueeze(-1) * own.unsqueeze(-2)).flatten(-2))
        return torch.cat(parts, -1)

    def _products(self, data: Transitions) -> Tensor:
        """Return 1, what each agent sees and does, products of two of these numbers, and the others' numbers."""
        acted = done(data, self._spaces)
        acted = acted[..., 1:] if isinstance(self._spaces.action, Discrete) else acted
        columns = torch.cat([data.obs, acted], -1).movedim(-1, 0).contiguous()  # [numbers, M, T, N]
        orders, numbers = self._orders, len(columns)
        known = columns if len(orders) * numbers <= _WIDEST_OTHERS else columns[self._spaces.observation.width :]
        paired = numbers if numbers <= _WIDEST_PAIRS else 0
        products = [columns[k:] * columns[k] for k in range(paired)]
        parts = [torch.ones_like(columns[:1]), columns, *products, *(known[..., order] for order in orders)]
        return torch.cat(parts).movedim(0, -1)

    @property
    def _orders(self) -> list[list[int]]:
        """Who is each agent's first other, second other and so on, in index order: N - 1 lists of N agents."""
        return [list(order) for order in zip(*others_of(self._spaces.num_agents), strict=True)]

    def _standard(self, x: Tensor) -> Tensor:
        return (x - self._centre) / self._width

    def _seen(self, data: Transitions) -> Tensor:
        """Return what each agent sees and does, what the others do, and who it is: [M, T, N, numbers]."""
        acted, agents = done(data, self._spaces), self._spaces.num_agents
        others = [acted[:, :, order] for order in self._orders]
        return torch.cat([data.obs, acted, *others, torch.eye(agents).expand(*data.obs.shape[:3], -1)], -1)


def done(data: Transitions, spaces: Spaces) -> Tensor:
    """Return actions as numbers [M, T, N, A], a discrete one as one for each choice."""
    action = spaces.action
    return F.one_hot(data.action, action.count).float() if isinstance(action, Discrete) else data.action


class _Cells:
    """Means of y [rows, O] in cells of each vector [rows, planes, 2] in turn, shrunk as far as noise makes them."""

    def __init__(self, vectors: Tensor, y: Tensor) -> None:
        levels = torch.linspace(0, 1, _CELLS + 1)[1:-1]
        self._edges = torch.quantile(vectors[: 1 << 14], levels, 0).movedim(0, -1).contiguous()
        self._means = []
        for cells in self._of(vectors).unbind(1):
            count = torch.bincount(cells, minlength=_CELLS**2).unsqueeze(1).float()
            mean = torch.zeros(_CELLS**2, y.shape[1]).index_add(0, cells, y) / count.clamp_min(1)
            noise = y.var(0)
            share = (count * mean.square()).sum(0) / len(y) - noise * (count > 0).sum() / len(y)
            held = share.clamp_min(0) / (share.clamp_min(0) + noise / count.clamp_min(1)).clamp_min(1e-20)
            self._means.append(held * mean)
            y = y - self._means[-1][cells]

    def __call__(self, vectors: Tensor) -> Tensor:
        """Return what is expected, [rows, outputs]."""
        cells = self._of(vectors)
        return torch.stack([mean[cells[:, k]] for k, mean in enumerate(self._means)]).sum(0)

    def _of(self, vectors: Tensor) -> Tensor:
        """Return the cell of each vector, [rows, planes]."""
        places = [
            torch.searchsorted(edges, part.contiguous())
            for edges, part in zip(self._edges.flatten(0, 1), vectors.flatten(1).unbind(1), strict=True)
        ]
        x, y = torch.stack(places, 1).unflatten(1, (-1, 2)).unbind(-1)
        return x * _CELLS + y


class _Network:
    """Two hidden layers, fitted by least squares to [rows, inputs] and [rows, outputs]."""

    def __init__(self, x: Tensor, y: Tensor) -> None:
        generator = torch.Generator().manual_seed(0)
        parameters = []
        for fan_in, fan_out in itertools.pairwise((x.shape[1], _HIDDEN, _HIDDEN, y.shape[1])):
            bound = fan_in**-0.5
            drawn = [torch.rand(1, rows, fan_out, generator=generator) * 2 - 1 for rows in (fan_in, 1)]
            parameters += [nn.Parameter(part * bound) for part in drawn]
        adam = SeedAdam(parameters, learning_rate=_RATE, epsilon=1e-8, max_grad_norm=1.0)
        self._layers = list(zip(adam.parameters.parameters[::2], adam.parameters.parameters[1::2], strict=True))
        for k in range(_UPDATES):
            rows = torch.randint(len(x), (_BATCH,), generator=generator)
            adam.anneal(1 - k / _UPDATES)
            adam.step(adam.gradient((self(x[rows]) - y[rows]).square().mean()))

    def __call__(self, x: Tensor) -> Tensor:
        for k, (weight, bias) in enumerate(self._layers):
            x = torch.addmm(bias[0], x.relu() if k else x, weight[0])
        return x
