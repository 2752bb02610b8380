"""What a network reads and writes, and how both transform under a group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from esp_cli.symmetry import FiniteGroup, admit, parse_group
from esp_cli.symmetry.intertwiners import Block, action_blocks, layout_blocks, trivial
from esp_envs.errors import UserError
from esp_envs.spec import Layout, Spaces, joint_layout

Reads = Literal["state", "observations", "own"]


@dataclass(frozen=True)
class IoSpec:
    """The input and output of a network in a task."""

    spaces: Spaces  # of the task
    # the global state, all agents' observations in a row, or one agent's own observation; rows of own observations
    # hold the agents of a world side by side
    reads: Reads
    # number of invariant outputs; None for an actor, whose outputs are one number per discrete action, or the numbers
    # of a continuous action
    num_values: int | None = None

    @property
    def layout(self) -> Layout:
        """The layout of an input row."""
        if self.reads == "observations":
            return joint_layout(self.spaces.observation, self.spaces.num_agents)
        return self.spaces.state if self.reads == "state" else self.spaces.observation

    def group(self, name: str) -> FiniteGroup:
        """Return a group that leaves agents in their places by its name."""
        group = parse_group(name, self.spaces.num_agents)
        if not isinstance(group, FiniteGroup) or any(element.permutation for element in group.elements):
            raise UserError(f"a network cannot be built for '{name}'; choose a finite group that moves no agents")
        if field := next((field for field in self.layout.fields if field.sorted_by), None):
            raise UserError(f"no network is equivariant on '{field.name}', whose items are sorted; use mlp or set")
        admit(name, group, self.spaces, instead="use another network")
        return group

    def inputs(self, group: FiniteGroup) -> list[Block]:
        """Return how an input row transforms."""
        return layout_blocks(self.layout, group)

    def outputs(self, group: FiniteGroup) -> list[Block]:
        """Return how an output row transforms."""
        if self.num_values is not None:
            return [trivial(group, self.num_values)]
        return action_blocks(self.spaces.action, group)
