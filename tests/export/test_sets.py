"""Policies over sets leave the application for any number of things: layers by hand, other numbers, refusals."""

import json
from pathlib import Path

import numpy as np
import pytest

from esp_cli.export import c_file
from esp_cli.export.c_file import c_runner, c_source
from esp_cli.export.check import Runner, Sample, compare, take_sample
from esp_cli.export.numpy_file import numpy_runner, numpy_source
from esp_cli.export.onnx_file import onnx_model, onnx_runner
from esp_cli.export.program import Program, program_of
from esp_cli.export.sets import SetOf, pool_sets
from esp_cli.export.torch_file import torch_archive, torch_runner
from esp_envs.errors import UserError
from tests.export.policies import drawn_policy


def runners(program: Program, folder: Path) -> dict[str, Runner]:
    (folder / "policy.pt2").write_bytes(torch_archive(program, "{}"))
    (folder / "policy.onnx").write_bytes(onnx_model(program, "{}"))
    (folder / "policy.py").write_bytes(numpy_source(program, "", {}))
    made = {"torch": torch_runner(folder / "policy.pt2"), "onnx": onnx_runner(folder / "policy.onnx")}
    made["numpy"] = numpy_runner(folder / "policy.py")
    if c_file.compiler() is not None:
        for name, source in c_source(program, "").items():
            (folder / name).write_bytes(source)
        made["c"] = c_runner(folder / "policy.c", program)
    return made


def sample_of(own: np.ndarray, sets: dict[str, np.ndarray]) -> Sample:
    none = own[:, :0]
    return Sample(own, none, None, sets, none, none, none)


@pytest.mark.parametrize(
    ("near", "expected"),
    # distances 5 and 1, with sqrt(18) between both; alone, to no other: twice its own distance
    [(0, [7, (5 + 1) / 2 + 18**0.5, 5 + 18**0.5]), (1, [7, 1 + 2, 1 + 2])],
)
def test_features_of_things_by_hand(near: int, expected: list[float], tmp_path: Path) -> None:
    # own number 7; one feature of a thing: the sum of its distance and that to the nearest other
    one, zero = np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    weights = (np.array([[0], [0], [1], [1]], np.float32), 0 * one, zero, one, zero)
    spots = SetOf("spots", ((1, 2), (3, 4)), place=0, reader=None, arrays=weights)
    layer = pool_sets([spots], (), [0], inputs=1, beside=0, near=near, kind="relu")
    program = Program(1, (layer,), 3, 0, 0, "choose", (), own=(0,), sets=(("spots", spots.columns),))
    own, sets = program.split(np.array([[7, 3, 4, 0, 1], [7, 0, 1, 3, 4]], np.float32))
    assert sets["spots"].tolist() == [[[3, 4], [0, 1]], [[0, 1], [3, 4]]]
    for run in runners(program, tmp_path).values():
        np.testing.assert_allclose(run(sample_of(own, sets))[1], [expected] * 2, rtol=1e-6)


@pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")
def test_a_set_of_things_without_a_place_compiles(tmp_path: Path) -> None:
    one, zero = np.ones((1, 1), np.float32), np.zeros(1, np.float32)
    marks = SetOf("to read", ((1,), (2,)), place=None, reader=None, arrays=(one, 0 * one, zero, one, zero))
    layer = pool_sets([marks], (), [0], inputs=1, beside=0, near=0, kind="relu")
    program = Program(1, (layer,), 3, 0, 0, "choose", (), own=(0,), sets=(("to read", marks.columns),))
    for name, source in c_source(program, "").items():
        (tmp_path / name).write_bytes(source)
    sample = sample_of(*program.split(np.array([[7, 2, 4]], np.float32)))
    assert c_runner(tmp_path / "policy.c", program)(sample)[1].tolist() == [[7, 3, 4]]


def test_a_name_with_quotes_is_written_or_refused(tmp_path: Path) -> None:
    one, zero, name = np.ones((1, 1), np.float32), np.zeros(1, np.float32), 'a"b\\n """'
    marks = SetOf(name, ((1,), (2,)), place=None, reader=None, arrays=(one, 0 * one, zero, one, zero))
    layer = pool_sets([marks], (), [0], inputs=1, beside=0, near=0, kind="relu")
    program = Program(1, (layer,), 3, 0, 0, "choose", (), own=(0,), sets=((name, marks.columns),))
    (tmp_path / "policy.py").write_bytes(numpy_source(program, "", {}))
    sample = sample_of(*program.split(np.array([[7, 2, 4]], np.float32)))
    assert numpy_runner(tmp_path / "policy.py")(sample)[1].tolist() == [[7, 3, 4]]
    with pytest.raises(UserError, match="cannot be exported to torch and ONNX; leave quotes and backslashes"):
        torch_archive(program, "{}")


@pytest.mark.parametrize("near", [0, 2])
def test_an_export_acts_with_any_number(near: int, tmp_path: Path) -> None:
    trained = drawn_policy("sets", near=near)
    files = runners(program_of(trained.policy), tmp_path)
    for count in (2, 9):
        other = drawn_policy("sets", near=near, num_agents=count)
        other.policy.load_state_dict(trained.policy.state_dict())
        sample = take_sample(other, program_of(other.policy), 200)
        assert sample.sets["others"].shape == (200, count - 1, 2)
        for run in files.values():
            assert compare(sample, run).other_actions is not None
    sample.sets["others"][:, 0] += 1
    with pytest.raises(RuntimeError, match="differs"):
        compare(sample, files["numpy"])


def test_the_python_file_refuses_tables_that_do_not_fit(tmp_path: Path) -> None:
    program = program_of(drawn_policy("sets").policy)
    assert json.loads(json.dumps(program.describe()))["sets"][0][0] == "landmarks"
    (tmp_path / "policy.py").write_bytes(numpy_source(program, "", {}))
    run = numpy_runner(tmp_path / "policy.py")
    own, landmarks = np.zeros((2, 4), np.float32), np.zeros((2, 3, 2), np.float32)
    for sets, sentence in (
        ({"landmarks": landmarks}, "are needed"),
        ({"landmarks": landmarks, "others": own}, r"others has shape \(2, 4\), but \(2, 'K', 2\) is needed"),
        ({"landmarks": landmarks[:, :0], "others": np.zeros((2, 1, 2))}, "K > 0"),
        ({"landmarks": landmarks, "others": np.full((2, 1, 2), np.nan)}, "others holds a number that is not finite"),
    ):
        with pytest.raises(ValueError, match=sentence):
            run(sample_of(own, sets))


def test_the_equivariant_network_over_sets_is_refused() -> None:
    with pytest.raises(UserError, match="DirectionActor cannot be exported; mlp, gru, set, equivariant,"):
        program_of(drawn_policy("set-equivariant").policy)
