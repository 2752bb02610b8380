"""Actions that move an agent in one of some directions of the plane."""

from __future__ import annotations

import math
from collections.abc import Sequence

from esp_envs.errors import UserError
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete, Kind

_MOVES = {"stay": (0.0, 0.0), "right": RIGHT, "up": UP, "left": LEFT, "down": DOWN}


def discrete_moves(moves: int | Sequence[str]) -> Discrete:
    """Return the actions of an agent that moves in one of some directions of the plane.

    Args:
        moves: how many directions, counter-clockwise from the right (4: right, up, left, down), or their names in the
            order of the action's index, of "stay", "right", "up", "left" and "down".

    Raises:
        UserError: a name is unknown or repeated; there is no direction; or it is neither a number nor names.
    """
    if isinstance(moves, int):
        if moves < 1:
            raise UserError(f"discrete_moves({moves}) has no direction; give 1 or more, or names")
        if moves == 4:
            return discrete_moves(tuple(_MOVES)[1:])
        angles = [2 * math.pi * k / moves for k in range(moves)]
        names = tuple(f"{360 * k / moves:g} degrees" for k in range(moves))
        return Discrete(Kind.VECTOR, tuple((math.cos(a), math.sin(a)) for a in angles), names)
    if not isinstance(moves, Sequence):
        raise UserError(f"discrete_moves({moves!r}) is neither a number of directions nor their names; give one")
    for index, name in enumerate(moves):
        if name not in _MOVES or name in moves[:index]:
            wrong = "does not know" if name not in _MOVES else "was given twice"
            raise UserError(f"discrete_moves {wrong} '{name}'; write {', '.join(_MOVES)} once each, or a number")
    return Discrete(Kind.VECTOR, tuple(_MOVES[name] for name in moves), tuple(moves))
