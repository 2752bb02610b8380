"""Make tasks at random whose symmetries are known: agents, marks and hidden places in the plane.

A task is a reward, a force, a noise, a start, actions and a way to list marks, each of some family. Most families have
symmetric and broken members. What holds is measured with the noise off: by how many standard deviations a step from the
transformed state differs from the transformed step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from esp_cli.symmetry import Element, build_transform
from esp_cli.symmetry.plane import PlaneElement
from esp_envs.base import TaskSettings
from esp_envs.batched import BatchedTask, to_others
from esp_envs.mpe.task import FORCE
from esp_envs.spec import ActionSpace, Discrete, Field, Items, Kind, Layout, TaskSpec, discrete_moves, layout
from tests.benchmarks.laws import Scene, forces, noises, rewards

_CROSS = ("stay", "right", "up", "left", "down")


@dataclass(frozen=True)
class Recipe:
    """A task made at random.

    Attributes:
        seed: that it was made from.
        reward, force, noise: names of families.
    """

    seed: int
    reward: str
    force: str
    noise: str
    agents: int
    marks: int
    start: str
    listed: str
    tails: str
    action: ActionSpace

    @classmethod
    def drawn(cls, seed: int) -> Recipe:
        """Draw a task; rewards come in turn, so that each family is there equally often."""
        rng = np.random.default_rng(seed)
        agents = int(rng.integers(1, 4))
        names = list(rewards(rng, agents))
        own = rng.uniform() < 0.6
        count = int(rng.choice([3, 4, 5, 6, 8]))
        return cls(
            seed=seed,
            reward=names[seed % len(names)],
            force=str(rng.choice(list(forces(rng, agents)) if own else ["none", "drag", "a spring"])),
            noise=str(rng.choice(list(noises(rng)))) if rng.uniform() < 0.5 else "none",
            agents=agents,
            marks=int(rng.integers(1, 4)),
            start=str(rng.choice(["square", "disc", "normal"])),
            listed=str(rng.choice(["as they are", "as they are", "as they are", "nearest first", "by x"])),
            tails=str(rng.choice(["normal", "laplace", "uniform"])),
            action=FORCE if rng.uniform() < 0.4 else discrete_moves(_CROSS if count == 5 else count),
        )

    def make(self, num_envs: int, seeds: Sequence[int], quiet: bool = False) -> Synthetic:
        """Make worlds of the task."""
        return Synthetic(self, num_envs, [torch.Generator().manual_seed(seed) for seed in seeds], quiet)


class Synthetic(BatchedTask):
    """Worlds of a recipe; without noise where they are quiet."""

    def __init__(self, recipe: Recipe, num_envs: int, generators: Sequence[torch.Generator], quiet: bool) -> None:
        self.recipe, self.quiet = recipe, quiet
        rng = np.random.default_rng(recipe.seed + 10_000)
        self.reward = rewards(rng, recipe.agents)[recipe.reward]
        self.force = forces(rng, recipe.agents)[recipe.force]
        self.noise = noises(rng)[recipe.noise]
        super().__init__(TaskSettings(), num_envs, generators)

    def _describe(self) -> TaskSpec:
        agents, marks = self.recipe.agents, self.recipe.marks
        seen = [Field("velocity", Kind.VECTOR), Field("position", Kind.VECTOR), Field("marks", Kind.VECTOR, marks)]
        seen += [Field("others", Kind.VECTOR, agents - 1, items=Items.OTHERS)] if agents > 1 else []
        of_agents = {"count": agents, "items": Items.AGENTS}
        state = layout(
            Field("position", Kind.VECTOR, **of_agents),
            Field("velocity", Kind.VECTOR, **of_agents),
            Field("marks", Kind.VECTOR, marks),
            Field("hidden", Kind.VECTOR),
            Field("clock", Kind.SCALAR),
        )
        return TaskSpec(
            name=f"synthetic {self.recipe.seed}",
            version=1,
            num_agents=agents,
            observation=Layout(tuple(seen)),
            state=state,
            action=self.recipe.action,
            symmetry="c1",
            horizon=12,
            shared_reward=False,
            control_period_s=0.1,
            convention="synthetic",
        )

    def _start(self, generator: torch.Generator) -> dict[str, Tensor]:
        r, e = self.recipe, self.num_envs

        def points(count: int) -> Tensor:
            drawn = torch.rand(e, count, 2, generator=generator) * 2 - 1
            if r.start == "square":
                return drawn
            if r.start == "normal":
                return 0.6 * torch.randn(e, count, 2, generator=generator)
            radius = torch.rand(e, count, 1, generator=generator).sqrt()
            return 1.2 * radius * torch.stack([(math.pi * drawn[..., 0]).cos(), (math.pi * drawn[..., 0]).sin()], -1)

        hidden = torch.rand(e, 1, generator=generator) * 2 * math.pi
        return {
            "position": points(r.agents),
            "velocity": 0.5 * points(r.agents),
            "marks": points(r.marks),
            "hidden": torch.stack([hidden.cos(), hidden.sin()], -1),
            "clock": torch.zeros(e, 1, 1),
        }

    def _advance(self, world: dict[str, Tensor], action: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        scene = self.scene_of(world, action)
        speed = 0.8 * scene.v + self.force(scene) + self._noise(self.noise[1](scene))
        reward = self.reward(scene) + self._noise(self.noise[0](scene))
        world["velocity"] = speed
        world["position"] = world["position"] + 0.2 * speed
        world["clock"] = world["clock"] + 1
        return reward, {}

    def scene_of(self, world: dict[str, Tensor], action: Tensor) -> Scene:
        """Return what laws may depend on."""
        if isinstance(self.spec.action, Discrete):
            action = torch.tensor(self.spec.action.points, dtype=torch.float32)[action]
        return Scene(world["position"], world["velocity"], world["marks"], action, world["hidden"], world["clock"])

    def _noise(self, deviation: Tensor) -> Tensor:
        if self.quiet:
            return torch.zeros_like(deviation)
        drawn = torch.stack([torch.rand(deviation.shape[1:], generator=g) for g in self.generators])
        if self.recipe.tails == "uniform":
            return deviation * (drawn - 0.5) * 12**0.5
        drawn = drawn.clamp(1e-6, 1 - 1e-6)
        if self.recipe.tails == "normal":
            return deviation * torch.special.ndtri(drawn)
        side = drawn - 0.5
        return -deviation * side.sign() * torch.log1p(-2 * side.abs()) / 2**0.5

    def _observe(self, world: dict[str, Tensor]) -> Tensor:
        p, marks = world["position"], world["marks"]
        seen = marks.unsqueeze(2) - p.unsqueeze(3)
        if self.recipe.listed != "as they are":
            key = seen.norm(dim=-1) if self.recipe.listed == "nearest first" else seen[..., 0]
            seen = seen.gather(3, key.argsort(-1).unsqueeze(-1).expand_as(seen))
        parts = [world["velocity"], p, seen.flatten(3)]
        return torch.cat([*parts, *([to_others(p).flatten(3)] if self.recipe.agents > 1 else [])], -1)


def broken_by(recipe: Recipe, elements: Sequence[Element], worlds: int = 256, steps: int = 8) -> list[float]:
    """Return by how many standard deviations of the worst field a step from the image differs from the step's image.

    NaN where some states have no image that could be seen, as where marks are listed by x; infinite where most do.

    Of the noise of speeds, variances are compared; the reward's changes no mean.
    """
    loud = recipe.make(worlds, [1])
    seen, rows = loud.reset(), []
    for _ in range(steps):
        action = loud.random_action()
        step = loud.step(action)
        rows.append((seen.state, action, step.reward, step.reached.obs - seen.obs))
        seen = step.next
    state, action, reward, change = (torch.cat(part, 1) for part in zip(*rows, strict=True))
    quiet, spec = recipe.make(state.shape[1], [1], quiet=True), loud.spec
    fields = spec.observation.slices()
    scales = {name: _rms(change[..., where] - change[..., where].mean((0, 1, 2))) for name, where in fields.items()}
    scale, here = float(reward.std()), _after(quiet, state, action)
    gaps = []
    for element in elements:
        transform = build_transform([element], spec)
        moved_state, moved_action = transform.state(state), transform.action(action)
        there = _after(quiet, moved_state, moved_action)
        image = (transform.obs(here[0]), transform.obs(here[1]), transform.per_agent(here[2]))
        like = (there[0] - image[0]).abs().amax((0, 2, 3)) < 1e-4
        if not bool(like.all()):
            gaps.append(math.nan if float(like.float().mean()) > 0.05 else math.inf)
            continue
        found = [_rms(there[2] - image[2]) / scale]
        found += [_rms((there[1] - image[1])[..., where]) / scales[name] for name, where in fields.items()]
        scene = quiet.scene_of(quiet._split(state), action)
        moved = quiet.scene_of(quiet._split(moved_state), moved_action)
        pushed = loud.noise[1](moved)
        matrix = torch.as_tensor(PlaneElement.of(element).matrix, dtype=torch.float32)
        own = matrix @ torch.diag_embed(loud.noise[1](scene) ** 2) @ matrix.T
        if element.permutation is not None:
            own = own[:, :, torch.tensor(element.permutation).argsort()]
        found.append(_rms(torch.diag_embed(pushed**2) - own) / scales["velocity"] ** 2)
        gaps.append(max(found))
    return gaps


def _after(env: Synthetic, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    start = env.set_state(state)
    step = env.step(action)
    return start.obs, step.reached.obs, step.reward


def _rms(x: Tensor) -> float:
    return float(x.double().square().mean().sqrt())
