"""Starting a run from another policy, where the shapes fit; the run's folder keeps a copy of its weights."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from esp_cli.networks.policy import Policy
from esp_cli.policies.loading import open_policy
from esp_cli.training.checkpoint import CheckpointError, read_initial
from esp_cli.training.config import InitialPolicy, RunConfig
from esp_cli.training.run_folder import RunFolder
from esp_envs.errors import UserError
from esp_envs.mpe.frozen_prey import digest


@dataclass(frozen=True)
class Start:
    """Weights that a run may start from."""

    source: str  # the policy, as a configuration records it
    holder: Path  # the file or folder that holds the weights
    config: RunConfig  # of the run that trained the policy, or that started from it
    weights: Mapping[str, Tensor]  # [S', ...]; one seed's serve all, as many seeds as a new run has serve one each

    @classmethod
    def open(cls, source: str | os.PathLike[str]) -> Start:
        """Open a run folder, a policy file or a bundled policy, as `open_policy` does."""
        trained = open_policy(Path(source))
        return cls(os.fspath(source), trained.source, trained.config, trained.policy.state_dict())

    @classmethod
    def find_copy(cls, folder: Path, config: RunConfig) -> Start | None:
        """Return the copy in the folder of a run; None where the run started from nothing, or its copy is damaged."""
        if config.init_from is None:
            return None
        try:
            weights = read_initial(RunFolder.open(folder).initial_path, config.init_from)
        except CheckpointError:
            return None
        if all(torch.equal(tensor, tensor[:1].expand_as(tensor)) for tensor in weights.values()):
            weights = {name: tensor[:1] for name, tensor in weights.items()}
        return cls(config.init_from.source, folder, config, weights)

    def fit(self, policy: Policy) -> tuple[InitialPolicy, dict[str, Tensor]]:
        """Return what a new run's configuration records of this start, and the weights [S, ...] for its policy.

        Raises:
            UserError: numbers of seeds, names or shapes differ.
        """
        seeds, own = policy.num_seeds, policy.state_dict()
        if self._num_seeds not in (1, seeds):
            raise UserError(
                f"cannot start {seeds} seed(s) from {self.holder}, which holds {self._num_seeds}; train "
                f"{self._num_seeds} seeds, or start from one of its seeds: 'esp export {self.holder} --seed K -f "
                "policy' writes it"
            )
        # names before shapes: those that differ are of another algorithm or network
        for name in [*sorted(own.keys() ^ self.weights.keys()), *sorted(own.keys() & self.weights.keys())]:
            here, there = (list(side[name].shape[1:]) if name in side else None for side in (own, self.weights))
            if here != there:
                of_it = f"'{name}' is {'missing' if there is None else there} there"
                of_this = "missing" if here is None else here
                algorithm = "the algorithm, " if here is None or there is None else ""
                raise UserError(
                    f"cannot start from {self.holder}: it is a policy of {self.config.algorithm} on {self.config.task} "
                    f"with the network {self.config.network.name}, and {of_it} but {of_this} in this run; "
                    f"choose {algorithm}the task settings and the network of that policy"
                )
        weights = self._repeated(seeds)
        return InitialPolicy(source=self.source, sha256=digest(weights, {})), weights

    def matches(self, config: RunConfig) -> bool:
        """Return whether these are the weights that the run of a configuration started from."""
        seeds = len(config.seeds)
        if config.init_from is None or self._num_seeds not in (1, seeds):
            return False
        return digest(self._repeated(seeds), {}) == config.init_from.sha256

    @property
    def _num_seeds(self) -> int:
        return len(next(iter(self.weights.values())))

    def _repeated(self, seeds: int) -> dict[str, Tensor]:
        return {name: t.cpu().expand(seeds, *t.shape[1:]).contiguous() for name, t in self.weights.items()}
