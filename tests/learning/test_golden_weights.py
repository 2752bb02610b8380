"""Small runs end with the weights on file, bit for bit: a change that moves results has to say so."""

from pathlib import Path

import pytest
import torch

from tests.learning.golden import CASES, digest, on_file, probe, train


@pytest.fixture(scope="session")
def reachable() -> dict[str, str]:
    weights = on_file().get(probe())
    if weights is None:
        pytest.skip("this processor, or its libraries, round otherwise than those that the weights on file come from")
    return weights


def test_every_case_has_weights_on_file_and_no_two_are_equal() -> None:
    for weights in on_file().values():
        assert weights.keys() == CASES.keys()
        assert len(set(weights.values())) == len(CASES)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_weights_are_those_on_file(case: str, reachable: dict[str, str], tmp_path: Path) -> None:
    assert train(case, tmp_path / "run") == reachable[case]


def test_one_changed_setting_changes_the_weights(tmp_path: Path) -> None:
    case = "plain"
    before = train(case, tmp_path / "before")
    assert train(case, tmp_path / "again") == before
    assert train(case, tmp_path / "after", "--set", "mappo.gamma=0.9901") != before


def test_the_hash_sees_one_bit_but_no_names() -> None:
    a, b = torch.randn(2, 3), torch.randn(4)
    flipped = b.clone()
    flipped.view(torch.int32)[2] ^= 1
    assert digest({"a": a, "b": b}) == digest({"z": b, "y": a})
    assert digest({"a": a, "b": b}) != digest({"a": a, "b": flipped})
    assert digest({"a": a}) != digest({"a": a.reshape(3, 2)})
