"""What the particle tasks share: fast readouts, actions, saving and restoring.

All random numbers of an episode are drawn at its start, from each seed's own generator.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.base import OTHER_SIZE, Observation, TaskSettings, generator_states, restore_generators
from esp_envs.breaking import Breaking
from esp_envs.errors import UserError
from esp_envs.lockstep import LockstepTask, Outcome
from esp_envs.mpe.particles import Bodies, ParticleWorlds, exact_matmul
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Continuous, Discrete, Field, Kind, TaskSpec, layout

STILL = (0.0, 0.0)
MOVES = Discrete(Kind.VECTOR, (STILL, LEFT, RIGHT, DOWN, UP), ("no-op", "left", "right", "down", "up"))
"""The five discrete actions in MPE's order; the meaning of each is the direction of its force."""
FORCE = Continuous(layout(Field("force", Kind.VECTOR, 1, "share of the full force")))
"""The continuous action: one force in the unit disc."""


class ParticleSettings(TaskSettings):
    """What all particle tasks let a user change."""

    convention: Literal["esp", "pettingzoo"] = Setting(
        "esp",
        description="whose rules: 'esp' is the original MPE as the paper used it, 'pettingzoo' the later mpe2 package",
    )
    actions: Literal["discrete", "continuous"] = Setting(
        "discrete", description="five moves, or a planar force in the unit disc"
    )
    horizon: int = Setting(25, ge=1, le=100_000, description="steps of an episode (0.1 s each); 25 in MPE")
    wind: float = Setting(
        0.0, ge=0, le=10, description="breaks symmetry: a force on every body along x, as a share of its full force"
    )
    gust_mean: float = Setting(
        0.0, ge=0, le=100, description="breaks symmetry: mean of a random force per step and axis, length/s^2"
    )
    gust_std: float = Setting(
        0.0, ge=0, le=100, description="standard deviation of that force; alone it keeps the symmetry in distribution"
    )
    mud: float = Setting(
        0.0, ge=0, le=1, description="breaks symmetry: share of the velocity that a step costs more where x > 0"
    )
    weak_agent: float = Setting(
        0.0, ge=0, lt=1, description="breaks the exchange of agents: share of its force that the first one lacks"
    )
    action_turn_rad: float = Setting(
        0.0, ge=0, le=3, description="breaks mirrors: the learners' forces are turned by this angle, which nobody sees"
    )
    reward_offset: float = Setting(
        0.0, ge=0, le=10, description="breaks symmetry: the reward counts places that lie so far to the right, lengths"
    )

    @property
    def turns(self) -> str:
        """The rotations that actions, dynamics and reward carry."""
        return "c4" if self.actions == "discrete" else "so2"

    @property
    def breakings(self) -> tuple[Breaking, ...]:
        """What breaks the symmetry, with the group that is left."""
        return (
            Breaking("wind", self.wind, "flip-x"),
            Breaking("gust_mean", self.gust_mean, "flip-diagonal"),
            Breaking("gust_std", self.gust_std, None),
            Breaking("mud", self.mud, "flip-x"),
            Breaking("weak_agent", self.weak_agent, None, agents=False),
            Breaking("action_turn_rad", self.action_turn_rad, self.turns),
            Breaking("reward_offset", self.reward_offset, "flip-x"),
        )

    def gains(self, *full: float) -> tuple[float, ...]:
        """Return the accelerations of the agents, given the full ones; the first may be weaker."""
        return (full[0] * (1 - self.weak_agent), *full[1:])


