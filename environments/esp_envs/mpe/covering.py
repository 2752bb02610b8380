"""Hand-written policies of cooperative navigation: who goes where, and how to get there.

Everything works on all worlds at once, with the worlds on the last axis W.
"""

from __future__ import annotations

import itertools
from functools import cache

import torch
from torch import Tensor

MOST_PLACES = 64  # that `places` should look for, for which it takes a second or two
_STARTS, _WEISZFELD_STEPS = 16, 60
MAX_SHARINGS = 4096  # most ways of sharing out landmarks that `shared_out` should try
MOST_ASSIGNED = 2000  # agents or landmarks that `assigned` shares out by the Hungarian method, whose time is cubic
TRAVEL_WEIGHT = 0.25  # of the distance to travel against that which remains, in `shared_out`; found by search


@cache
def places(count: int) -> Tensor:
    """Return the places [K, 2] from which the nearest is least far, in the mean, from a point of [-1, 1]^2.

    Weiszfeld's steps, each place towards the points nearest to it; the best of some random starts.
    """
    side = torch.linspace(-0.975, 0.975, 40)
    points = torch.cartesian_prod(side, side)
    generator = torch.Generator().manual_seed(0)
    found = torch.rand(_STARTS, count, 2, generator=generator) * 2 - 1
    for _ in range(_WEISZFELD_STEPS):
        distance = torch.cdist(points, found).clamp_min(1e-6)
        own = torch.nn.functional.one_hot(distance.argmin(2), count) / distance
        found = (own.transpose(1, 2) @ points) / own.sum(1).clamp_min(1e-6).unsqueeze(-1)
    return found[torch.cdist(points, found).amin(2).mean(1).argmin()]


def one_each(position: Tensor, landmark: Tensor) -> Tensor:
    """Give each agent [N, 2, W] a landmark [L, 2, W]: the nearest free pair first, then swaps; others stay."""
    agents, landmarks = position.shape[0], landmark.shape[0]
    distance = (position.unsqueeze(1) - landmark.unsqueeze(0)).norm(dim=2)
    idle = distance.new_zeros(agents, max(agents - landmarks, 0), distance.shape[-1])
    choice = _nearest_pairs_first(distance)
    distance = torch.cat([distance, idle], dim=1)
    for a, b in itertools.combinations(range(agents), 2):
        own = distance[a].gather(0, choice[a : a + 1]) + distance[b].gather(0, choice[b : b + 1])
        swapped = distance[a].gather(0, choice[b : b + 1]) + distance[b].gather(0, choice[a : a + 1])
        pair = choice[[a, b]]
        choice[[a, b]] = torch.where(swapped < own, pair.flip(0), pair)
    goals = landmark.gather(0, choice.clamp_max(landmarks - 1).unsqueeze(1).expand(-1, 2, -1))
    return torch.where((choice < landmarks).unsqueeze(1), goals, position)


def assigned(position: Tensor, landmark: Tensor) -> Tensor:
    """Give each agent a landmark of its own so that the sum of distances is least (Hungarian method); see `one_each`.

    Beyond `MOST_ASSIGNED` an agent takes the nearest landmark that no nearer agent wants, round after round.
    """
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415 - few need it, and it takes long to import

    goals = position.clone()
    for world in range(position.shape[2]):
        here, there = position[:, :, world], landmark[:, :, world]
        if max(len(here), len(there)) <= MOST_ASSIGNED:
            agents, taken = (torch.from_numpy(x) for x in linear_sum_assignment(torch.cdist(here, there).cpu().numpy()))
        else:
            agents, taken = _wanted_most(here, there)
        goals[agents, :, world] = there[taken]
    return goals


def _wanted_most(here: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    """Return pairs of agents and landmarks: each round an agent asks for the nearest free landmark."""
    agents, free, pairs = torch.arange(len(here)), torch.arange(len(there)), []
    while len(agents) and len(free):
        distance, asked = torch.cdist(here[agents], there[free]).min(1)
        nearest_first = distance.argsort()
        first = torch.full((len(free),), len(agents))
        first.scatter_reduce_(0, asked[nearest_first], torch.arange(len(agents)), "amin")
        got = nearest_first[first[first < len(agents)]]
        pairs.append(torch.stack([agents[got], free[asked[got]]]))
        agents = agents[~torch.isin(agents, pairs[-1][0])]
        free = free[~torch.isin(free, pairs[-1][1])]
    agents, taken = torch.cat(pairs, 1)
    return agents, taken


def _nearest_pairs_first(distance: Tensor) -> Tensor:
    """Return by distances [N, L, W] the landmark index [N, W] of each agent; agents left over get L, L + 1, ..."""
    agents, landmarks, worlds = distance.shape
    agent_index = torch.arange(agents, device=distance.device).view(-1, 1, 1)
    target_index = torch.arange(landmarks, device=distance.device).view(1, -1, 1)
    choice = torch.full((agents, worlds), -1, device=distance.device)
    free = distance
    for _ in range(min(agents, landmarks)):
        pair = free.reshape(agents * landmarks, worlds).argmin(0)
        agent, target = pair // landmarks, pair % landmarks
        choice.scatter_(0, agent.unsqueeze(0), target.unsqueeze(0))
        free = free.masked_fill((agent_index == agent) | (target_index == target), torch.inf)
    idle = choice < 0
    return torch.where(idle, landmarks - 1 + idle.cumsum(0), choice)


def shared_out(position: Tensor, landmark: Tensor) -> Tensor:
    """Share out all landmarks among the agents and send each agent to the best place for its share.

    An agent with one landmark goes to it; with two, to the nearest point between them (every point of the segment has
    the same sum of distances); with more, to the one of them with the least sum of distances. Among all sharings the
    one with the least remaining distance plus TRAVEL_WEIGHT times the distance to travel is taken.
    N^L ways are tried, for which `MAX_SHARINGS` is a good limit.
    """
    agents, landmarks = position.shape[0], landmark.shape[0]

    @cache
    def spot(agent: int, *share: int) -> tuple[Tensor, Tensor]:
        """Return where an agent stands best for its share of landmarks [2, W], and what that costs [W]."""
        here, own = position[agent], landmark[list(share)]
        place = _best_spot(here, own) if share else here
        return place, (own - place).norm(dim=1).sum(0) + TRAVEL_WEIGHT * (place - here).norm(dim=0)

    best = torch.full_like(position[0, 0], torch.inf)
    goal = position.clone()
    for owners in itertools.product(range(agents), repeat=landmarks):
        spots = [spot(i, *(k for k in range(landmarks) if owners[k] == i)) for i in range(agents)]
        cost = torch.stack([cost for _, cost in spots]).sum(0)
        better = cost < best
        best = torch.where(better, cost, best)
        goal = torch.where(better, torch.stack([place for place, _ in spots]), goal)
    return goal


def _best_spot(here: Tensor, share: Tensor) -> Tensor:
    """Return where an agent at `here` [2, W] stands best for its landmarks `share` [K, 2, W]."""
    if len(share) == 2:
        along = share[1] - share[0]
        part = ((here - share[0]) * along).sum(0) / along.square().sum(0).clamp_min(1e-12)
        return share[0] + part.clamp(0, 1) * along
    sums = (share.unsqueeze(1) - share.unsqueeze(0)).norm(dim=2).sum(1)
    return share.gather(0, sums.argmin(0).expand(1, 2, -1))[0]
