"""Worlds of many bodies: all pairs at once by broadcasting, of which only what grows with N k is kept."""

from __future__ import annotations

import torch
from torch import Tensor

from esp_envs.mpe.particles import CONTACT_MARGIN, Bodies, ParticleWorlds, contact_strength, lanes_of

MOST_BODIES = 8  # agents up to which pairs are listed and observations are one matrix product, then the faster way
BY_TREE = 200  # agents from which on the near ones are found by a tree, on the CPU: N log N, where all pairs are N^2
_PAIRS = 1 << 21  # pairs that are looked at together
_NO_PUSH = 60 * CONTACT_MARGIN  # gap between two rims from which on a push is 0 in float32


class ManyWorlds(ParticleWorlds):
    """W worlds in which all agents push each other apart; arguments as of `ParticleWorlds`, without lists of pairs.

    Each of the `crowd` first agents sees as many nearest others of the crowd, and landmarks, as `sees` says; 0 for all.
    `touching` [A, W'] counts the agents that touch each, `squared_to_landmarks` [L, W'] is from each landmark to its
    nearest agent, and `seen_agents` and `seen_landmarks` [W, crowd, k] are indices by distance, of k = 0 for all.
    """

    def __init__(
        self,
        bodies: Bodies,
        num_worlds: int,
        device: torch.device,
        velocity_first: bool,
        sees: int,
        crowd: int,
        solid: bool,
    ) -> None:
        agents, landmarks = bodies.num_agents, bodies.num_landmarks
        self._crowd, self._num_solid = crowd, agents + landmarks * solid
        self._sees = (min(sees, crowd - 1), min(sees, landmarks))
        self._radius = torch.tensor(bodies.radius, dtype=torch.float64, device=device)
        size = max(1, _PAIRS // (agents * (agents + landmarks)))
        self._chunks = [slice(k, min(k + size, num_worlds)) for k in range(0, num_worlds, size)]
        lanes, seen = lanes_of(num_worlds), (num_worlds, self._crowd)
        self.touching = torch.zeros(agents, lanes, device=device)
        self.squared_to_landmarks = torch.zeros(landmarks, lanes, device=device)
        self.seen_agents, self.seen_landmarks = (
            torch.zeros(*seen, count, dtype=torch.int64, device=device) for count in self._sees
        )
        self._near = torch.zeros(3, 0, dtype=torch.int64, device=device)  # before any are placed, no pairs
        super().__init__(bodies, num_worlds, device, velocity_first)

    def measure(self) -> None:
        """Look at all pairs in their present positions, or at the near ones where they are found by a tree."""
        if self._sees[0] and self.bodies.num_agents >= BY_TREE and self.entity.device.type == "cpu":
            near = [self._measure_by_tree(world) for world in range(self.num_worlds)]
        else:
            near = [self._measure_all(worlds) for worlds in self._chunks]
        self._near = torch.cat(near, 1)

    def _measure_all(self, worlds: slice) -> Tensor:
        """Look at all pairs of some worlds; return (world, agent, body) of those that are near, [3, P]."""
        agents, crowd, solid = self.bodies.num_agents, self._crowd, self._num_solid
        x, y = self.entity[:, :, worlds].permute(1, 2, 0).contiguous()  # [w, bodies] each
        square = (x[:, :agents, None] - x[:, None]).square_()
        square += (y[:, :agents, None] - y[:, None]).square_()
        square.diagonal(dim1=1, dim2=2).fill_(torch.inf)
        reach = self._radius[:agents, None] + self._radius
        touch = square[:, :, :agents] < reach[:, :agents].square().to(x.dtype)
        self.touching[:, worlds] = touch.sum(2).t().to(x.dtype)
        self.squared_to_landmarks[:, worlds] = square[:, :, agents:].amin(1).t()
        for seen, bodies in ((self.seen_agents, slice(crowd)), (self.seen_landmarks, slice(agents, None))):
            seen[worlds] = square[:, :crowd, bodies].topk(seen.shape[-1], -1, largest=False).indices
        near = square[:, :, :solid] < (reach[:, :solid] + _NO_PUSH).square().to(x.dtype)
        world, first, second = near.nonzero().unbind(1)
        return torch.stack([world + worlds.start, first, second])

    def _measure_by_tree(self, world: int) -> Tensor:
        """Find the near pairs of one world; see `_measure_all`."""
        from scipy.spatial import KDTree  # noqa: PLC0415 - few need it, and it takes long to import

        agents, solid = self.bodies.num_agents, self._num_solid
        entity = self.entity[:, :, world].nan_to_num()  # a seed that failed has NaN, which no tree takes
        crowd, landmark = entity[: self._crowd], entity[agents:]
        found = torch.from_numpy(KDTree(crowd.numpy()).query(crowd.numpy(), k=range(1, self._sees[0] + 2))[1])
        itself = found == torch.arange(len(crowd)).unsqueeze(1)  # once in a row, unless many are in one place
        self.seen_agents[world] = found.gather(1, itself.int().argsort(dim=1, stable=True)[:, : self._sees[0]])
        if len(landmark):
            ranks = range(1, self._sees[1] + 1)
            self.seen_landmarks[world] = torch.from_numpy(KDTree(landmark.numpy()).query(crowd.numpy(), k=ranks)[1])
            nearest = entity[torch.from_numpy(KDTree(entity[:agents].numpy()).query(landmark.numpy())[1])]
            self.squared_to_landmarks[:, world] = (nearest - landmark).square().sum(1)
        most = float(self._radius[:agents].max() + self._radius[:solid].max())
        pairs = KDTree(entity[:solid].numpy()).query_pairs(most + _NO_PUSH, output_type="ndarray")
        pairs = torch.from_numpy(pairs).long()
        pairs = torch.cat([pairs, pairs.flip(1)])
        pairs = pairs[pairs[:, 0] < agents]
        first, second = pairs.unbind(1)
        square = (entity[first] - entity[second]).square().sum(1)
        touch = (square < (self._radius[first] + self._radius[second]).square()) & (second < agents)
        self.touching[:, world] = torch.bincount(first[touch], minlength=agents).float()
        return torch.cat([torch.full((1, len(pairs)), world), pairs.t()])

    def _contact_impulses(self) -> Tensor:
        world, first, second = self._near
        offset = self.entity[first, :, world] - self.entity[second, :, world]
        padding = (0, -len(offset) % 64)  # vector code and its scalar tail round otherwise
        square = torch.nn.functional.pad(offset.square().sum(1), padding, value=1.0)
        touching = ((self._radius[first] + self._radius[second]) / CONTACT_MARGIN).to(square.dtype)
        strength = contact_strength(square, torch.nn.functional.pad(touching, padding))
        push = offset * strength[: len(offset), None]
        change = torch.zeros(2, self.velocity[:, 0].numel(), device=push.device)
        change.scatter_add_(1, (first * self.num_lanes + world).expand(2, -1), push.t())
        return change.view(2, *self.velocity[:, 0].shape).transpose(0, 1)


def ways_to(seen: Tensor, places: Tensor, here: Tensor) -> Tensor:
    """Return the ways [S, E, C, k, 2] from agents at `here` [S, E, C, 2] to those of places that they see [W, C, k]."""
    which = seen.view(*here.shape[:2], -1, 1).expand(-1, -1, -1, 2)
    return places.gather(2, which).unflatten(2, (here.shape[2], -1)) - here.unsqueeze(3)
