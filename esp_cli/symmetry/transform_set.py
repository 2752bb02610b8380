"""The transforms that a learner may use: which there are, and which one a gradient step draws."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from esp_cli.symmetry.admission import admitted_elements
from esp_cli.symmetry.elements import Element
from esp_cli.symmetry.groups import Group
from esp_cli.symmetry.transforms import Transform, build_transform
from esp_envs.errors import UserError
from esp_envs.spec import Spaces

_STACK_LIMIT = 512
"""Stacks of at most this many elements are built once; longer ones (d4*agents with N >= 5) at each draw."""


class TransformSet:
    """The transforms that a learner may use: listed elements, or a group that is sampled.

    Attributes:
        names: the elements' names; the group's name alone where it is sampled.
        is_finite: whether the elements are listed; False for continuous groups and for more than `LISTED_LIMIT`.
        size: how many elements are listed, the identity not counted; 0 where the group is sampled.
    """

    def __init__(
        self,
        elements: Sequence[Element] | Group,
        spaces: Spaces,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.spaces, self.device, self.dtype = spaces, device, dtype
        self._group = elements if isinstance(elements, Group) else None
        self._elements = () if isinstance(elements, Group) else tuple(elements)
        self.is_finite = self._group is None
        self.size = len(self._elements)
        self.names = (self._group.name,) if self._group else tuple(e.name for e in self._elements)
        # Built once where it fits, with the identity at the end: a draw is then a selection.
        stacked = 0 < self.size <= _STACK_LIMIT
        self._stack = self._build([*self._elements, Element()]) if stacked else None
        self._singles: dict[int, Transform] = {}

    def draw(self, generators: Sequence[torch.Generator], keep: Sequence[float] = ()) -> Transform:
        """Draw one element per seed, uniformly among those that are not the identity.

        The identity is left out because a copy of the batch that equals the batch adds nothing: a consistency loss of
        zero and a second gradient on the same rows. Each seed draws from its own generator, so seed k draws the
        same alone and among ten.

        Args:
            generators: one per seed, on the CPU.
            keep: by listed element (one number for a sampled group) how likely it is beside the others, 0 to 1. With
                probability 1 - max(keep) the identity takes the place of the drawn one. Empty: all alike, and all stay.
        """
        if self._group is not None:
            drawn = ((_draw_moving(self._group, g), g) for g in generators)
            return self._build([e if not keep or _stays(keep[0], g) else Element() for e, g in drawn])
        return self._picked([self._pick(keep, g) for g in generators])

    def _pick(self, keep: Sequence[float], generator: torch.Generator) -> int:
        """Draw an index by rejection; with equal weights the random stream equals the unweighted one."""
        most = max(keep, default=1.0)
        while most > 0:
            index = int(torch.randint(self.size, (), generator=generator))
            if not keep or _stays(keep[index] / most, generator):
                return index if _stays(most, generator) else self.size
        return self.size

    def kept(self, index: int, strength: float, generators: Sequence[torch.Generator]) -> Transform:
        """Return one of the listed elements, for each seed with probability `strength`, else the identity."""
        return self._picked([index if _stays(strength, g) else self.size for g in generators])

    def _picked(self, picks: Sequence[int]) -> Transform:
        """Return the elements at these places, one per seed; the place behind the last is the identity."""
        if self._stack is None:
            elements = (*self._elements, Element())
            return self._build([elements[i] for i in picks])
        return self._single(*picks) if len(picks) == 1 else self._stack.select(picks)

    def each(self) -> list[Transform]:
        """Return every element in order, each the same for all seeds.

        Raises:
            UserError: the group is sampled.
        """
        if not self.is_finite:
            raise UserError(f"{self.names[0]} cannot be listed; draw from it or choose a finite group")
        if self._stack is not None:
            return [self._single(i) for i in range(self.size)]
        return [self._build([e]) for e in self._elements]

    def _single(self, index: int) -> Transform:
        """Return one element of the stack, selected once."""
        assert self._stack is not None
        if index not in self._singles:
            self._singles[index] = self._stack.select([index])
        return self._singles[index]

    def _build(self, elements: Sequence[Element]) -> Transform:
        return build_transform(elements, self.spaces, self.device, self.dtype)


def transform_set(
    text: str, spaces: Spaces, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> TransformSet:
    """Read transforms from text and build them for a task.

    Args:
        text: see `parse_elements`.
        spaces: of the task.
        device: where the tensors live.
        dtype: of the matrices.

    Raises:
        UserError: the text means nothing, or the task cannot carry what it means.
    """
    return TransformSet(admitted_elements(text, spaces), spaces, device, dtype)


def _stays(strength: float, generator: torch.Generator) -> bool:
    """Draw whether an element stays; nothing is drawn where it is certain."""
    return strength >= 1 or float(torch.rand((), generator=generator)) < strength


def _draw_moving(group: Group, generator: torch.Generator) -> Element:
    element = group.draw(generator)
    while element.is_identity:
        element = group.draw(generator)
    return element
