"""Numeric checks: is a network equivariant (Eq. 2), are an environment's reward and transition invariant (Eq. 5, 6)?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from esp_cli.symmetry.transforms import Transform

if TYPE_CHECKING:
    from esp_envs.base import Environment, Observation, Step


def policy_equivariance_error(policy: Callable[[Tensor], Tensor], obs: Tensor, transform: Transform) -> float:
    """Measure how far logits (compared as probabilities) or means are from pi(K_g a | L_g s) = pi(a | s)."""
    with torch.no_grad():
        here, pulled = policy(obs), transform.pull_back(policy(transform.obs(obs)))
    if transform.action_index is not None:
        pulled, here = pulled.softmax(-1), here.softmax(-1)
    return _gap(pulled, here)


def environment_errors(
    env: Environment,
    transform: Transform,
    state: Tensor,
    actions: Sequence[Tensor],
    restore_noise: Callable[[Environment, Transform | None], None] | None = None,
) -> dict[str, float]:
    """Measure how far a task is from symmetric rewards (Eq. 5) and transitions (Eq. 6).

    Eq. 5: r(L_g s, K_g a) = r(s, a). Eq. 6: P(L_g s' | L_g s, K_g a) = P(s' | s, a).

    The worlds take the actions from `state`, then K_g of them from L_g state, with the same noise; what the second run
    gives is compared with the transform of what the first gave. A world counts until its episode ends.

    `restore_noise` is called before each run (with None, then with the transform) by tasks whose own noise has a
    direction that must be turned along. Returned are the largest absolute errors; "observation" is that of the start,
    "end" is 1 where one run ended and the other went on.
    """
    noise = [g.get_state() for g in env.generators]

    def run(start: Tensor, moves: Sequence[Tensor], turned: Transform | None) -> tuple[Observation, list[Step]]:
        for generator, saved in zip(env.generators, noise, strict=True):
            generator.set_state(saved)
        if restore_noise is not None:
            restore_noise(env, turned)
        first = env.set_state(start)
        return first, [env.step(move) for move in moves]

    first, steps = run(state, actions, None)
    turned_first, turned_steps = run(transform.state(state), [transform.action(a) for a in actions], transform)
    errors = {"observation": _gap(transform.obs(first.obs), turned_first.obs)}
    errors |= {"reward": 0.0, "next_obs": 0.0, "next_state": 0.0, "end": 0.0}
    alive = torch.ones(state.shape[:2], dtype=torch.bool, device=state.device)
    for step, turned in zip(steps, turned_steps, strict=True):
        reached, turned_reached = step.reached, turned.reached
        pairs = {
            "reward": (transform.per_agent(step.reward), turned.reward),
            "next_obs": (transform.obs(reached.obs), turned_reached.obs),
            "next_state": (transform.state(reached.state), turned_reached.state),
            "end": (step.ended.float(), turned.ended.float()),
        }
        for name, (expected, got) in pairs.items():
            errors[name] = max(errors[name], _gap(expected[alive], got[alive]))
        alive = alive & ~step.ended & ~turned.ended
    return errors


def _gap(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max()) if a.numel() else 0.0
