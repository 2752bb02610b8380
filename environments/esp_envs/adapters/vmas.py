"""A VMAS scenario as a task: batched in torch, on CPU or GPU, with a layout that says what its numbers are.

`esp_envs.adapters.vmas_scenarios` holds layouts of twenty scenarios. Needs the extra `vmas`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from pydantic import Field as Setting
from torch import Tensor

from esp_envs.adapters import require_attributes, require_roles, seed_of, simulation
from esp_envs.base import Environment, Observation, Step, joined, require_shape
from esp_envs.errors import UserError
from esp_envs.roles import Role, of_role, spec_with_roles
from esp_envs.scene import Body, Scene
from esp_envs.settings import TaskSettings
from esp_envs.spec import Continuous, Field, Kind, Layout, layout

FORCE = Continuous(layout(Field("force", Kind.VECTOR, unit="share of the full force")))


class VmasSettings(TaskSettings):
    """What a user may change of every VMAS task; a subclass adds the scenario's own arguments."""

    num_agents: int = Setting(4, ge=1, le=64, description="N, agents of the team")
    horizon: int = Setting(100, ge=1, le=100_000, description="steps of an episode (0.1 s each)")


class VmasTask(Environment):
    """Worlds of one VMAS scenario whose agents apply a force in the plane, one simulator for each seed.

    A subclass sets the attributes below and implements `seen`. The global state holds what the physics moves: velocity
    and position (and angle and spin where it turns) of each entity, and the `flags`. Chance inside of a step has to
    come from torch; VMAS's own scenarios comply.

    Example:
        class Flocking(VmasTask):
            scenario, symmetry, convention = "flocking", "c1", "vmas flocking"

            def seen(self):
                vectors = (Field(name, Kind.VECTOR) for name in ("position", "velocity", "from_target"))
                return layout(*vectors, Field("lidar", Kind.RING, rays=12))
    """

    Settings: ClassVar[type[TaskSettings]] = VmasSettings
    settings: VmasSettings

    scenario: ClassVar[Any]
    """Name of a scenario that comes with VMAS, or a `BaseScenario`."""
    symmetry: str
    convention: str
    own_goals: str = ""
    """What the names of the landmarks begin with that belong to one agent each, in the agents' order."""
    flags: tuple[str, ...] = ()
    """Attributes of landmarks, 0 or 1 for each world, that belong to the state."""
    angles: tuple[str, ...] = ()
    """Landmarks that never turn, but stand at an angle that each episode draws; it belongs to the state."""
    hidden: tuple[str, ...] = ()
    """What decides what follows and is not in the state, as "clock"; see `TaskSpec`."""
    terminates: bool = False
    """Whether the scenario's `done`, if it has one, ends an episode; without it, `done` is a metric."""
    shared_reward: bool | Mapping[str, bool] = False
    """Whether all agents, or those of a role, get the same reward."""
    metrics: tuple[str, ...] = ()
    """Names in the scenario's `info`; their mean over the agents is a metric."""

    @abstractmethod
    def seen(self) -> Layout | Mapping[str, Layout]:
        """Return the layout of one agent's observation, after `reading`.

        Where agents of several kinds learn, that of each role by its name, with which the names of its agents begin.
        """

    def reading(self, obs: Tensor) -> Tensor:
        """Turn the scenario's observations [E, N, width] into the numbers of the layout [E, N, D].

        Rows of roles that see less end with zeros.
        """
        return obs

    def arguments(self) -> dict[str, object]:
        """Return the scenario's arguments; by default every setting but the horizon, agents as `n_agents`."""
        own = self.settings.model_dump(exclude={"horizon", "num_agents"})
        return {"n_agents": self.settings.num_agents} | own

    def __init__(self, settings: TaskSettings, num_envs: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(settings, num_envs, generators)
        require_attributes(self, "scenario", "symmetry", "convention")
        made = self.scenario, num_envs, self.device, self.arguments()
        self._sims = [simulation.simulator(*made) for _ in self.generators]
        self.terminates = self.terminates and simulation.has_end(self._sims[0])
        self._numbers = [simulation.RandomNumbers(generator.initial_seed()) for generator in self.generators]
        given = self.seen()
        seen = given if isinstance(given, Mapping) else {"": given}
        self._groups = simulation.groups_of(self._sims[0].agents, list(seen) if isinstance(given, Mapping) else [])
        require_roles(self, [name for name in seen if name])
        self._entities = simulation.Entities(self._sims[0], self.own_goals, self.flags, self.angles, self._groups)
        self.spec = spec_with_roles(
            [
                Role(
                    name=name,
                    num_agents=where.stop - where.start,
                    observation=seen[name],
                    action=FORCE,
                    shared_reward=of_role(self.shared_reward, name, False),
                )
                for name, where in self._groups.items()
            ],
            name=f"vmas-{self.scenario}" if isinstance(self.scenario, str) else type(self).__name__.lower(),
            version=1,
            convention=self.convention,
            horizon=self.settings.horizon,
            state=self._entities.layout,
            symmetry=self.symmetry,
            hidden=self.hidden,
            terminates=self.terminates,
            totals=("done",) if self.terminates else (),
            settings=settings.model_dump(),
        )
        self._range = torch.tensor([simulation.force_of(agent) for agent in self._sims[0].agents], device=self.device)
        self._base = torch.zeros(self.num_seeds, dtype=torch.int64)
        lead = (self.num_seeds, num_envs)
        self._begun, self._time = torch.zeros(2, *lead, dtype=torch.int64).unbind()  # on the CPU: clocks are asked
        with simulation.RandomNumbers(0).drawn():
            first = self._sims[0].reset()
        width = self.reading(self._rows(first)).shape[-1]
        if width != self.spec.observation.width:
            raise UserError(
                f"the scenario shows {width} numbers to an agent, but the layout has {self.spec.observation.width}"
            )

    def reset(self) -> Observation:
        for s, generator in enumerate(self.generators):
            self._base[s] = torch.randint(2**31, (), generator=generator, device=self.device)
            self._numbers[s] = simulation.RandomNumbers(int(self._base[s]))
        self._begun.zero_()
        return _joined([self._begin(s) for s in range(self.num_seeds)])

    def step(self, action: Tensor) -> Step:
        require_shape("joint action", action, self.action_shape)
        force = self.spec.admissible(action) * self._range.unsqueeze(-1)
        reached, following, rewards, ends, measured = [], [], [], [], []
        self._time += 1
        due = self._time == self.spec.horizon
        for s, sim in enumerate(self._sims):
            with self._numbers[s].drawn():
                obs, reward, done, infos = sim.step(list(force[s].unbind(1)))
            here = self._look(sim, obs)
            done = simulation.rows([done], "done", self.num_envs, 1)[:, 0, 0].bool()
            over = done.cpu() if self.terminates else torch.zeros(self.num_envs, dtype=torch.bool)
            ends.append(over)
            reached.append(here)
            following.append(self._renew(s, over | due[s], here))
            rewards.append(simulation.rows(reward, "reward", self.num_envs, 1).squeeze(-1))
            measured.append([done.float(), *(_mean(infos, name, done) for name in self.metrics)])
        terminated = torch.stack(ends)
        final = _joined(reached) if self.terminates or bool(due.any()) else None
        columns = (torch.stack(column) for column in zip(*measured, strict=True))
        return Step(
            next=_joined(following),
            reward=torch.stack(rewards),
            terminated=terminated.to(self.device),
            truncated=(due & ~terminated).to(self.device),
            final=final,
            metrics=dict(zip(("done", *self.metrics), columns, strict=True)),
        )

    def set_state(self, state: Tensor) -> Observation:
        require_shape("state", state, self.state_shape)
        self._time.zero_()
        parts = []
        for s, sim in enumerate(self._sims):
            with self._numbers[s].drawn():
                self._entities.write(sim, state[s])
                for agent in sim.agents:
                    if agent.action.u is None:  # some rewards look at forces before there are any
                        agent.action.u = torch.zeros(self.num_envs, agent.action_size, device=self.device)
                for agent in sim.agents:  # brings what rewards remember of the step before up to date
                    sim.scenario.reward(agent)
                self._entities.write(sim, state[s])
            parts.append(self._look(sim, sim.get_from_scenario(True, False, False, False)[0]))
        return _joined(parts)

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        sim = self._sims[world[0]]
        bodies = [_body(entity, world[1], entity in sim.agents) for entity in [*sim.world.landmarks, *sim.agents]]
        half = 1.2 * max(1.0, float(sim.world.x_semidim or 1), float(sim.world.y_semidim or 1))
        return Scene(tuple(bodies), (-half, half, -half, half))

    def _begin(self, s: int) -> Observation:
        sim, seed = self._sims[s], seed_of(int(self._base[s]), int(self._begun[s, 0]))
        with simulation.RandomNumbers(seed).drawn():
            obs = sim.reset(seed=seed)
        self._begun[s] += 1
        self._time[s] = 0
        return self._look(sim, obs)

    def _renew(self, s: int, over: Tensor, here: Observation) -> Observation:
        """Start the next episode in some worlds [E] of one seed, each from a seed of its own; the others go on."""
        if not over.any() or not self.renews:
            return here
        if not self.terminates:
            return self._begin(s)
        sim, base = self._sims[s], int(self._base[s])
        for world in over.nonzero().flatten().tolist():
            with simulation.RandomNumbers(seed_of(base, int(self._begun[s, world]), world)).drawn():
                sim.reset_at(world, return_observations=False)
        self._begun[s] += over
        self._time[s][over] = 0
        with simulation.RandomNumbers(seed_of(base, int(self._begun[s].sum()))).drawn():
            new = self._look(sim, sim.get_from_scenario(True, False, False, False)[0])
        which = over.to(self.device)
        obs = torch.where(which[None, :, None, None], new.obs, here.obs)
        return Observation(obs, torch.where(which[None, :, None], new.state, here.state))

    def _rows(self, obs: Sequence[Tensor]) -> Tensor:
        """Return the scenario's observations [E, N, width]."""
        parts = [simulation.rows(obs[where], "observation", self.num_envs) for where in self._groups.values()]
        return joined(parts)

    def _look(self, sim: Any, obs: Sequence[Tensor]) -> Observation:
        return Observation(self.reading(self._rows(obs)).unsqueeze(0), self._entities.read(sim).unsqueeze(0))


def _joined(parts: Sequence[Observation]) -> Observation:
    """Return the seeds' observations as memory of their own."""
    return Observation(torch.cat([part.obs for part in parts]), torch.cat([part.state for part in parts]))


def _mean(infos: Sequence[dict[str, Tensor]], name: str, like: Tensor) -> Tensor:
    found = [info[name].float().reshape(len(like)) for info in infos if name in info]
    if not found:
        told = ", ".join({name: None for info in infos for name in info}) or "nothing"
        raise UserError(f"the scenario's info has no metric '{name}'; it has {told}; correct 'metrics'")
    return torch.stack(found).mean(0)


def _body(entity: Any, world: int, is_agent: bool) -> Body:
    color = entity.color if not isinstance(entity.color, Tensor) else entity.color[world].tolist()
    red, green, blue = (round(255 * float(part)) for part in list(color)[:3])
    x, y = entity.state.pos[world].tolist()
    shape = "square" if type(entity.shape).__name__ == "Box" else "disc"
    radius = float(entity.shape.circumscribed_radius()) * (0.7071 if shape == "square" else 1.0)
    color, label = f"#{red:02x}{green:02x}{blue:02x}", "agent" if is_agent else "landmark"
    return Body((x, y), max(radius, 0.01), color, shape, trail=is_agent, label=label)
