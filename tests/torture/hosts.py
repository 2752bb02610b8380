"""Calls of foreign loops to `Symmetry`: odd data that is right gives the right copies, wrong data one sentence.

The oracle knows no transform: the copies of a copy are the copies of its original in another order, and none is the
original.
"""

import itertools
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from esp_cli import Continuous, Field, Items, Kind, Symmetry, discrete_moves, layout
from esp_envs.errors import UserError
from tests.torture.record import Part

BATCH = 100
SEEN = (
    layout(Field("speed", Kind.VECTOR), Field("load", Kind.SCALAR)),
    layout(Field("own", Kind.VECTOR), Field("others", Kind.VECTOR, 2, items=Items.OTHERS)),
)
ACTIONS = (
    discrete_moves(4),
    discrete_moves(("stay", "left", "up", "right", "down")),
    Continuous(layout(Field("force", Kind.VECTOR))),
)
GROUPS = ("c4", "d4", "flip-x", "d4*agents", "agents")
SOUND: tuple[Callable[[Tensor], Tensor], ...] = (
    lambda x: x,
    lambda x: x.transpose(0, -1).contiguous().transpose(0, -1),
    lambda x: x.expand(x.shape) if x.is_floating_point() else x.int(),
    lambda x: x.double() if x.is_floating_point() else x.short(),
    lambda x: x.clone().requires_grad_() if x.is_floating_point() else x,
    lambda x: x[:0],
)
WRONG: tuple[Callable[[Tensor], Any], ...] = (
    lambda x: x[..., :-1] if x.is_floating_point() else x + 100,
    lambda x: torch.cat([x, x[..., :1]], -1) if x.is_floating_point() else x - 100,
    lambda x: x.unsqueeze(0),
    lambda x: x[0, 0],
    lambda x: x.bool(),
    lambda x: x.to(torch.complex64),
    lambda x: x.long() if x.is_floating_point() else x.double(),
    lambda x: x[:, :1].expand(-1, x.shape[1] + 1, *x.shape[2:]),
    lambda x: x.tolist(),
    lambda x: x.numpy(),
    lambda x: None,
    lambda x: x.sum(),
    lambda x: "obs",
)
WRONG_NUMBERS: tuple[Callable[[Tensor], Any], ...] = (*WRONG[2:4], *WRONG[7:11], lambda x: x.new_zeros(*x.shape, 64))
"""Of numbers that go with their agents: they may be of any type."""


class Hosts(Part):
    def __init__(self, scratch: Path, seed: int) -> None:
        self.seed, self.kinds = seed, []
        for seen, action, group in itertools.product(SEEN, ACTIONS, GROUPS):
            symmetry = Symmetry(observation=seen, action=action, group=group, num_agents=3, copies="all")
            self.kinds.append((f"{seen.summary} {group}", symmetry))

    def run(self, number: int) -> str | None:
        rng = random.Random(f"{self.seed} {number}")
        torch.manual_seed(rng.getrandbits(32))
        for _ in range(BATCH):
            self.done += 1
            name, symmetry = rng.choice(self.kinds)
            wrong = _sound(symmetry, rng) if rng.random() < 0.4 else _wrong(symmetry, rng)
            if wrong:
                return f"{name}: {wrong}"
        return None


def _data(symmetry: Symmetry, rows: int = 4) -> dict[str, Tensor]:
    spaces, lead = symmetry.spaces, (rows, symmetry.spaces.num_agents)
    obs = torch.randn(*lead, spaces.observation.width)
    discrete = not isinstance(spaces.action, Continuous)
    action = torch.randint(spaces.action.count, lead) if discrete else torch.randn(*lead, spaces.action.width)
    return {"obs": obs, "action": action, "state": torch.randn(rows, spaces.state.width), "number": torch.randn(lead)}


def _call(symmetry: Symmetry, data: dict[str, Any]) -> list[Tensor]:
    obs, action, state, (number,) = symmetry.augment(
        data["obs"], data["action"], state=data["state"], per_agent=(data["number"],)
    )
    return [obs, action, state, number]


def _orbits(copies: list[Tensor], rows: int) -> Tensor:
    """Return the copies of each row with all that belongs to them, [rows, copies, numbers]."""
    return torch.cat([part.detach().double().flatten(1) for part in copies], 1).unflatten(0, (-1, rows)).transpose(0, 1)


def _sound(symmetry: Symmetry, rng: random.Random) -> str | None:
    data, change = _data(symmetry), rng.choice(SOUND)
    odd = {key: change(value) for key, value in data.items()}
    rows = len(odd["obs"])
    copies = _call(symmetry, odd)
    for part, given in zip(copies, odd.values(), strict=True):
        if part.dtype != given.dtype or not torch.equal(part[:rows], given):
            return "the originals are not the first rows"
    if not rows:
        return None
    for part in (copies[0], copies[2]):
        if any(torch.equal(image, part[:rows]) for image in part[rows:].split(rows)):
            return "a copy is its original"
    number = rng.randrange(len(copies[0]) // rows)
    of_one = [part.unflatten(0, (-1, rows))[number] for part in copies]
    again = _call(symmetry, dict(zip(odd, of_one, strict=True)))
    apart = torch.cdist(_orbits(copies, rows), _orbits(again, rows))
    same = max(apart.amin(1).max().item(), apart.amin(2).max().item()) < 1e-3
    return None if same else "a copy has other copies than its original"


def _wrong(symmetry: Symmetry, rng: random.Random) -> str | None:
    data: dict[str, Any] = _data(symmetry)
    key = rng.choice(list(data))
    change = rng.choice(WRONG_NUMBERS if key == "number" else WRONG)
    spoilt = change(data[key])
    if spoilt is None and key == "state":
        return None  # none is needed
    try:
        _call(symmetry, data | {key: spoilt})
    except UserError as error:
        return None if len(str(error)) < 500 and "\n" not in str(error) else f"is not one sentence: {error!s:.600}"
    except Exception as error:
        return f"{key} {_shown(spoilt)}: {type(error).__name__}: {error!s:.300}"
    return f"{key} {_shown(spoilt)} is taken"


def _shown(x: Any) -> str:
    return f"{x.dtype} {list(x.shape)}" if isinstance(x, Tensor) else f"{type(x).__name__}"
