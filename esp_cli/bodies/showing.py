"""What MuJoCo environments of others show and take, found in their simulator, as layouts that follow a `Body`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from esp_cli.bodies.body import Body
from esp_cli.bodies.kinds import INERTIA, TWIST, parts_field
from esp_cli.symmetry.elements import Floats, Indices, Order
from esp_cli.symmetry.plane import KIND_MATRICES, PlaneElement
from esp_envs.errors import UserError
from esp_envs.spec import Continuous, Field, Layout

_OF_BODIES = {"cinert": INERTIA, "cvel": TWIST, "cfrc_ext": TWIST}
_SHOWN = ("qpos", "qvel", "qfrc_actuator", *_OF_BODIES)  # arrays of a simulator of which observations are made


@dataclass(frozen=True)
class Layouts:
    """What the numbers of a MuJoCo environment are."""

    observation: Layout  # of each agent
    action: Continuous  # of each agent
    simulated: Layout  # of positions and velocities, which decide what follows
    orders: dict[PlaneElement, Order]  # of agents, by element that transforms all their numbers alike
    exact: frozenset[PlaneElement]  # those of which the model is its own image to the last digit


def layouts_of(
    body: Body, data: Any, observe: Callable[[], Sequence[Floats]], acting: Sequence[Sequence[int]] | None = None
) -> Layouts:
    """Return the layouts of an environment whose observations are numbers of its simulator.

    Distinct numbers are written into `data`, which is overwritten, and looked for in what each agent sees without a
    step: `lambda: [env.unwrapped._get_obs()]`. `acting` are each agent's actuators, in order; by default one has all.
    """
    acts = [np.array(one) for one in acting or [range(data.model.nu)]]
    names, seen = _names(body, data.model), _sources(data, observe)
    if any(len({len(row) for row in rows}) > 1 for rows in (seen, acts)) or len(seen) != len(acts):
        raise UserError("agents see or do unlike numbers; give all as many")
    orders: dict[PlaneElement, Order] = {}
    shown, done = dict[PlaneElement, Floats](), dict[PlaneElement, Floats]()
    for one in body.found.values():
        match, element = one.match, one.match.element
        whose = [next((k for k, a in enumerate(acts) if match.ctrl[a][:, own].any()), 0) for own in acts]
        bodies = [np.kron(match.bodies, KIND_MATRICES[kind](match.world[:2, :2])) for kind in _OF_BODIES.values()]
        blocks = _common(block_diag(match.qpos, match.qvel, match.qvel, *bodies), seen, whose)
        moves = _common(match.ctrl, acts, whose)
        if blocks is not None and moves is not None and len(set(whose)) == len(acts):
            orders[element], shown[element], done[element] = tuple(whose), blocks, moves
    controls = [f"control_{k}" if len(acts) > 1 else body.actuators[k] for k in acts[0]]
    observation = _split([names[k] for k in seen[0]], shown, len(acts) == 1)
    ranges = data.model.actuator_ctrlrange[acts[0]]
    unit = f"share of {ranges[0, 0]:g} to {ranges[0, 1]:g}" if np.ptp(ranges, 0).max() == 0 else "share of its range"
    action = Continuous(Layout((replace(parts_field("controls", "actuators", controls, done, 1), unit=unit),)))
    exact = frozenset(g for g in orders if body.found[g.name].proof.verdict == "exact")
    return Layouts(observation, action, body.state(), orders, exact)


def _names(body: Body, model: Any) -> list[tuple[str, str]]:
    """Return for each number of the simulator's arrays which field it is of, and what it is called there."""
    state = [(f.name, part) for f in body.state().fields for part in f.kind.parts]  # type: ignore[attr-defined]
    forces = [("forces" if name == "velocities" else f"forces_of_{name}", part) for name, part in state[model.nq :]]
    limbs = [(name, limb) for name, kind in _OF_BODIES.items() for limb in body.limbs for _ in range(kind.width)]
    return [*state, *forces, *limbs]


def _sources(data: Any, observe: Callable[[], Sequence[Floats]]) -> list[Indices]:
    """Return for each agent where each number that it sees stands among the simulator's arrays."""
    # below 1 in size, since environments clip what is larger
    arrays = [getattr(data, name) for name in _SHOWN]
    ends = np.cumsum([array.size for array in arrays])
    drawn = np.random.default_rng(0).uniform(-1, 1, ends[-1])
    for array, part in zip(arrays, np.split(drawn, ends[:-1]), strict=True):
        array.flat = part
    where, found = {number: k for k, number in enumerate(drawn.tolist())}, []
    for row in observe():
        places = [where.get(float(number)) for number in np.ravel(row)]
        if None in places:
            raise UserError(
                f"number {places.index(None)} of the observation is none of the simulator's "
                f"{', '.join(_SHOWN)}; give layouts by the fields of a Body"
            )
        found.append(np.array(places))
    return found


def _common(matrix: Floats, places: Sequence[Indices], whose: Sequence[int]) -> Floats | None:
    """Return how what agent i has becomes what agent whose[i] has, where that is the same for all; else None."""
    blocks = [matrix[np.ix_(places[j], places[i])] for i, j in enumerate(whose)]
    first = blocks[0]
    alike = all(block.shape == first.shape and np.allclose(block, first, atol=1e-9) for block in blocks)
    return first if alike and np.allclose(first @ first.T, np.eye(len(first)), atol=1e-6) else None


def _split(names: Sequence[tuple[str, str]], moves: dict[PlaneElement, Floats], told: bool) -> Layout:
    """Return the layout of a row, with a field for each run of numbers of one name that stays together."""
    cuts = [0]
    for k in range(1, len(names)):
        closed = not any(block[:k, k:].any() or block[k:, :k].any() for block in moves.values())
        if closed and names[k][0] != names[k - 1][0]:
            cuts.append(k)
    fields: list[Field] = []
    for start, end in zip(cuts, [*cuts[1:], len(names)], strict=True):
        name = names[start][0]
        times = sum(field.name.rpartition("_")[0] == name or field.name == name for field in fields)
        parts = [part if told else str(k) for k, (_, part) in enumerate(names[start:end])]
        blocks = {element: block[start:end, start:end] for element, block in moves.items()}
        fields.append(parts_field(f"{name}_{times + 1}" if times else name, "numbers", parts, blocks, 1))
    return Layout(tuple(fields))
