"""A GPU is not waited for: nothing that is computed in collecting and learning is read back by the processor.

Without a GPU the device "meta" stands in for one. Its tensors have shapes and no numbers, so whatever would read one
fails; copies to it that a GPU would wait for are refused here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from esp_cli.algorithms.learner import Learner
from esp_cli.networks import perceptron
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs.mpe import particles
from tests.algorithms.off_policy import on_perceptron

ALGORITHMS = ("mappo", "maddpg", "qmix")
TASKS = ("navigation", "predator-prey")
META = torch.device("meta")
WAITED = "a copy between devices is waited for"


class HostGenerator(torch.Generator):
    """A generator that says it is on a device on which there is none."""

    where: torch.device

    def __new__(cls, device: torch.device | str = "cpu") -> HostGenerator:
        made = super().__new__(cls, "cpu")
        made.where = torch.device(device)
        return made

    @property
    def device(self) -> torch.device:  # type: ignore[override]
        return self.where


class NoWaiting(TorchDispatchMode):
    """Draw nothing on the device that has no numbers, and refuse copies between devices that make one wait.

    Args:
        copies: allow these copies, as when a learner is built.
    """

    def __init__(self, copies: bool = False) -> None:
        super().__init__()
        self.copies = copies

    def __torch_dispatch__(
        self, func: Any, _: Sequence[type], args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        given = dict(kwargs or {})
        if given.get("generator") is not None and given.get("device") == META:
            given["generator"] = None
        if func is torch.ops.aten._to_copy.default:
            moves = given.get("device", args[0].device) not in (None, args[0].device)
            assert self.copies or not moves or given.get("non_blocking"), WAITED
        elif func is torch.ops.aten.copy_.default:
            queued = args[2] if len(args) > 2 else given.get("non_blocking")
            assert self.copies or args[0].device == args[1].device or queued, WAITED
        return func(*args, **given)


class NothingSent(TorchFunctionMode):
    """Refuse tensors that are made on the device from numbers of Python; dispatch does not see them."""

    def __torch_function__(
        self, func: Any, _: Sequence[type], args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        given = dict(kwargs or {})
        assert func not in (torch.tensor, torch.as_tensor) or given.get("device") != META, WAITED
        return func(*args, **given)


@contextmanager
def no_waiting() -> Iterator[None]:
    """Refuse all that a GPU would be waited for."""
    with NoWaiting(), NothingSent():
        yield


@pytest.fixture
def meta(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the device stand in for a GPU."""
    monkeypatch.setattr(torch, "Generator", HostGenerator)
    monkeypatch.setattr(perceptron, "_MINUS_ONE", torch.tensor(-1.0, device=META))  # a GPU takes such a number as it is
    monkeypatch.setattr(particles, "_products_are_rounded", lambda device: False)  # autocast does not know the device


def learner(task: str, algorithm: str, device: str, **others: object) -> Learner:
    settings: dict[str, object] = {"network.hidden": [16, 16], f"{algorithm}.num_envs": 4, **on_perceptron(task)}
    if algorithm == "mappo":
        settings |= {"mappo.num_epochs": 2}
    else:
        settings |= {f"{algorithm}.warmup_episodes": 0, f"{algorithm}.batch_episodes": 4}
    config = resolve_config(task, algorithm, steps=1000, seeds=(0, 1), overrides=settings | others)
    return build_learner(config.model_copy(update={"device": device}))


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.usefixtures("meta")
def test_an_iteration_reads_nothing_back(algorithm: str, task: str) -> None:
    with NoWaiting(copies=True):
        trained = learner(task, algorithm, "meta")
    with no_waiting():
        trained.iterate(0.0)
        result = trained.iterate(0.5)
    assert result.finite.device == META, "else this test would say nothing"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gru", "mlp"])
@pytest.mark.usefixtures("meta")
def test_nor_does_one_with_memory_or_all_copies(name: str) -> None:
    others: dict[str, object] = {"network.name": name, "prior.copies": "all", "prior.transforms": "c4"}
    with NoWaiting(copies=True):
        trained = learner("navigation", "mappo", "meta", **others)
    with no_waiting():
        result = trained.iterate(0.0)
    assert result.finite.device == META, "else this test would say nothing"


READS: Mapping[str, Callable[[torch.Tensor], object]] = {
    "a number": lambda x: x.sum().item(),
    "a condition": lambda x: bool((x > 0).any()),
    "a list": lambda x: x.tolist(),
    "places": lambda x: (x > 0).nonzero(),
    "what a mask selects": lambda x: x[x > 0],
    "masked_select": lambda x: x.masked_select(x > 0),
    "a copy": lambda x: x.cpu(),
    "a copy from the processor": lambda x: torch.ones(3).to(x.device),
    "numbers written from the processor": lambda x: x.copy_(torch.ones(3)),
    "numbers of Python": lambda x: x * torch.tensor([1.0, 2.0, 3.0], device=x.device),
}


@pytest.mark.parametrize("what", READS)
def test_reading_back_is_found(what: str) -> None:
    with no_waiting(), pytest.raises((RuntimeError, NotImplementedError, AssertionError)):
        READS[what](torch.empty(3, device=META))


def test_what_is_queued_is_not_refused() -> None:
    with no_waiting():
        x = torch.ones(3).to(META, non_blocking=True)
        assert torch.where(x > 0, x, 0.0).sum().device == META


@contextmanager
def waiting_is_an_error() -> Iterator[None]:
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.gpu
@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_an_iteration_never_waits_for_the_gpu(algorithm: str, task: str) -> None:
    trained = learner(task, algorithm, "cuda")
    trained.iterate(0.0)
    with waiting_is_an_error():
        trained.iterate(0.5)


@pytest.mark.gpu
def test_reading_a_number_back_from_the_gpu_is_found() -> None:
    number = torch.ones((), device="cuda")
    with waiting_is_an_error(), pytest.raises(RuntimeError, match="synchroniz"):
        number.item()
