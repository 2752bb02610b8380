"""Starting a run from another policy, where the shapes fit; the run's folder keeps a copy of its weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from esp_cli.networks.policy import Policy
from esp_cli.training.checkpoint import CheckpointError
from esp_cli.training.config import InitialPolicy
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
    seeds, others = policy.num_seeds, len(trained.config.seeds)
    if others not in (1, seeds):
        raise ValueError(
            f"cannot start {seeds} seed(s) from {trained.source}, which holds {others}; "
            f"train {others} seeds, or start from a policy of one seed"
        )
    own, theirs = policy.state_dict(), trained.policy.state_dict()
    for name in sorted(own.keys() | theirs.keys()):
        shapes = [tuple(found[name].shape[1:]) if name in found else None for found in (own, theirs)]
        if shapes[0] != shapes[1]:
            here, there = ("no such weights" if shape is None else f"{list(shape)}" for shape in shapes)
            raise ValueError(
                f"cannot start from {trained.source}: its policy is of {trained.config.task} with the network "
                f"{trained.config.network.name}, and '{name}' is {there} in it but {here} in this run; "
                "choose the task settings and the network of that policy"
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
