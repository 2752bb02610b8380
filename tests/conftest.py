"""What every test shares: one thread per process, no display, and property tests without deadlines."""

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # the second thread of a test that asks for two sleeps, not spins

import pytest
import torch
from hypothesis import settings

os.fsync = lambda descriptor: None  # no test cuts the power, and waiting for the disk takes longer than a tiny run
torch.set_num_threads(1)  # pytest runs one process per core already; more threads only fight over the cores

settings.register_profile("esp", deadline=None, derandomize=True, database=None)
settings.load_profile("esp")


@pytest.fixture(scope="module", autouse=True)
def nothing_left() -> Iterator[None]:
    """Take back what a module's tests registered, and let no learner choose kernels by itself."""
    from esp_cli.algorithms.presets import ALGORITHMS
    from esp_cli.networks import plain
    from esp_cli.networks.build import NETWORKS
    from esp_envs import installed
    from esp_envs.registry import TASKS

    with pytest.MonkeyPatch.context() as patch:
        for registry in (TASKS, ALGORITHMS, NETWORKS):
            patch.setattr(registry, "_registered", dict(registry._registered))
        patch.setattr(installed, "_FOREIGN", set(installed._FOREIGN))
        patch.setattr(plain, "has_compiler", lambda: False)  # a test that wants kernels asks for them
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if torch.cuda.is_available():
        return
    for item in items:
        if "gpu" in item.keywords:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))


@pytest.fixture(scope="module")
def forked_jobs() -> Iterator[None]:
    """Let the jobs of a module's studies be forks of this process, which import nothing again."""
    from esp_cli.studies import engine
    from tests.forks import ForkEngine

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "LocalEngine", ForkEngine)
        yield


@pytest.fixture
def few_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let exports compare observations in a few states; test_epuck.py does it in more."""
    from esp_cli.export import epuck

    monkeypatch.setattr(epuck, "take_scenes", partial(epuck.take_scenes, count=50))


@pytest.fixture
def full_disk() -> Callable[[], AbstractContextManager[None]]:
    """Return a context in which files of this process can grow no further, as on a full disk."""

    @contextmanager
    def limited() -> Iterator[None]:
        old = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, old[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, old)

    return limited
