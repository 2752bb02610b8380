"""What tests of kernels share."""

import shutil

import pytest
import torch

needs_compiler = pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")


def assert_same_bits_alone_and_for_any_threads(function, num_seeds):
    """Compare a kernel's results for all seeds at once with those of one seed; two seeds differ (negative control).

    Args:
        function: of a slice of seeds, returns tensors [S, ...].
        num_seeds: at least 3.
    """

    def results(seeds, threads):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            return function(seeds)
        finally:
            torch.set_num_threads(before)

    together = results(slice(0, num_seeds), 2)
    for alone in (results(slice(1, 2), 2), results(slice(1, 2), 1)):
        assert all(torch.equal(a, b[1:2]) for a, b in zip(alone, together, strict=True))
    other = results(slice(2, 3), 2)
    assert not torch.equal(other[0], together[0][1:2]), "negative control: the seeds differ"
