"""Point bodies with soft contacts: the physics of the multi-agent particle environment (MPE), many worlds at once.

Every world holds A moving agents and L fixed landmarks. One tensor `physics` of shape [2A + L, 2, W] keeps all worlds,
worlds last: an elementwise operation then runs over long contiguous rows, and everything that is a sum of differences
of physics rows (pair offsets, summed contact forces, observations) is one small matrix product.

One step of MPE (Lowe et al. 2017, `multiagent/core.py`), which is what papers of that time measured on:

    velocity <- (1 - DAMPING) * velocity + DT_S * (control * gain + contact forces)
    velocity <- velocity * min(1, max_speed / |velocity|)
    position <- position + DT_S * velocity

The package that keeps MPE alive (mpe2) moves the position first, by the old velocity, so that an action shows one step
later; `velocity_first=False` does the same. Two bodies that collide push each other apart along the line between their
centres with CONTACT_FORCE * CONTACT_MARGIN * softplus(-gap / CONTACT_MARGIN), with the `gap` of their rims.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

DT_S = 0.1  # simulated seconds of one step
DAMPING = 0.25  # share of the velocity lost in one step
CONTACT_FORCE = 1e2  # stiffness of a contact, force per length of overlap
CONTACT_MARGIN = 1e-3  # length over which a contact fades in

LANE_MULTIPLE = 64
"""The worlds axis is padded to a multiple of this, so that vector code never runs a scalar tail: the numbers of a world
do not depend on how many worlds stand beside it."""
_SOFTPLUS_RANGE = (-60.0, 20.0)  # above, softplus(x) is x in float32; below, it is some 1e-26, and exp would underflow
_SMALLEST_SQUARED_DISTANCE = 1e-24  # keeps a contact's direction finite where two centres coincide (force 0)


@dataclass(frozen=True)
class Bodies:
    """What the bodies of a world are."""

    radius: tuple[float, ...]  # one per entity, agents first and landmarks after them, in lengths
    gain: tuple[float, ...]  # of each agent, acceleration of full control (MPE's `sensitivity`, `accel`), length / s^2
    max_speed: tuple[float, ...] | None  # one per agent in length / s, or None where speed is not limited
    contacts: tuple[tuple[int, int], ...]  # pairs (a, b) of entities that push each other apart; a is an agent
    watched: tuple[tuple[int, int], ...] = ()  # further pairs whose distance the task wants to know
    extent: tuple[float, ...] = ()  # half the side of the square in which each entity starts, lengths

    @property
    def num_agents(self) -> int:
        """A, the moving bodies."""
        return len(self.gain)

    @property
    def num_landmarks(self) -> int:
        """L, the fixed bodies."""
        return len(self.radius) - len(self.gain)


class ParticleWorlds:
    """W worlds of the same bodies.

    `physics` [2A + L, 2, W'] float32 has rows of the agents' velocities, the agents' positions, the landmarks'
    positions, of which `velocity`, `position` and `entity` are views; W' is W padded up (see LANE_MULTIPLE), and `rows`
    [2 (2A + L), W] has the real worlds alone. Code that writes to it calls `measure` afterwards, for
    `squared_contact_distance` [contacts, W'] and `squared_watched_distance` [watched, W'] of the pairs in `bodies`.
    `pushes` [A, contacts] are 1 and -1 where an agent is the first or the second of a pair. All stay the same memory,
    so that a task may keep views.
    """

    def __init__(self, bodies: Bodies, num_worlds: int, device: torch.device, velocity_first: bool = True) -> None:
        self.bodies = bodies
        self.velocity_first = velocity_first
        self.num_worlds = num_worlds
        self.num_lanes = lanes_of(num_worlds)
        agents, lanes = bodies.num_agents, self.num_lanes
        self.physics = torch.zeros(2 * agents + bodies.num_landmarks, 2, lanes, device=device)
        self.rows = self.physics.view(-1, lanes)[:, :num_worlds]
        self.velocity = self.physics[:agents]
        self.position = self.physics[agents : 2 * agents]
        self.entity = self.physics[agents:]
        pairs, contacts = [*bodies.contacts, *bodies.watched], len(bodies.contacts)
        # [pairs, entities]: times the positions it gives position[a] - position[b]
        first, second = torch.tensor(pairs, dtype=torch.int64).view(-1, 2).unbind(1)
        basis = torch.eye(len(bodies.radius))
        self._differences = (basis[first] - basis[second]).to(device)
        self.pushes = self._differences[:contacts, :agents].t().contiguous()
        self._offset = torch.zeros(len(pairs), 2, lanes, device=device)
        self._contact_offset = self._offset[:contacts]
        self._square = torch.zeros_like(self._offset)
        self._squared_distance = torch.zeros(len(pairs), lanes, device=device)
        self.squared_contact_distance = self._squared_distance[:contacts]
        self.squared_watched_distance = self._squared_distance[contacts:]
        touching = torch.tensor([bodies.radius[a] + bodies.radius[b] for a, b in bodies.contacts])
        self._touching = _rows(touching / CONTACT_MARGIN, lanes).to(device)
        self._gain = _rows(torch.tensor(bodies.gain) * DT_S, lanes).unsqueeze(1).repeat(1, 2, 1).to(device)
        limit = None if bodies.max_speed is None else _rows(torch.tensor(bodies.max_speed), lanes).to(device)
        self._max_speed = limit

    def measure(self) -> None:
        """Compute the pair offsets and distances of the present positions."""
        exact_matmul(self._differences, self.entity.flatten(1), out=self._offset.flatten(1))
        torch.mul(self._offset, self._offset, out=self._square)
        torch.add(self._square[:, 0], self._square[:, 1], out=self._squared_distance)

    def advance(self, control: Tensor, push: Tensor | None = None, mud: float = 0.0) -> None:
        """Advance all worlds by DT_S, with controls [A, 2, W'] in units of an agent's gain, normally of length <= 1.

        `push` [A, 2, W' or 1] is an acceleration that nobody wishes for, length / s^2, and `mud` the share of velocity
        that a step costs more where x > 0.
        """
        held = 1 - mud * (self.position[:, :1] > 0).float() if mud else None
        contact = self._contact_impulses()
        if not self.velocity_first:
            self.position.add_(self.velocity, alpha=DT_S)
        self.velocity.mul_(1 - DAMPING)
        if held is not None:
            self.velocity.mul_(held)
        self.velocity.addcmul_(control, self._gain).add_(contact)
        if push is not None:
            self.velocity.add_(push, alpha=DT_S)
        if self._max_speed is not None:
            square = self.velocity.square()
            speed = (square[:, 0] + square[:, 1]).sqrt_()
            self.velocity.mul_((self._max_speed / speed).clamp_max_(1.0).unsqueeze(1))
        if self.velocity_first:
            self.position.add_(self.velocity, alpha=DT_S)
        self.measure()

    def _contact_impulses(self) -> Tensor:
        """Return the velocity change [A, 2, W'] that contacts cause in one step, from the measured pairs."""
        strength = contact_strength(self.squared_contact_distance, self._touching)
        push = self._contact_offset * strength.unsqueeze(1)
        return exact_matmul(self.pushes, push.flatten(1)).view_as(self.velocity)


def lanes_of(num_worlds: int) -> int:
    """Return W', the worlds filled up to a multiple of `LANE_MULTIPLE`."""
    return -(-num_worlds // LANE_MULTIPLE) * LANE_MULTIPLE


def contact_strength(squared_distance: Tensor, touching: Tensor) -> Tensor:
    """Return a contact's velocity change per length between the centres, which touch at `touching` CONTACT_MARGINs."""
    distance = squared_distance.clamp_min(_SMALLEST_SQUARED_DISTANCE).sqrt_()
    overlap = torch.add(touching, distance, alpha=-1 / CONTACT_MARGIN)
    # softplus by exp and log1p: PyTorch's own softplus differs in the last bit between its vector and scalar code.
    softplus = overlap.clamp(*_SOFTPLUS_RANGE).exp_().log1p_()
    torch.maximum(softplus, overlap, out=softplus)
    return softplus.div_(distance).mul_(CONTACT_FORCE * CONTACT_MARGIN * DT_S)


def exact_matmul(left: Tensor, right: Tensor, out: Tensor | None = None) -> Tensor:
    """Multiply float32 matrices exactly, in float64 where a learner switched on TF32, bfloat16 products or autocast."""
    if _products_are_rounded(left.device.type):
        product = (left.double() @ right.double()).float()
        return product if out is None else out.copy_(product)
    return torch.mm(left, right, out=out)


def _products_are_rounded(device: str) -> bool:
    """Return whether PyTorch may compute float32 products on a kind of device with fewer bits."""
    backend = torch.backends.cuda.matmul if device == "cuda" else getattr(torch.backends.mkldnn, "matmul", None)
    precision = getattr(backend, "fp32_precision", None)
    if precision is None:  # before PyTorch 2.9 one switch covered all devices
        return torch.get_float32_matmul_precision() != "highest" or torch.is_autocast_enabled(device)
    return precision not in ("none", "ieee") or torch.is_autocast_enabled(device)


def _rows(values: Tensor, lanes: int) -> Tensor:
    """Repeat one number per row along the worlds: contiguous operands keep elementwise code vectorised."""
    return values.to(torch.float32).unsqueeze(1).repeat(1, lanes)
