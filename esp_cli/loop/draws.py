"""A module that says what its numbers are, draws, and whose state is that of its draws."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from esp_envs.spec import ActionSpace, Discrete, Layout


class Draws(nn.Module):
    """Keeps a generator. Its state is all that `state_dict` holds, and a file without it loads too.

    Args:
        shown: what `repr` says first.
        observation: what it says next.
        action: what it says last.
        seed: of the draws.
    """

    def __init__(self, shown: str, observation: Layout, action: ActionSpace, seed: int) -> None:
        super().__init__()
        acts = f"{action.count} choices" if isinstance(action, Discrete) else action.layout.summary
        self._shown = f"{shown}\nobservation: {observation.summary}\naction: {acts}"
        self.generator = torch.Generator().manual_seed(seed)

    def extra_repr(self) -> str:
        """Say what the numbers are and how they transform."""
        return self._shown

    def get_extra_state(self) -> Tensor:
        """Return the state of the draws."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Go on with the draws of a state, from whatever device."""
        self.generator.set_state(state.cpu())

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the draws, or leave them as they are: files of loops that were written before have none."""
        state_dict.setdefault(f"{prefix}_extra_state", self.get_extra_state())
        super()._load_from_state_dict(state_dict, prefix, *rest)
