"""A gate per state and action: copies only where one-step predictors with and without the symmetry agree.

The idea is that of partially equivariant reinforcement learning (Chang et al., 2025, arXiv 2512.00915): P_N predicts
change and reward of a step from what is seen and done, P_E does so under the symmetry. Where both agree, the update may
use the symmetry; where they do not, it is the standard one. Here each element g has a P_E of its own,

    P_E(s, a) = (P_N(s, a) + g^-1 P_N(g s, g a)) / 2,
    b_g(s, a) = 2 |P_N - P_E|(s, a) = |g P_N(s, a) - P_N(g s, g a)|,

and the copy of (s, a) by g is kept with probability exp(-doubt b_g(s, a)), b_g in standard deviations of the worst
field. P_N is a ridge regression on products of two numbers, a class of functions that every element maps to itself.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional as F

from esp_cli.symmetry import Transform
from esp_cli.symmetry.maps import Map
from esp_envs.spec import Discrete, Spaces, others_of

if TYPE_CHECKING:  # a loop of one's own brings no environment of ours
    from esp_envs.base import Environment

ROWS = 12_800  # joint steps that the predictors are fitted to, about
STEPS = 50  # steps of an episode that are looked at, at most
_SIGNIFICANT = 4.0  # standard errors of a prediction below which a gap counts as none
_CACHED_ROWS = 2048  # rows of features that fit a processor's cache
_STILL = 1e-5  # standard deviation below which a field does not change, so that it says nothing
_WIDEST_PAIRS = 48  # up to so many numbers of one agent, products of two of them are looked at too
# up to so many numbers that all other agents see and do, what they see is looked at too; else what they do alone
_WIDEST_OTHERS = 160


@dataclass(frozen=True)
class GatedTransform(Transform):
    """A transform of those rows alone whose gate is open; the others stay as they are."""

    open: Tensor  # [S, B, T] bool; a last state behind the T steps goes with the last step

    def part(self, start: int, stop: int) -> GatedTransform:
        return gated(self, self.open[:, start:stop])

    def action(self, action: Tensor) -> Tensor:
        return self._mixed(super().action(action), action)

    def _move(self, x: Tensor, by: Map, agent_axis: int | None = None, back: bool = False) -> Tensor:
        return self._mixed(super()._move(x, by, agent_axis, back), x)

    def _mixed(self, moved: Tensor, x: Tensor) -> Tensor:
        rows = self.open
        if x.shape[2] > rows.shape[2]:
            rows = torch.cat([rows, rows[:, :, -1:]], 2)
        return torch.where(rows.view(*rows.shape, *[1] * (x.dim() - 3)), moved, x)


def gated(transform: Transform, rows: Tensor) -> GatedTransform:
    """Return a transform of some rows, `open` of `GatedTransform`."""
    return GatedTransform(**{f.name: getattr(transform, f.name) for f in fields(Transform)}, open=rows)


def moved_share(transform: Transform, num_seeds: int) -> Tensor:
    """Return the share of the rows that a transform moves, [S]; the identity moves none."""
    moves = torch.tensor([0.0 if element.is_identity else 1.0 for element in transform.elements]).expand(num_seeds)
    if not isinstance(transform, GatedTransform):
        return moves
    return moves.to(transform.open.device, non_blocking=True) * transform.open.float().mean((1, 2))


@dataclass(frozen=True)
class Gate:
    """One-step predictors of a task, and how far to trust a copy by what they say."""

    spaces: Spaces  # of the task
    # [N or 1, features, D + 1] regression of change and reward on `inputs_of`, for each agent or for all
    weights: Tensor
    scale: Tensor  # [D + 1] standard deviation of each number's field
    noise: Tensor  # [D + 1] gap in that unit that counts as none
    doubt: float  # a copy that is off by b standard deviations is kept with probability exp(-doubt b)
    certain: Collection[str] = ()  # names of elements that are not gated
    # what the task is given for an action of the learner
    to_environment: Callable[[Tensor], Tensor] = lambda action: action

    @torch.no_grad()
    def kept(self, transform: Transform, obs: Tensor, action: Tensor) -> Tensor:
        """Return the probability [S, B, T] with which the copy of each row is kept.

        Rows are obs [S, B, T, N, D] and action [S, B, T, N] int64, or [S, B, T, N, width], as the learner has it.
        """
        width, action = obs.shape[-1], self.spaces.action.admissible(self.to_environment(action))
        here = self._predicted(obs, action)
        there = self._predicted(transform.obs(obs), transform.action(action))
        pushed = torch.cat([transform.obs(here[..., :width]), transform.per_agent(here[..., width]).unsqueeze(-1)], -1)
        gap = (there - pushed).abs_().div_(self.scale)
        gap = torch.where(gap > self.noise, gap, 0.0).amax((-2, -1))
        return torch.exp(-self.doubt * gap)

    def is_certain(self, transform: Transform) -> list[bool]:
        """Return for each seed whether its element is not gated."""
        return [element.is_identity or element.name in self.certain for element in transform.elements]

    def _predicted(self, obs: Tensor, action: Tensor) -> Tensor:
        size = max(1, _CACHED_ROWS // obs.shape[2:4].numel())
        pieces = zip(obs.flatten(0, 1).split(size), action.flatten(0, 1).split(size), strict=True)
        predicted = [_predicted(inputs_of(self.spaces, *piece), self.weights) for piece in pieces]
        return torch.cat(predicted).unflatten(0, obs.shape[:2])


@torch.no_grad()
def fit_gate(env: Environment, doubt: float, certain: Collection[str], alike: bool) -> Gate:
    """Fit the predictors of a task to episodes of its worlds, half of them by the heuristic if there is one."""
    spaces = env.spec
    obs, action, outputs = _played(env)
    inputs = inputs_of(spaces, obs, spaces.action.admissible(action))
    # every second episode: the first and the last half may be of two policies
    parts = [moments(inputs[part], outputs[part]) for part in (slice(0, None, 2), slice(1, None, 2))]
    if alike:
        parts = [(gram.sum(0, keepdim=True), cross.sum(0, keepdim=True)) for gram, cross in parts]
    whole = ridge(parts[0][0] + parts[1][0], parts[0][1] + parts[1][1])
    first, second = (ridge(*part) for part in parts)
    spread = outputs.flatten(0, 2).std(0)
    # The halves' predictions differ by twice the error of the whole's, and a gap has the errors of two predictions.
    error = _predicted(inputs, first - second).square().mean((0, 1, 2)).sqrt() / 2**0.5
    scale, noise = torch.empty_like(spread), torch.empty_like(spread)
    width = spaces.observation.width
    for where in (*spaces.observation.slices().values(), slice(width, width + 1)):
        scale[where] = spread[where].max() if spread[where].max() > _STILL else torch.inf
        noise[where] = _SIGNIFICANT * error[where].max() / scale[where]
    return Gate(spaces, whole, scale, noise, doubt, frozenset(certain))


def _played(env: Environment) -> tuple[Tensor, Tensor, Tensor]:
    """Return observations [M, T, N, D], actions, and change and reward [M, T, N, D + 1] of episodes."""
    found: list[tuple[Tensor, ...]] = []
    steps = min(STEPS, env.spec.horizon)
    for _ in range(max(1, ROWS // (env.num_envs * steps))):
        seen, rows = env.reset(), []
        for _ in range(steps):
            action = env.half_by_heuristic(env.random_action())
            step = env.step(action)
            change = step.reached.obs - seen.obs
            rows.append((seen.obs, action, torch.cat([change, step.reward.unsqueeze(-1)], -1)))
            seen = step.next
        found.append(tuple(torch.stack(part, 2).flatten(0, 1) for part in zip(*rows, strict=True)))
    obs, action, outputs = (torch.cat(part) for part in zip(*found, strict=True))
    return obs, action, outputs


def _predicted(inputs: Tensor, weights: Tensor) -> Tensor:
    if len(weights) == 1:  # of all agents: one product, several times faster with its few outputs in front (MKL)
        return (weights[0].mT @ inputs.flatten(0, 2).mT).mT.unflatten(0, inputs.shape[:3])
    return torch.einsum("mtnf,nfo->mtno", inputs, weights)


def inputs_of(spaces: Spaces, obs: Tensor, action: Tensor) -> Tensor:
    """Return [M, T, N, features]: 1, what each agent sees and does, products of two of these numbers, and the others'.

    An agent's next observation depends on what the other agents see and do.
    """
    acted = F.one_hot(action, spaces.action.count).float()[..., 1:] if isinstance(spaces.action, Discrete) else action
    columns = torch.cat([obs, acted], -1).movedim(-1, 0).contiguous()  # [numbers, M, T, N]
    orders = orders_of_others(spaces.num_agents)
    known = columns if len(orders) * len(columns) <= _WIDEST_OTHERS else columns[spaces.observation.width :]
    return _side_by_side(columns, [known[..., order] for order in orders])


def orders_of_others(num_agents: int) -> list[list[int]]:
    """Return who is each agent's first other, second other and so on, in index order: N - 1 lists of N agents."""
    return [list(order) for order in zip(*others_of(num_agents), strict=True)]


