"""What is equal bit for bit and what to rounding: a seed alone and among others, and one thread and two."""

import os
from pathlib import Path

import pytest
import torch

from esp_cli.training.trainer import Trainer
from tests.benchmarks import exactness
from tests.benchmarks.exactness import LEARNERS
from tests.training.runs import tiny_config, tiny_folder

ROUNDING = 1e-4
"""Largest difference of a weight after one iteration; two seeds differ by a thousand times as much."""


def weights(algorithm, network, seeds, threads=1):
    """Return the policy's weights [S, ...] after an iteration that learns."""
    (found,) = exactness.weights("navigation", (algorithm, network), seeds, threads)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "network"), LEARNERS)
def test_a_seed_alone_equals_itself_among_ten_to_rounding(algorithm, network):
    ten = weights(algorithm, network, range(10))
    alone = weights(algorithm, network, (7,))
    assert (ten[7] - alone[0]).abs().max() < ROUNDING
    assert (ten[6] - alone[0]).abs().max() > 1000 * ROUNDING  # negative control


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "network"), LEARNERS)
def test_one_thread_equals_itself_bit_for_bit_and_two_to_rounding(algorithm, network):
    one = weights(algorithm, network, (0, 1))
    assert torch.equal(one, weights(algorithm, network, (0, 1)))
    assert (one - weights(algorithm, network, (0, 1), threads=2)).abs().max() < ROUNDING


def test_two_hundred_seeds_train_and_each_equals_itself_alone():
    many = weights("mappo", "mlp", range(200))
    for seed in (0, 199):
        assert (many[seed] - weights("mappo", "mlp", (seed,))[0]).abs().max() < ROUNDING
    assert many.isfinite().all()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="counts by /proc, which Linux has")
def test_training_takes_no_more_memory_and_no_more_files_the_longer_it_lasts(tmp_path):
    folder = tiny_folder(tmp_path / "run", steps=6000)
    seen = []

    def watch(news):
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        seen.append((pages * os.sysconf("SC_PAGE_SIZE"), len(list(Path("/proc/self/fd").iterdir()))))
        return True

    Trainer(tiny_config(steps=6000), folder).run(watch)
    half = len(seen) // 2
    assert len(seen) > 100
    assert seen[-1][0] - seen[half][0] < 4 * 2**20
    assert {files for _, files in seen[half:]} == {seen[half][1]}
