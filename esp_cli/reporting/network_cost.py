"""What a network costs: its weights, and the work behind one action."""

from __future__ import annotations

import torch
from torch.utils.flop_counter import FlopCounterMode

from esp_cli.training.build import build_environment, build_learner
from esp_cli.training.config import RunConfig


def network_parameters(config: RunConfig) -> dict[str, int]:
    """Build the networks of one seed of a run, and return their weights by name, "policy" among them."""
    modules = build_learner(config.of_one_seed()).modules
    names = [name for name in ("policy", "critic") if name in modules]
    return {name: sum(p.numel() for p in modules[name].parameters()) for name in names}


@torch.no_grad()
def flops_per_action(config: RunConfig) -> float:
    """Count the floating-point operations of matrix products by which a trained policy chooses one agent's action.

    What is done once for any number of observations, such as putting constrained weights together, does not count; nor
    does it count that equal pictures need to be encoded only once.
    """
    config = config.of_one_seed()
    policy = build_learner(config).policy
    worlds = 16  # many pictures, so that no odd number is rounded up
    counts = []
    for number in (worlds, 2 * worlds):
        obs = torch.randn_like(build_environment(config, number, "shape").reset().obs)
        with FlopCounterMode(display=False) as counter:
            policy.act(obs, policy.initial_memory(number, obs))
        counts.append(counter.get_total_flops())
    return (counts[1] - counts[0]) / (worlds * policy.num_agents)