class ParticleTask(LockstepTask):
    """A batch of particle worlds in lockstep.

    A subclass builds `spec`, calls `_build`, and implements the methods below that are abstract. Its state is laid out
    like the rows of `ParticleWorlds.physics`.
    """

    settings: ParticleSettings

    def _build(self, spec: TaskSpec, bodies: Bodies, full_gain: Sequence[float], first_learner: int = 0) -> None:
        """Make the worlds; `spec.num_agents` agents from `first_learner` on learn, the task drives the others."""
        self.spec = spec
        velocity_first = self.settings.convention == "esp"
        self.worlds = ParticleWorlds(bodies, self.num_seeds * self.num_envs, self.device, velocity_first)
        lanes = self.worlds.num_lanes
        self._control = torch.zeros(bodies.num_agents, 2, lanes, device=self.device)
        self._learner_control = self._control[first_learner : first_learner + spec.num_agents]
        self._moves = torch.zeros(spec.num_agents, 1, lanes, dtype=torch.int8, device=self.device)
        directions = [MOVES.points.index(p) for p in (LEFT, RIGHT, DOWN, UP)]
        self._directions = torch.tensor(directions, dtype=torch.int8, device=self.device).view(1, 4, 1)
        self._points = torch.tensor(MOVES.points, device=self.device)
        settings, gain = self.settings, torch.tensor(full_gain, device=self.device).view(-1, 1, 1)
        push = torch.cat([gain * settings.wind, torch.zeros_like(gain)], 1) + settings.gust_mean
        self._push = push if settings.wind or settings.gust_mean else None
        gusts = (spec.horizon, bodies.num_agents, 2, lanes) if settings.gust_std else (0,)
        self._gusts = torch.zeros(gusts, device=self.device)
        self._shift = torch.tensor([[settings.reward_offset], [0.0]], device=self.device)
        # the matrix of a linear function is what it gives for the basis vectors
        self._readout = self.observation_of(torch.eye(spec.state.width)).to(self.device)

    @abstractmethod
    def observation_of(self, state: Tensor) -> Tensor:
        """Return all observations in a global state, written to be read: the fast path is derived from it.

        Args:
            state: [..., state width]; the result is linear in it.

        Returns:
            [..., N * D].
        """

    @abstractmethod
    def _start(self, seed: int, lanes: slice) -> None:
        """Draw a new episode for the worlds `lanes` of one seed into the physics (velocities are already zero)."""

    @abstractmethod
    def _outcome(self) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the reward [N or 1, W'] and the metrics (each [W']) of the step just made; W' counts padded lanes."""

    def _drive(self) -> None:
        """Fill the controls of the agents that do not learn."""

    def _begin(self) -> None:
        self.worlds.velocity.zero_()
        for seed in range(self.num_seeds):
            lanes = slice(seed * self.num_envs, (seed + 1) * self.num_envs)
            self._start(seed, lanes)
            if self.settings.gust_std:
                shape = (*self._gusts.shape[:3], self.num_envs)
                self._gusts[..., lanes] = torch.randn(shape, generator=self.generators[seed], device=self.device)
        self.worlds.measure()

    def _play(self, action: Tensor) -> Outcome:
        self._act(action)
        self._drive()
        push = self._push
        if self.settings.gust_std:
            gust = self._gusts[self._time] * self.settings.gust_std
            push = gust if push is None else gust + push
        self.worlds.advance(self._control, push, self.settings.mud)
        reward, metrics = self._outcome()
        per_agent = self._per_world(reward.expand(self.spec.num_agents, -1).t())
        return per_agent, {name: self._per_world(value) for name, value in metrics.items()}

    def _put(self, state: Tensor) -> None:
        self.worlds.rows().copy_(state.reshape(-1, self.spec.state.width).t())
        self.worlds.measure()

    def state_dict(self) -> dict[str, Tensor]:
        """Return physics, clock, generators and the episode's gusts, if any."""
        return {
            "physics": self.worlds.rows().clone(memory_format=torch.contiguous_format),
            "time": torch.tensor(self._time),
            "generators": generator_states(self.generators),
        } | ({"gusts": self._gusts.clone()} if self.settings.gust_std else {})

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            UserError: the tensors belong to an environment of another size.
        """
        physics, states = tensors["physics"], tensors["generators"]
        if physics.shape != self.worlds.rows().shape or len(states) != self.num_seeds:
            raise UserError(OTHER_SIZE)
        self.worlds.rows().copy_(physics)
        self._time = int(tensors["time"])
        if self.settings.gust_std:
            self._gusts.copy_(tensors["gusts"])
        restore_generators(self.generators, states)
        self.worlds.measure()

    def _seen(self) -> Observation:
        rows = self.worlds.rows().t()
        lead = (self.num_seeds, self.num_envs)
        obs = exact_matmul(rows, self._readout).view(*lead, self.spec.num_agents, -1)
        return Observation(obs, rows.contiguous().view(*lead, -1))

    def _squared_to(self, target: Tensor) -> Tensor:
        """Return the squared distances [N, K, W'] of the first agents to where the reward counts targets [K, 2, W']."""
        square = (self.worlds.position.unsqueeze(1) - (target + self._shift)).square_()
        return square[:, :, 0] + square[:, :, 1]

    def _act(self, action: Tensor) -> None:
        """Write the learners' actions into the controls."""
        learners, worlds = self.spec.num_agents, self.worlds.num_worlds
        if self.settings.actions == "discrete":
            self._moves[:, 0, :worlds] = action.reshape(worlds, learners).t()
            chosen = (self._moves == self._directions).view(torch.int8)
            self._learner_control.copy_(chosen[:, 1::2] - chosen[:, 0::2])
        else:
            force = self.spec.action.admissible(action).reshape(worlds, learners, 2)
            self._learner_control[:, :, :worlds] = force.permute(1, 2, 0)
        if self.settings.action_turn_rad:
            self._learner_control.copy_(_turned(self._learner_control, self.settings.action_turn_rad))

    def _to_action(self, wish: Tensor) -> Tensor:
        """Turn wishes [N, 2, W'] (1 is a full force) into a joint action of this task's kind."""
        lead = (self.num_seeds, self.num_envs, self.spec.num_agents)
        wish = _turned(wish[:, :, : self.worlds.num_worlds], -self.settings.action_turn_rad)
        if self.settings.actions == "discrete":
            return nearest_move(wish).t().reshape(lead)
        return unit_disc(wish).permute(2, 0, 1).reshape(*lead, 2)

    def _move_control(self, moves: Tensor) -> Tensor:
        """Return the controls [N, 2, W] of discrete moves [N, W]."""
        return self._points[moves].movedim(-1, 1)

    def _per_world(self, values: Tensor) -> Tensor:
        """Return [S, E, ...] of the real worlds from [W', ...], as memory of its own."""
        return values[: self.worlds.num_worlds].contiguous().view(self.num_seeds, self.num_envs, *values.shape[1:])


