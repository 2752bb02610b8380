"""A task whose best policy is known, true to the symmetries of the square, and one that is false to them."""

import torch
from torch import Tensor

from esp_cli.training.build import Controller, play, stream_seeds
from esp_envs.base import Environment, Observation, Step, generator_states, generators_for, restore_generators
from esp_envs.scene import Scene
from esp_envs.settings import TaskSettings
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete, Field, Items, Kind, TaskSpec, joint_layout, layout

SEEDS = (0, 1)
HORIZON = 4
ACTIONS = Discrete(Kind.VECTOR, (RIGHT, UP, LEFT, DOWN), ("right", "up", "left", "down"))
OBSERVATION = layout(Field("target", Kind.VECTOR), Field("others", Kind.VECTOR, 1, items=Items.OTHERS))


class Pointing(Environment):
    """Two agents each see a target and the other's; both get the share of agents that point at their own target.

    A move is right where it lies along the longer component of the target, so the task is invariant under the eight
    symmetries of the square, and the best return is one per step: HORIZON.
    """

    def __init__(self, num_envs: int, seeds: list[int]) -> None:
        super().__init__(TaskSettings(), num_envs, generators_for(seeds))
        self.spec = TaskSpec(
            name="pointing",
            version=1,
            convention="share of agents that point right",
            num_agents=2,
            horizon=HORIZON,
            observation=OBSERVATION,
            state=joint_layout(OBSERVATION, 2),
            action=ACTIONS,
            symmetry="d4",
        )
        self._points = torch.tensor(ACTIONS.points)

    def best(self) -> Tensor:
        """Return the right action [S, E, N]."""
        return (self._target @ self._points.T).argmax(-1)

    def heuristic(self, name: str | None = None) -> Tensor:
        return self.best()

    def reset(self) -> Observation:
        self._time = 0
        return self._renew()

    def step(self, action: Tensor) -> Step:
        share = (action == self.best()).float().mean(-1, keepdim=True)
        self._time += 1
        ended = self._time == HORIZON
        final = self._renew()
        following = self.reset() if ended else final
        never = torch.zeros(share.shape[:2], dtype=torch.bool)
        return Step(following, share.expand(-1, -1, 2), never, never | ended, final if ended else None, {})

    def _renew(self) -> Observation:
        draws = [torch.randn(self.num_envs, 2, 2, generator=generator) for generator in self.generators]
        return self._show(torch.stack(draws))

    def _show(self, target: Tensor) -> Observation:
        self._target = target
        obs = torch.cat([target, target.flip(2)], -1)
        return Observation(obs, obs.flatten(2))

    def set_state(self, state: Tensor) -> Observation:
        self._time = 0
        return self._show(state.unflatten(-1, (2, 4))[..., :2])

    def state_dict(self) -> dict[str, Tensor]:
        return {
            "target": self._target,
            "time": torch.tensor(self._time),
            "generators": generator_states(self.generators),
        }

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        self._target, self._time = tensors["target"], int(tensors["time"])
        restore_generators(self.generators, tensors["generators"])

    def scene(self, world: tuple[int, int] = (0, 0)) -> Scene:
        return Scene((), (-1.0, 1.0, -1.0, 1.0))


class AlwaysRight(Pointing):
    """The right action is 'right' whatever the target: no rotation leaves this reward as it is."""

    def best(self) -> Tensor:
        return torch.full(self._target.shape[:-1], ACTIONS.names.index("right"))


def score(task: type[Pointing], controller: Controller) -> Tensor:
    """Return the mean return [S] of 250 episodes over the best possible one."""
    return play(task(250, stream_seeds(SEEDS, "evaluation")), controller).returns.mean(1) / HORIZON


def iterations_to(shares: list[Tensor], share: float) -> int:
    """Return after how many iterations every seed is at or above a share of the optimum."""
    return next(k for k, values in enumerate(shares) if (values >= share).all())
