"""Starting a run from another policy, where the shapes fit; the run's folder keeps a copy of its weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from esp_cli.networks.policy import Policy
from esp_cli.training.checkpoint import CheckpointError
from esp_cli.training.config import InitialPolicy, RunConfig
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.policy_file import read_policy
from esp_envs.policy_format import digest


def fitted(policy: Policy, trained: TrainedPolicy) -> dict[str, Tensor]:
    """Return the weights of a trained policy for the S seeds of a new one.

    One seed serves all; as many seeds as the new policy has serve one each.

    Args:
        policy: the new one, which says what fits.
        trained: the other one.

    Raises:
        ValueError: numbers of seeds, names or shapes differ.
    """
    return _fitted(policy, trained.policy.state_dict(), trained.config, trained.source)


def _fitted(policy: Policy, theirs: Mapping[str, Tensor], config: RunConfig, source: Path) -> dict[str, Tensor]:
    """Return weights [S', ...] of the policy of a configuration for the S seeds of a new one; see `fitted`."""
    seeds, others = policy.num_seeds, len(next(iter(theirs.values())))
    if others not in (1, seeds):
        raise ValueError(
            f"cannot start {seeds} seed(s) from {source}, which holds {others}; "
            f"train {others} seeds, or start from a policy of one seed"
        )
    own = policy.state_dict()
    # names before shapes: those that differ are of another algorithm or network
    for name in sorted(own.keys() | theirs.keys(), key=lambda name: (name in own and name in theirs, name)):
        here, there = (list(found[name].shape[1:]) if name in found else None for found in (own, theirs))
        if here != there:
            of_it = f"'{name}' is {'missing' if there is None else there} there"
            of_this = "missing" if here is None else here
            algorithm = "the algorithm, " if here is None or there is None else ""
            raise ValueError(
                f"cannot start from {source}: it is a policy of {config.algorithm} on {config.task} with the network "
                f"{config.network.name}, and {of_it} but {of_this} in this run; "
                f"choose {algorithm}the task settings and the network of that policy"
            )
    return {name: tensor.cpu().expand(seeds, *tensor.shape[1:]).contiguous() for name, tensor in theirs.items()}


def describe(source: str, tensors: Mapping[str, Tensor]) -> InitialPolicy:
    """Return what the configuration of a run records of the policy that it starts from."""
    return InitialPolicy(source=source, sha256=digest(tensors, {}))


def read_initial(path: Path, recorded: InitialPolicy) -> dict[str, Tensor]:
    """Read the weights that a run starts from.

    Raises:
        CheckpointError: they are missing, damaged, or not those that its configuration records.
    """
    tensors, _ = read_policy(path)
    if digest(tensors, {}) != recorded.sha256:
        raise CheckpointError(f"{path} does not hold the policy that the run started from; train anew")
    return tensors