def _side_by_side(columns: Tensor, others: Sequence[Tensor]) -> Tensor:
    """Return 1, the columns [numbers, ..., N], their products, and others: [..., N, features], features outermost."""
    count = len(columns)
    paired = count if count <= _WIDEST_PAIRS else 0
    sizes = [1, count, *range(paired, 0, -1), *map(len, others)]
    features = columns.new_empty(sum(sizes), *columns.shape[1:])
    one, own, *rest = features.split(sizes)
    one.fill_(1)
    own.copy_(columns)
    for k in range(paired):
        torch.mul(columns[k:], columns[k], out=rest[k])
    for part, other in zip(rest[paired:], others, strict=True):
        part.copy_(other)
    return features.movedim(0, -1)


def moments(inputs: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
    """Return X^T X [N, F, F] and X^T Y [N, F, O] of inputs [M, T, N, F] and outputs [M, T, N, O], in float64."""
    x, y = (part.flatten(0, 1).transpose(0, 1) for part in (inputs, outputs))
    return (x.mT @ x).double(), (x.mT @ y).double()


def ridge(gram: Tensor, cross: Tensor, strength: float = 1e-4, floor: float = 1e-9) -> Tensor:
    """Return the weights [N, F, O] of ridge regressions, of X^T X [N, F, F] and X^T Y [N, F, O]."""
    held = strength * torch.diag_embed(gram.diagonal(dim1=-2, dim2=-1).clamp_min(floor))
    return torch.linalg.solve(gram + held, cross).float()
