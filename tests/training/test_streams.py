"""Random streams: one number per run seed and name, the same for ever."""

import torch

from esp_cli.training.build import generators, stream_seeds


def test_a_streams_number_never_changes():
    """Another number would silently give every published run other worlds."""
    # first 8 bytes of SHA-256 of "3/evaluation/greedy/10000", least significant first, halved
    assert stream_seeds([3], "evaluation", "greedy", 10_000) == [3462422418383905325]


def test_seeds_and_names_each_make_another_stream():
    names = [(), ("learner",), ("prior",), ("learner", 1), ("learner", 12), ("learner", 1, 2), ("1", "learner")]
    numbers = [number for name in names for number in stream_seeds(range(50), *name)]
    assert len(set(numbers)) == len(numbers)
    assert all(0 <= number < 2**63 for number in numbers), "what torch takes as a seed"


def test_a_seed_draws_alone_what_it_draws_among_others():
    assert stream_seeds((7, 8, 9), "worlds")[1:2] == stream_seeds((8,), "worlds")
    together, (alone,) = generators((7, 8, 9), "worlds"), generators((8,), "worlds")
    expected = torch.rand(100, generator=alone)
    drawn = [torch.rand(100, generator=generator) for generator in together]
    assert torch.equal(drawn[1], expected)
    assert not torch.equal(drawn[0], expected)
    assert not torch.equal(torch.rand(100, generator=generators((8,), "noise")[0]), expected)
