"""Tasks with a fault of their own: what a task shows, pays or does is not as its spec says."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from esp_envs import Environment, Field, Items, Kind, Layout, Observation, Step, make
from esp_envs.settings import TaskSettings
from esp_envs.spec import Continuous, TaskSpec

Distort = Callable[[Tensor, Environment], Tensor]


@dataclass(frozen=True)
class Fault:
    """A change of one part of a task."""

    seen: Distort | None = None
    paid: Callable[[Tensor, Observation], Tensor] | None = None
    done: Callable[[Tensor], Tensor] | None = None
    told: Callable[[TaskSpec], TaskSpec] | None = None


class Faulty(Environment):
    def __init__(self, inner: Environment, fault: Fault) -> None:
        super().__init__(TaskSettings(), inner.num_envs, inner.generators)
        self.inner, self.fault = inner, fault
        self.heuristics = inner.heuristics  # type: ignore[misc]
        self.spec = inner.spec if fault.told is None else fault.told(inner.spec)

    def reset(self) -> Observation:
        return self._shown(self.inner.reset())

    def step(self, action: Tensor) -> Step:
        step = self.inner.step(action if self.fault.done is None else self.fault.done(action))
        reached = step.final or step.next
        reward = step.reward if self.fault.paid is None else self.fault.paid(step.reward, reached)
        final = None if step.final is None else self._shown(step.final)
        return replace(step, next=self._shown(step.next), final=final, reward=reward)

    def set_state(self, state: Tensor) -> Observation:
        return self._shown(self.inner.set_state(state))

    def heuristic(self, name: str | None = None) -> Tensor:
        return self.inner.heuristic(name)

    def state_dict(self) -> dict[str, Tensor]:
        return self.inner.state_dict()

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        self.inner.load_state_dict(tensors)

    def _shown(self, seen: Observation) -> Observation:
        if self.fault.seen is None:
            return seen
        return Observation(self.fault.seen(seen.obs.clone(), self.inner), seen.state)


def with_fault(task: str, settings: dict[str, object], fault: Fault) -> Callable[[int, Sequence[int]], Environment]:
    return lambda num_envs, seeds: Faulty(make(task, num_envs, seeds, settings), fault)


def field_of(name: str, change: Callable[[Tensor], Tensor]) -> Fault:
    """Change the vectors [..., items, 2] of one field of what agents see."""

    def seen(obs: Tensor, env: Environment) -> Tensor:
        where = env.spec.observation.slices()[name]
        obs[..., where] = change(obs[..., where].unflatten(-1, (-1, 2))).flatten(-2)
        return obs

    return Fault(seen=seen)


def declared(change: Callable[[Field], Field], *names: str) -> Fault:
    def told(spec: TaskSpec) -> TaskSpec:
        fields = tuple(change(f) if f.name in names else f for f in spec.observation.fields)
        return replace(spec, observation=Layout(fields))

    return Fault(told=told)


def as_scalars(field: Field) -> Field:
    return replace(field, kind=Kind.SCALAR, count=field.count * 2, items=Items.FIXED, is_point=False)


def as_fixed(field: Field) -> Field:
    return replace(field, items=Items.FIXED)


def wheels_as_scalars(spec: TaskSpec) -> TaskSpec:
    assert isinstance(spec.action, Continuous)
    fields = tuple(replace(f, kind=Kind.SCALAR, count=2) for f in spec.action.layout.fields)
    return replace(spec, action=Continuous(Layout(fields)))


def negated_x(v: Tensor) -> Tensor:
    return v * torch.tensor([-1.0, 1.0])


def negated_y(v: Tensor) -> Tensor:
    return v * torch.tensor([1.0, -1.0])


def swapped_axes(v: Tensor) -> Tensor:
    return v.flip(-1)


def stretched(v: Tensor) -> Tensor:
    return v * torch.tensor([1.1, 1.0])


def shifted(v: Tensor) -> Tensor:
    return v + torch.tensor([0.05, 0.0])


def skewed(v: Tensor) -> Tensor:
    return v + 0.1 * v.flip(-1) * torch.tensor([1.0, 0.0])


def clipped(v: Tensor) -> Tensor:
    return v.clamp(-0.5, 0.5)


def nearest_first(v: Tensor) -> Tensor:
    order = v.norm(dim=-1).argsort(-1)
    return v.gather(-2, order.unsqueeze(-1).expand(v.shape))


def turned_by_first(name: str) -> Fault:
    """Show a field in the frame of another field's direction, while the layout says the world's."""

    def seen(obs: Tensor, env: Environment) -> Tensor:
        slices = env.spec.observation.slices()
        first = obs[..., slices[env.spec.observation.fields[0].name]][..., :2]
        cos, sin = (first / first.norm(dim=-1, keepdim=True).clamp_min(1e-6)).unbind(-1)
        x, y = obs[..., slices[name]].unflatten(-1, (-1, 2)).unbind(-1)
        cos, sin = cos.unsqueeze(-1), sin.unsqueeze(-1)
        obs[..., slices[name]] = torch.stack([cos * x + sin * y, cos * y - sin * x], -1).flatten(-2)
        return obs

    return Fault(seen=seen)


def wind(strength: float) -> Fault:
    """Push every agent along x by a share of its full force."""
    return Fault(done=lambda action: action * 0.5 + torch.tensor([strength, 0.0]))


def uneven_motors(action: Tensor) -> Tensor:
    return action * torch.tensor([1.0, 0.9])


def lazy_agent(action: Tensor) -> Tensor:
    action = action.clone()
    action[:, :, 0] = action[:, :, 0] * 0.8
    return action


def never_right(action: Tensor) -> Tensor:
    return torch.where(action == 2, 0, action)


def slope(reward: Tensor, seen: Observation) -> Tensor:
    return reward + 0.1 * seen.state[..., -1:].abs() + 0.05 * seen.state[..., -1:]


def first_counts_more(reward: Tensor, seen: Observation) -> Tensor:
    reward = reward.clone()
    reward[..., 0] = reward[..., 0] * 1.2 + 0.1
    return reward
