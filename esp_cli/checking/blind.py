"""Find symmetries of transitions without being told what any number means.

Who knows nothing of fields and actions searches maps of the numbers that an agent sees and does (see `numbers`), for
generators of a group (Sims, 1970): one map for each number and each place that it can go to, with all numbers before it
in their places. If dynamics, starts, policy and reward are symmetric under a map, a transition and its image have one
distribution. So any predictor of change and reward errs on images as much as on originals. That is the test: a
predictor that fits the data errs more on images unless they are transitions like others.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from sympy.combinatorics import Permutation, PermutationGroup
from torch import Tensor, nn
from torch.nn import functional as F

from esp_cli.checking.discovery import Discovery, default_candidates, judged_elements, named
from esp_cli.checking.numbers import Moments, NumberMap, changing, done
from esp_cli.checking.recorded import Transitions, collect, outputs_of
from esp_cli.checking.verdicts import NEGLIGIBLE, SIGNIFICANT, ElementVerdict, FieldVerdict, Outcome
from esp_cli.symmetry import Element, build_transform
from esp_envs.conformance.subject import MakeWorlds
from esp_envs.errors import UserError
from esp_envs.spec import Discrete, Spaces

BLIND = "transitions whose numbers nobody explained"
WIDEST = 64
"""Numbers that an agent sees and does, at most."""
TOLERATED = 0.05
"""Excess of squared error, as a share of the variance, up to which a map that is not found broken holds."""
_WORLDS, _EPISODES, _STEPS = 512, 65_536, 2
"""Many short episodes say more than few long ones, whose steps look alike."""
_ANGLE = math.radians(57.0)
"""Angle of the turn that stands for all."""
_STILL = 1e-6
"""Standard deviation below which a change or reward says nothing."""
_HIDDEN, _ROUNDS, _UPDATES, _BATCH, _STEP = 256, 16, 500, 1024, 4e-3


def discover_blindly_in_task(make: MakeWorlds) -> Discovery:
    """Find the symmetries of a task by transitions of the random policy; see `discover_blindly`."""
    env = make(_WORLDS, [0])
    action = env.spec.action
    _refuse_wide(env.spec.observation.width + (action.count if isinstance(action, Discrete) else action.width))
    return discover_blindly(env.spec.name, env.spec, collect(env, _EPISODES, _STEPS))


def discover_blindly(source: str, spaces: Spaces | None, data: Transitions) -> Discovery:
    """Find the symmetries of transitions, told only how many numbers and actions there are.

    What is found is named afterwards, where the spaces have a name for it.

    Args:
        source: the task or file.
        spaces: of the transitions; None where nobody knows them, so that nothing gets a name.
        data: of a policy that prefers no direction, from starts that prefer none.

    Raises:
        UserError: there are too many numbers, or masks of actions.
    """
    actions = None if data.action.is_floating_point() else int(data.action.max()) + 1
    if spaces is not None and isinstance(spaces.action, Discrete):
        actions = spaces.action.count
    _refuse_wide(data.obs.shape[-1] + (actions or data.action.shape[-1]))
    if data.action_mask is not None:
        raise UserError("--blind does not look at masks of actions, which these transitions have; leave --blind out")
    tried, is_complete = search(data, actions)
    results = judged_elements([verdict for _, verdict in tried], TOLERATED)
    maps = [one for (one, _), result in zip(tried, results, strict=True) if result.accepted]
    generators = [Permutation(points) for one in maps if (points := _points(one.matrix))]
    group = PermutationGroup(generators or [Permutation(1)])
    found, transforms = f"{'' if is_complete else 'at least '}{group.order()} maps of numbers", ""
    if spaces is not None:
        known = [element for element in default_candidates(spaces) if element.permutation is None]
        name, transforms = named(*_held(known, spaces, data, maps, group))
        found = f"{name} among {found}"
    return Discovery(source, BLIND, found, transforms, results)


def search(data: Transitions, actions: int | None) -> tuple[list[tuple[NumberMap, ElementVerdict]], bool]:
    """Return maps that were tested with what was found of each, and whether all were looked at.

    Those that hold generate a group of symmetries.

    Args:
        data: of a policy that prefers no direction, from starts that prefer none.
        actions: A, the number of discrete actions; None of continuous ones.
    """
    moments = Moments(data, actions)
    predictor = _Predictor(data, actions)
    tried: list[tuple[NumberMap, ElementVerdict]] = []
    held: list[NumberMap] = []
    for number in reversed(moments.live):
        orbit = _orbit((number, 1), held)
        for place in moments.places(number):
            if place in orbit:
                continue
            for one in moments.maps(number, place):
                tried.append((one, predictor.verdict(one)))
                if tried[-1][1].outcome == "holds":
                    held.append(one)
                    orbit = _orbit((number, 1), held)
                    break
    if actions is None:
        products = [first.matrix @ second.matrix for first, second in itertools.product(held, held)]
        turns = (_any_angle(matrix, moments) for matrix in [*(one.matrix for one in held), *products])
        different = {turn.name: turn for turn in turns if turn}.values()
        tried += [(turn, predictor.verdict(turn, moves_starts=True)) for turn in different]
    return tried, not moments.gave_up


def _refuse_wide(numbers: int) -> None:
    if numbers > WIDEST:
        raise UserError(f"--blind searches up to {WIDEST} numbers that an agent sees and does, not {numbers}")


def _held(
    known: Sequence[Element], spaces: Spaces, data: Transitions, maps: Sequence[NumberMap], group: PermutationGroup
) -> tuple[list[Element], list[Element]]:
    """Return those of some elements that are products of maps that were found, and those that can be such products."""
    matrices = {element.name: _matrix(element, spaces, data) for element in known}
    signed = {name: points for name, matrix in matrices.items() if (points := _points(matrix))}
    held = {name for name, points in signed.items() if group.contains(Permutation(points))}
    turn = matrices.get("rot57")
    turns = [way for one in maps for way in (one.matrix, one.matrix.mT)]
    if turn is not None and any(torch.allclose(turn, way, atol=1e-5) for way in turns):
        held |= {"rot57", "flip23"} if any(name.startswith("flip") for name in held) else {"rot57"}
    tried = signed.keys() | {"rot57", "flip23"}
    return [e for e in known if e.name in held], [e for e in known if e.name in tried]


def _matrix(element: Element, spaces: Spaces, data: Transitions) -> Tensor:
    """Return an element as a matrix of numbers; those that never change stay."""
    transform = build_transform([element], spaces)
    seen = transform.obs(torch.eye(spaces.observation.width))
    if isinstance(spaces.action, Discrete):
        act = F.one_hot(transform.action(torch.arange(spaces.action.count)), spaces.action.count).float()
    else:
        act = transform.push_outputs(torch.eye(spaces.action.width))
    matrix = torch.block_diag(seen, act)
    matrix[: len(seen)][~changing(data.obs)] = 0.0
    return matrix + torch.diag((matrix == 0).all(1).float())


def _points(matrix: Tensor) -> list[int] | None:
    """Return a signed permutation as one of the points +0, -0, +1, -1, ..., or None if it is none."""
    places = matrix.abs().argmax(1)
    if len(places.unique()) < len(places):
        return None
    signs = matrix.gather(1, places.unsqueeze(1)).squeeze(1)
    if not torch.allclose(matrix, signs.round().unsqueeze(1) * F.one_hot(places, len(places)), atol=1e-5):
        return None
    return [2 * p + (half ^ (s < 0)) for p, s in zip(places.tolist(), signs.tolist(), strict=True) for half in (0, 1)]


def _orbit(start: tuple[int, int], maps: Sequence[NumberMap]) -> set[tuple[int, int]]:
    """Return the (place, sign) that a number can be brought to."""
    found, new = {start}, [start]
    while new:
        place, sign = new.pop()
        for one in maps:
            row = one.matrix[place]
            image = int(row.abs().argmax())
            reached = (image, sign * int(row[image]))
            if reached not in found:
                found.add(reached)
                new.append(reached)
    return found


def _any_angle(matrix: Tensor, moments: Moments) -> NumberMap | None:
    """Return the turn by another angle of the pairs of numbers that a quarter turn turns; None of other maps."""
    moved = (matrix != torch.eye(len(matrix))).any(1)
    if not bool(moved.any()) or not torch.equal(matrix @ matrix, torch.diag(torch.where(moved, -1.0, 1.0))):
        return None
    turn = math.cos(_ANGLE) * torch.eye(len(matrix)) + math.sin(_ANGLE) * matrix
    pairs = " ".join(f"({i},{j})" for i, j in enumerate(matrix.abs().argmax(1).tolist()) if i < j)
    matrix = torch.where(moved.unsqueeze(1), turn, matrix)
    return NumberMap(f"57 degrees in {pairs}", matrix, moments.width, moments.centre)


class _Predictor:
    """A network that predicts what an agent sees next and its reward from what it sees and does.

    It is fitted to half of the episodes, and errs on the other half.
    """

    def __init__(self, data: Transitions, actions: int | None) -> None:
        half = len(data.obs) // 2
        fitted, self._held = data.episodes(slice(half)), data.episodes(slice(half, None))
        self._actions = actions
        x, y = (part.flatten(0, 2) for part in (self._inputs(fitted), outputs_of(fitted)))
        self._x, self._y = ((part.mean(0), part.std(0).clamp_min(_STILL)) for part in (x, y))
        self._net = self._fitted((x - self._x[0]) / self._x[1], (y - self._y[0]) / self._y[1])
        self._errors = self._error(self._held)
        self._variance = outputs_of(self._held).flatten(0, 2).var(0)

    def verdict(self, one: NumberMap, moves_starts: bool = False) -> ElementVerdict:
        """Judge a map by how much more the network errs on images, as shares of the variance.

        Args:
            one: the map.
            moves_starts: whether it moves a square of starts, so that the network errs a little more under a symmetry.
        """
        width = one.width
        back = torch.block_diag(one.matrix[:width, :width], torch.ones(1, 1)).square()  # of variances
        excess = self._error(one.image(self._held)) - self._errors @ back
        names = [*(f"number {i}" for i in range(width)), "reward"]
        pairs = zip(names, excess.unbind(1), self._variance.tolist(), strict=True)
        return ElementVerdict(one.name, False, tuple(_judged(*pair, moves_starts) for pair in pairs))

    @torch.no_grad()
    def _error(self, data: Transitions) -> Tensor:
        """Return the mean squared error of each episode and output, [M, D + 1]."""
        predicted = self._net((self._inputs(data) - self._x[0]) / self._x[1]) * self._y[1] + self._y[0]
        return (predicted - outputs_of(data)).square().mean((1, 2))

    def _inputs(self, data: Transitions) -> Tensor:
        acted = done(data, self._actions)
        agents = torch.eye(acted.shape[2]).expand(*acted.shape[:3], -1)  # what one does need not be what another does
        return torch.cat([data.obs, acted, agents], -1)

    @staticmethod
    def _fitted(x: Tensor, y: Tensor) -> nn.Module:
        """Return a fitted network; rows that it predicts badly are drawn more often, as contacts, which are rare."""
        generator = torch.Generator().manual_seed(0)
        widths = (x.shape[1], _HIDDEN, _HIDDEN, y.shape[1])
        layers = [nn.Linear(*pair) for pair in itertools.pairwise(widths)]
        for layer in layers:
            for parameter in layer.parameters():
                nn.init.uniform_(parameter, -(layer.in_features**-0.5), layer.in_features**-0.5, generator=generator)
        net = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])
        optimizer = torch.optim.Adam(net.parameters())
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _STEP, total_steps=_ROUNDS * _UPDATES)
        chances = torch.ones(len(x))
        for _ in range(_ROUNDS):
            drawn = torch.multinomial(chances, _UPDATES * _BATCH, replacement=True, generator=generator)
            for rows in drawn.split(_BATCH):
                loss = F.mse_loss(net(x[rows]), y[rows])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                schedule.step()
            with torch.no_grad():
                errors = (net(x) - y).square().mean(1)
            chances = errors + errors.mean()
        return net


def _judged(name: str, excess: Tensor, variance: float, moves_starts: bool) -> FieldVerdict:
    """Judge one number by the excess of squared error [M] of each held-out episode."""
    if variance < _STILL**2:
        return FieldVerdict(name, "not covered", float("nan"), float("nan"))
    gap, error = float(excess.mean()) / variance, float(excess.std()) / len(excess) ** 0.5 / variance
    surely = not moves_starts and gap > max(SIGNIFICANT * error, NEGLIGIBLE)
    outcome: Outcome = "broken" if surely or gap > TOLERATED else "holds"
    return FieldVerdict(name, outcome, gap, error)
