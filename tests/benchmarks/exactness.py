"""Measure how far a seed alone is from itself among ten, and one thread from two, after some iterations.

    python tests/benchmarks/exactness.py [--task navigation] [--iterations 1 --iterations 3] [--small] [--only mappo]

Each figure is the largest difference of a weight of the policy. Worlds, networks and batches have their default sizes,
so that torch chooses the routines that a user gets; with --small they have the sizes of the tests.
"""

import argparse
from collections.abc import Sequence

from esp_cli import machine

if __name__ == "__main__":
    machine.prepare()  # as `esp` does, before torch is imported

import torch
from torch import Tensor

from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config

LEARNERS = [(algorithm, network) for algorithm in ("mappo", "maddpg", "qmix") for network in ("mlp", "gru")]
TEN, ONE = tuple(range(10)), 7


def settings_of(algorithm: str, network: str, small: bool) -> dict[str, object]:
    """Return settings with which a learner learns from its first iteration on."""
    found: dict[str, object] = {"network.name": network}
    if algorithm != "mappo":
        found |= {f"{algorithm}.warmup_episodes": 0}
    if small:
        found |= {"network.hidden": [16], f"{algorithm}.num_envs": 4}
        if algorithm != "mappo":
            found |= {f"{algorithm}.batch_episodes": 4, f"{algorithm}.replay_episodes": 64}
    return found


def weights(
    task: str,
    learner: tuple[str, str],
    seeds: Sequence[int],
    threads: int = 1,
    iterations: Sequence[int] = (1,),
    small: bool = True,
) -> list[Tensor]:
    """Return the policy's weights [S, W] after each of these numbers of iterations."""
    algorithm, network = learner
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        built = build_learner(
            resolve_config(task, algorithm, steps=10**6, seeds=seeds, overrides=settings_of(algorithm, network, small))
        )
        found = []
        for done in range(1, max(iterations) + 1):
            built.iterate(0.0)
            if done in iterations:
                state = built.policy.state_dict().values()
                found.append(torch.cat([t.flatten(1).double() for t in state if t.dim() > 1], 1))
        return found
    finally:
        torch.set_num_threads(before)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python tests/benchmarks/exactness.py")
    parser.add_argument("--task", default="navigation")
    parser.add_argument("--iterations", type=int, action="append")
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--only", action="append", help="algorithms")
    chosen = parser.parse_args()
    after = chosen.iterations or [1, 3]
    print(f"largest difference of a weight on {chosen.task} after {after} iterations", flush=True)
    for learner in LEARNERS:
        if chosen.only and learner[0] not in chosen.only:
            continue
        ten = weights(chosen.task, learner, TEN, 1, after, chosen.small)
        alone = weights(chosen.task, learner, (ONE,), 1, after, chosen.small)
        two = weights(chosen.task, learner, TEN, 2, after, chosen.small)
        seeds = [f"{(a[ONE] - b[0]).abs().max():.0e}" for a, b in zip(ten, alone, strict=True)]
        threads = [f"{(a - b).abs().max():.0e}" for a, b in zip(ten, two, strict=True)]
        print(
            f"{' '.join(learner):12} alone, among ten {' '.join(seeds)}; one, two threads {' '.join(threads)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
