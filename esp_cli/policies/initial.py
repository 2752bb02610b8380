"""Starting a run from another policy, where the shapes fit; the run's folder keeps a copy of its weights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from esp_cli.networks.policy import Policy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_learner
from esp_cli.training.checkpoint import CheckpointError
from esp_cli.training.config import InitialPolicy, RunConfig
from esp_cli.training.policy_file import read_initial
from esp_cli.training.run_folder import RunFolder
from esp_envs.errors import UserError
from esp_envs.mpe.frozen_prey import digest


def matching_weights(policy: Policy, trained: TrainedPolicy) -> dict[str, Tensor]:
    """Return the weights of a trained policy for the S seeds of a new one.

    One seed serves all; as many seeds as the new policy has serve one each.

    Args:
        policy: the new one, which says what fits.
        trained: the other one.

    Raises:
        UserError: numbers of seeds, names or shapes differ.
    """
    return _matching(policy, trained.policy.state_dict(), trained.config, trained.source)


def _matching(policy: Policy, theirs: Mapping[str, Tensor], config: RunConfig, source: Path) -> dict[str, Tensor]:
    """Return weights [S', ...] of a configuration's policy for the S seeds of a new one; see `matching_weights`."""
    seeds, others = policy.num_seeds, len(next(iter(theirs.values())))
    if others not in (1, seeds):
        raise UserError(
            f"cannot start {seeds} seed(s) from {source}, which holds {others}; "
            f"train {others} seeds, or start from one of its seeds: 'esp export {source} --seed K -f policy' writes it"
        )
    own = policy.state_dict()
    # names before shapes: those that differ are of another algorithm or network
    for name in sorted(own.keys() | theirs.keys(), key=lambda name: (name in own and name in theirs, name)):
        here, there = (list(side[name].shape[1:]) if name in side else None for side in (own, theirs))
        if here != there:
            of_it = f"'{name}' is {'missing' if there is None else there} there"
            of_this = "missing" if here is None else here
            algorithm = "the algorithm, " if here is None or there is None else ""
            raise UserError(
                f"cannot start from {source}: it is a policy of {config.algorithm} on {config.task} with the network "
                f"{config.network.name}, and {of_it} but {of_this} in this run; "
                f"choose {algorithm}the task settings and the network of that policy"
            )
    return {name: _for_seeds(tensor, seeds) for name, tensor in theirs.items()}


@dataclass(frozen=True)
class OwnCopy:
    """The weights that a run started from, as its folder holds them.

    Attributes:
        folder: of the run.
        config: of the run.
        recorded: what its configuration says of them.
        weights: [S, ...], or [1, ...] where one seed's serve all.
    """

    folder: Path
    config: RunConfig
    recorded: InitialPolicy
    weights: Mapping[str, Tensor]

    @classmethod
    def find(cls, folder: Path, config: RunConfig) -> OwnCopy | None:
        """Return the copy in the folder of a run; None where the run started from nothing, or its copy is damaged."""
        if config.init_from is None:
            return None
        try:
            weights = read_initial(RunFolder.open(folder).initial_path, config.init_from)
        except CheckpointError:
            return None
        if all(torch.equal(tensor, tensor[:1].expand_as(tensor)) for tensor in weights.values()):
            weights = {name: tensor[:1] for name, tensor in weights.items()}
        return cls(folder, config, config.init_from, weights)

    def start(self, config: RunConfig) -> tuple[RunConfig, dict[str, Tensor]]:
        """Return the configuration of another run that starts from these weights too, and its weights.

        Raises:
            UserError: they do not fit.
        """
        weights = _matching(build_learner(config).policy, self.weights, self.config, self.folder)
        return config.model_copy(update={"init_from": describe(self.recorded.source, weights)}), weights


def is_start_of(trained: TrainedPolicy, config: RunConfig) -> bool:
    """Return whether a policy has the weights that the run of this configuration started from."""
    seeds, others = len(config.seeds), len(trained.config.seeds)
    if config.init_from is None or others not in (1, seeds):
        return False
    theirs = trained.policy.state_dict().items()
    return digest({name: _for_seeds(tensor, seeds) for name, tensor in theirs}, {}) == config.init_from.sha256


def _for_seeds(tensor: Tensor, seeds: int) -> Tensor:
    return tensor.cpu().expand(seeds, *tensor.shape[1:]).contiguous()


def describe(source: str, tensors: Mapping[str, Tensor]) -> InitialPolicy:
    """Return what the configuration of a run records of the policy that it starts from."""
    return InitialPolicy(source=source, sha256=digest(tensors, {}))