def _turned(force: Tensor, angle: float) -> Tensor:
    """Return forces [N, 2, W] turned counter-clockwise by an angle, rad."""
    if angle == 0:
        return force
    x, y = force.unbind(1)
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], 1)


MOVE_THRESHOLD = 0.25
"""A wish shorter than this along both axes becomes a no-op."""


def nearest_move(wish: Tensor) -> Tensor:
    """Return the discrete move [N, W] along the longer axis of a wish [N, 2, W].

    The rule commutes with the eight symmetries of the square, except for wishes on a diagonal.
    """
    x, y = wish[:, 0], wish[:, 1]
    sideways = x.abs() > y.abs()
    left, right, down, up = (MOVES.points.index(p) for p in (LEFT, RIGHT, DOWN, UP))
    move = torch.where(sideways, torch.where(x > 0, right, left), torch.where(y > 0, up, down))
    return torch.where(torch.maximum(x.abs(), y.abs()) > MOVE_THRESHOLD, move, MOVES.points.index(STILL))


def unit_disc(wish: Tensor) -> Tensor:
    """Scale wishes [N, 2, W] longer than 1 back to length 1."""
    return wish / wish.norm(dim=1, keepdim=True).clamp_min(1.0)


def place(worlds: ParticleWorlds, lanes: slice, extents: Tensor, generator: torch.Generator) -> None:
    """Draw the position of every entity of the worlds `lanes` uniformly from its own square.

    Args:
        worlds: where to write.
        lanes: the worlds of one seed.
        extents: [entities], half side of the square of each, agents first.
        generator: that seed's generator.
    """
    shape = (len(extents), 2, lanes.stop - lanes.start)
    unit = torch.rand(shape, generator=generator, device=extents.device).mul_(2).sub_(1)
    worlds.entity[:, :, lanes] = unit * extents.view(-1, 1, 1)
