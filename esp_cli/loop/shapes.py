"""The tensors of a foreign loop: their shapes, and how actions and numbers of agents move.

Whatever does not fit is refused by a `UserError` of one sentence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, cast

import torch
from torch import Tensor, nn

from esp_cli.files.formatting import Shown
from esp_cli.symmetry import Transform
from esp_envs.errors import UserError
from esp_envs.spec import ActionSpace, Continuous, Discrete, Layout, Spaces

# what messages advise where numbers look like memory
HIDDEN = "a stored hidden state cannot be transformed; give whole histories from their first step instead"
# what messages advise where actions and layouts carry no group of the plane
ANOTHER = "give another group, or fields that say what the numbers are"
# what arguments of a symmetry are, and what a message says to give
_ARGUMENTS = {
    "observation": (Layout, "layout(Field(...), ...)"),
    "action": (Discrete | Continuous, "discrete_moves(...), Discrete or Continuous"),
    "group": (str, 'a text, as "d4"'),
    "num_agents": (int, "a number of agents"),
    "state": (Layout | None, "layout(Field(...), ...)"),
    "seed": (int, "a number"),
}


class Augmented(tuple[Any, ...]):
    """Data with its copies: obs, action, state where one was given, and per_agent, in this order or by name."""

    __slots__ = ()

    @property
    def obs(self) -> Tensor:
        return cast("Tensor", self[0])

    @property
    def action(self) -> Tensor:
        return cast("Tensor", self[1])

    @property
    def state(self) -> Tensor | None:
        """[..., Ds]; None where none was given."""
        return self[2] if len(self) > 3 else None

    @property
    def per_agent(self) -> tuple[Tensor, ...]:
        return cast("tuple[Tensor, ...]", self[-1])


def check_arguments(
    observation: Layout, action: ActionSpace, group: str, num_agents: int, state: Layout | None, copies: str, seed: int
) -> None:
    """Refuse arguments of a symmetry that are of another kind or out of range."""
    given = (observation, action, group, num_agents, state, seed)
    for value, (name, (kind, example)) in zip(given, _ARGUMENTS.items(), strict=True):
        if not isinstance(value, kind):
            raise UserError(f"{name} is {value!r}; give {example}")
    if copies not in ("draw", "all"):
        raise UserError(f"copies is {copies!r}; choose 'draw' or 'all'")
    if num_agents < 1:
        raise UserError(f"num_agents is {num_agents}; there is at least one agent")
    if not -(2**63) <= seed < 2**64:
        raise UserError(f"seed is {seed}; give a number from 0 to 2**64 - 1")


def lead_of(spaces: Spaces, obs: Tensor) -> torch.Size:
    """Return the leading axes of observations."""
    return _check_rows("obs", obs, spaces.observation, agents=_agents(spaces))


def check_state(spaces: Spaces, state: Tensor, lead: torch.Size | None = None) -> torch.Size:
    """Return the leading axes of states."""
    return _check_rows("state", state, spaces.state, lead)


@dataclass(frozen=True)
class CheckedTransform(Transform):
    """A transform of the data of one call, with their leading axes: it takes the shapes of `augment` and no others."""

    lead: torch.Size

    @property
    def axes(self) -> tuple[int, ...]:
        """The leading axes, and that of agents where there is one."""
        return (*self.lead, *_agents(self.spaces))

    def action(self, action: Tensor) -> Tensor:
        """Return K_g a, of indices [..., N], [..., N, 1] or one-hot [..., N, A], or continuous actions."""
        check_tensor("action", action)
        space, axes, shape = self.spaces.action, self.axes, list(action.shape)
        if not isinstance(space, Discrete):
            if action.shape != (*axes, space.width):
                raise UserError(f"the action has shape {shape}, but {[*axes, space.width]} is needed")
            if not action.is_floating_point():
                raise UserError(f"the action is {action.dtype}; give floating-point numbers")
            return super().action(action)
        if action.shape == (*axes, space.count) and space.count > 1:
            return self.push_outputs(action)
        if action.shape not in (axes, (*axes, 1)):
            raise UserError(f"the action has shape {shape}, but {list(axes)} is needed, or one-hot with {space.count}")
        if action.is_floating_point() or action.is_complex() or action.dtype == torch.bool:
            raise UserError(f"the action is {action.dtype}, but indices of {space.count} actions are integers")
        indices = action.long()
        low, high = torch.aminmax(indices) if action.numel() else (0, 0)
        if low < 0 or high >= space.count:
            outside = int(low if low < 0 else high)
            raise UserError(f"the action {outside} is outside of the {space.count} actions, 0 to {space.count - 1}")
        return super().action(indices.reshape(axes)).reshape(action.shape).to(action.dtype)

    def per_agent(self, x: Tensor, name: str = "per_agent") -> Tensor:
        """Let a number per agent, [..., N] or [..., N, 1], move with it; one per row, [...] or [..., 1], stays."""
        return self._carried(super().per_agent, x, name)

    def values(self, values: Tensor, name: str = "the policy's output") -> Tensor:
        """Return values per agent, [..., N] or [..., N, 1], to their agents; one per row stays."""
        return self._carried(super().values, values, name)

    def action_values(self, values: Tensor) -> Tensor:
        """Return values of all discrete actions, [..., N, A], to their agents and actions."""
        check_tensor("value", values)
        if values.shape != (needed := (*self.axes, self.num_outputs)):
            raise UserError(f"value has shape {list(values.shape)}, but {list(needed)} is needed")
        return self.pull_back(values)

    def along(self, x: Tensor, name: str) -> Tensor:
        """Move what goes with its agent: a number as by `per_agent`, or an action mask."""
        check_tensor(name, x)
        space = self.spaces.action
        if isinstance(space, Discrete) and space.count > 1 and x.shape == (*self.axes, space.count):
            if x.dtype != torch.bool:
                raise UserError(f"{name} is {x.dtype}, but an action mask is torch.bool; give mask.bool()")
            return self.push_outputs(x)
        return self.per_agent(x, name)

    def _carried(self, move: Callable[[Tensor], Tensor], x: Tensor, name: str) -> Tensor:
        check_tensor(name, x)
        lead, agents, tail = self.lead, self.axes, x.shape[len(self.lead) :]
        if x.shape[: len(lead)] == lead and tail.numel() == 1:
            return x
        if x.shape in (agents, (*agents, 1)):
            return move(x.reshape(agents)).reshape(x.shape)
        reason = f"; {HIDDEN}" if x.shape[: len(agents)] == agents else ""
        needed = " or ".join(dict.fromkeys(str(list(shape)) for shape in (agents, lead)))
        raise UserError(f"{name} has shape {list(x.shape)}, but {needed} is needed{reason}")


def checked(transform: Transform, lead: torch.Size) -> CheckedTransform:
    """Return a transform for data with these leading axes."""
    return CheckedTransform(**{field.name: getattr(transform, field.name) for field in fields(transform)}, lead=lead)


def check_mask(spaces: Spaces, mask: Tensor | None, lead: torch.Size) -> None:
    """Refuse what is no mask of discrete actions [..., N, A], if there is one."""
    if mask is None:
        return
    if not isinstance(spaces.action, Discrete):
        raise UserError("an action mask is for discrete actions; leave it out")
    shape = [*lead, *_agents(spaces), spaces.action.count]
    if list(mask.shape) != shape or mask.dtype != torch.bool:
        raise UserError(f"the action mask is {mask.dtype} {list(mask.shape)}, but torch.bool {shape} is needed")


def check_tensor(name: str, x: object) -> None:
    """Refuse what is no tensor."""
    if not isinstance(x, Tensor):
        raise UserError(f"{name} is of type {type(x).__name__}; give a tensor")


def check_alike(name: str, moved: Iterable[Tensor], here: Tensor) -> None:
    """Refuse to compare outputs for moved and for original data in different shapes, such as [B, 1] and [B]."""
    for x in moved:
        if x.shape != here.shape:
            raise UserError(
                f"{name} has shape {list(x.shape)} for the moved data, but {list(here.shape)} for the originals "
                "(here); give both in one shape"
            )


def check_rows(spaces: Spaces, gap: Tensor, lead: torch.Size) -> None:
    """Refuse what a policy says of fewer or more rows and agents than it was given."""
    needed = (*lead, *_agents(spaces))
    if gap.numel() != math.prod(needed):
        raise UserError(f"the policy's outputs have the leading axes {list(gap.shape)}, but {list(needed)} is needed")


def mean_counted(gaps: list[Tensor], mask: Tensor | None) -> Tensor:
    """Return the mean over elements, rows and agents, of the rows that count; 0 where none does."""
    gap = torch.stack(gaps)
    counted = gap if mask is None else gap[:, _flags(mask, gap.shape[1:])]
    return counted.mean() if counted.numel() else counted.sum()


def _flags(mask: Tensor, shape: torch.Size) -> Tensor:
    """Return which rows count, of a mask of flags, or of zeros and ones, that goes with the first axes of `shape`."""
    if mask.shape != shape[: mask.dim()]:
        raise UserError(f"mask has shape {list(mask.shape)}, but the rows have {list(shape)}; give a flag for each row")
    flags = mask.bool()
    if mask.dtype != torch.bool and not torch.equal(flags.to(mask.dtype), mask):
        raise UserError("mask holds other numbers than 0 and 1; it says which rows count, and weighs none")
    return flags


def _check_rows(
    name: str, x: Tensor, layout: Layout, lead: torch.Size | None = None, agents: tuple[int, ...] = ()
) -> torch.Size:
    """Return the leading axes of rows [..., *agents, width] after checking that they are that."""
    check_tensor(name, x)
    cut = x.dim() - 1 - len(agents)
    found = x.shape[: max(cut, 0)]
    if x.shape[-1:] != (layout.width,):
        width = x.shape[-1] if x.dim() else 0
        raise UserError(f"{name} has rows of {width} numbers, but its layout has {layout.width}: {layout.summary}")
    if cut < 0 or x.shape[cut:-1] != agents:
        raise UserError(f"{name} has shape {list(x.shape)}, but axis -2 must hold {agents[0]} agents")
    if lead is not None and found != lead:
        raise UserError(f"{name} has leading axes {list(found)}, but those of obs are {list(lead)}")
    if not x.is_floating_point():
        raise UserError(f"{name} is {x.dtype}; give floating-point numbers")
    return found


def _agents(spaces: Spaces) -> tuple[int, ...]:
    """Return the agent axis, where there is one."""
    return (spaces.num_agents,) if spaces.num_agents > 1 else ()


class Draws(Shown, nn.Module):
    """Keeps a generator. Its state is all that `state_dict` holds, and a file without it loads too."""

    def __init__(self, shown: Mapping[str, object], observation: Layout, action: ActionSpace, seed: int) -> None:
        super().__init__()
        acts = f"{action.count} choices" if isinstance(action, Discrete) else action.layout.summary
        self._shown = {**shown, "observation": observation.summary, "action": acts}
        self.generator = torch.Generator().manual_seed(seed)

    def _facts(self) -> Mapping[str, object]:
        return self._shown

    def get_extra_state(self) -> Tensor:
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        self.generator.set_state(state.cpu())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the draws, or leave them as they are: files of loops that were written before have none."""
        state_dict.setdefault(f"{prefix}_extra_state", self.get_extra_state())
        super()._load_from_state_dict(state_dict, prefix, *rest)
