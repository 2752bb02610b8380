"""On a GPU a gradient step is queued without waiting for the device: nothing in it reads a number back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config


@contextmanager
def waiting_is_an_error() -> Iterator[None]:
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.gpu
@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_a_gradient_step_never_waits_for_the_gpu(algorithm: str) -> None:
    settings: dict[str, object] = {"network.hidden": [16, 16], f"{algorithm}.num_envs": 4}
    if algorithm != "mappo":
        settings |= {f"{algorithm}.warmup_episodes": 0, f"{algorithm}.batch_episodes": 4}
    trained = build_learner(resolve_config("navigation", algorithm, 1000, (0, 1), "cuda", settings))
    trained.iterate(0.0)
    if algorithm == "mappo":
        batch, _ = trained.prepare(trained.collector.collect(25))
        with waiting_is_an_error():
            for minibatch in trained._minibatches(batch):
                trained._gradient_step(minibatch, 0.01, None)
    else:
        with waiting_is_an_error():
            trained.update(trained.replay.sample(4, trained.generators["learner"]))


@pytest.mark.gpu
def test_reading_a_number_back_is_found() -> None:
    number = torch.ones((), device="cuda")
    with waiting_is_an_error(), pytest.raises(RuntimeError, match="synchroniz"):
        number.item()
