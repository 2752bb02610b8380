"""The tensors of a foreign loop: their shapes, checked in one sentence, and how actions and numbers of agents move."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from esp_cli.symmetry import Transform
from esp_envs.spec import Discrete, Layout, Spaces

HIDDEN = "a stored hidden state cannot be transformed; give whole histories from their first step instead"
"""What messages advise where numbers look like memory."""


def lead_of(spaces: Spaces, obs: Tensor) -> torch.Size:
    """Return the leading axes of observations.

    Raises:
        ValueError: their shape or type does not fit.
    """
    return _check_rows("obs", obs, spaces.observation, agents=_agents(spaces))


def check_state(spaces: Spaces, state: Tensor, lead: torch.Size | None = None) -> torch.Size:
    """Return the leading axes of states.

    Raises:
        ValueError: their shape or type does not fit, or the leading axes are not those of the observations.
    """
    return _check_rows("state", state, spaces.state, lead)


def act(spaces: Spaces, transform: Transform, action: Tensor, lead: torch.Size) -> Tensor:
    """Return K_g a; shapes as of `augment`.

    Raises:
        ValueError: another shape or type, or an action outside.
    """
    space, axes, shape = spaces.action, (*lead, *_agents(spaces)), list(action.shape)
    if not isinstance(space, Discrete):
        if action.shape != (*axes, space.width):
            raise ValueError(f"the action has shape {shape}, but {[*axes, space.width]} is needed")
        return transform.action(action)
    if action.shape == (*axes, space.count) and space.count > 1:
        return transform.push_outputs(action)
    if action.shape not in (axes, (*axes, 1)):
        raise ValueError(f"the action has shape {shape}, but {list(axes)} is needed, or one-hot with {space.count}")
    if action.is_floating_point() or action.dtype == torch.bool:
        raise ValueError(f"the action is {action.dtype}, but indices of {space.count} actions are integers")
    low, high = torch.aminmax(action) if action.numel() else (0, 0)
    if low < 0 or high >= space.count:
        outside = int(low if low < 0 else high)
        raise ValueError(f"the action {outside} is outside of the {space.count} actions, 0 to {space.count - 1}")
    return transform.action(action.reshape(axes).long()).reshape(action.shape).to(action.dtype)


def carry(spaces: Spaces, move: Callable[[Tensor], Tensor], x: Tensor, lead: torch.Size, name: str) -> Tensor:
    """Move numbers with their agents, by `Transform.per_agent` or `Transform.values`; shapes as of `augment`.

    Raises:
        ValueError: another shape.
    """
    agents, tail = (*lead, *_agents(spaces)), x.shape[len(lead) :]
    if x.shape[: len(lead)] == lead and tail.numel() == 1:
        return x
    if x.shape in (agents, (*agents, 1)):
        return move(x.reshape(agents)).reshape(x.shape)
    reason = f"; {HIDDEN}" if x.shape[: len(agents)] == agents else ""
    raise ValueError(f"{name} has shape {list(x.shape)}, but {list(agents)} or {list(lead)} is needed{reason}")


def check_alike(name: str, moved: Iterable[Tensor], here: Tensor) -> None:
    """Refuse to compare what was said of moved and of original data in different shapes, such as [B, 1] and [B].

    Raises:
        ValueError: the shapes differ.
    """
    for x in moved:
        if x.shape != here.shape:
            raise ValueError(
                f"{name} has shape {list(x.shape)} for the moved data, but {list(here.shape)} for the originals "
                "(here); give both in one shape"
            )


def _check_rows(
    name: str, x: Tensor, layout: Layout, lead: torch.Size | None = None, agents: tuple[int, ...] = ()
) -> torch.Size:
    """Return the leading axes of rows [..., *agents, width] after checking that they are that."""
    cut = x.dim() - 1 - len(agents)
    found = x.shape[: max(cut, 0)]
    if x.shape[-1:] != (layout.width,):
        width = x.shape[-1] if x.dim() else 0
        raise ValueError(f"{name} has rows of {width} numbers, but its layout has {layout.width}: {layout.summary}")
    if cut < 0 or x.shape[cut:-1] != agents:
        raise ValueError(f"{name} has shape {list(x.shape)}, but axis -2 must hold {agents[0]} agents")
    if lead is not None and found != lead:
        raise ValueError(f"{name} has leading axes {list(found)}, but those of obs are {list(lead)}")
    if not x.is_floating_point():
        raise ValueError(f"{name} is {x.dtype}; give floating-point numbers")
    return found


def _agents(spaces: Spaces) -> tuple[int, ...]:
    """Return the agent axis, where there is one."""
    return (spaces.num_agents,) if spaces.num_agents > 1 else ()
