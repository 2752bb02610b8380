"""BenchMARL: the prior in any experiment with PPO's family or QMIX, as a callback.

from benchmarl.experiment import Experiment
from esp_cli.loop.benchmarl import SymmetryCallback

Experiment(..., callbacks=[SymmetryCallback(symmetry, coefficient=0.1)]).run()
"""

from __future__ import annotations

from collections.abc import Mapping

from benchmarl.experiment import Callback

from esp_cli.loop.symmetry import Symmetry
from esp_cli.loop.tensordicts import Role
from esp_cli.loop.torchrl import SymmetricLoss
from esp_envs.errors import UserError


class SymmetryCallback(Callback):
    """Puts a `SymmetricLoss` around the loss of every group of agents.

    Args:
        symmetry: says what the numbers of a group are; a mapping gives each group its own, and leaves out the others.
        coefficient: c of Eq. 10.
        augment: whether transformed copies enter the losses themselves too.
        roles: of keys by their last part, where they differ from `esp_cli.loop.tensordicts.ROLES`.
    """

    def __init__(
        self,
        symmetry: Symmetry | Mapping[str, Symmetry],
        coefficient: float = 0.1,
        augment: bool = True,
        roles: Mapping[str, Role] | None = None,
    ) -> None:
        super().__init__()
        self.symmetry, self.coefficient, self.augment, self.roles = symmetry, coefficient, augment, roles

    def on_setup(self) -> None:
        losses = self.experiment.losses
        chosen = self.symmetry if isinstance(self.symmetry, Mapping) else dict.fromkeys(losses, self.symmetry)
        for group, symmetry in chosen.items():
            if group not in losses:
                raise UserError(f"there is no group '{group}'; the groups are {', '.join(losses)}")
            losses[group] = SymmetricLoss(losses[group], symmetry, self.coefficient, self.augment, self.roles)
