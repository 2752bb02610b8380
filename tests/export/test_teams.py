"""Policies whose agents exchange messages leave the application whole: layers by hand, costs, who is near, refusals."""

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from esp_cli.export import c_file, check
from esp_cli.export.c_file import c_runner, c_source
from esp_cli.export.export import export
from esp_cli.export.layers import activation, affine, aggregate, convolution, global_max_pool
from esp_cli.export.numpy_policy import NumpyPolicy
from esp_cli.export.onnx_file import onnx_runner
from esp_cli.export.program import Program, program_of
from esp_cli.export.torch_file import TorchProgram, torch_archive, torch_runner
from esp_cli.policies.loaded import LoadedPolicy
from tests.export.policies import drawn_policy

WIDTH = 445
"""Of an observation of wildlife monitoring: 21 x 21 pixels, and the way to two others."""
FIRST = affine(np.eye(5, 1, dtype=np.float32), np.zeros(1, np.float32))
"""Of five numbers the first."""


def numpy_policy(program: Program) -> NumpyPolicy:
    return NumpyPolicy(json.loads(json.dumps(program.describe())), program.weights)


def sample_of(rows: np.ndarray) -> check.Sample:
    none = rows[:, :0]
    return check.Sample(rows, none, None, {}, none, none, none)


def test_a_picture_through_convolution_and_largest_response_by_hand() -> None:
    # filter [[1, 2], [3, 4]] on channel 0 and its negative on channel 1, bias 0.5, every second place of 2 x 4 pixels
    weight = np.array([1, 2, 3, 4, -1, -2, -3, -4], np.float32)[:, None]
    filters = convolution(weight, np.array([0.5], np.float32), 1, (2, 2, 4), side=2, stride=2)
    assert filters.width == 2
    program = Program(17, (filters,), 2, 0, 0, "choose", ())
    first = [[1, 0, 0, 1], [0, 1, 0, 0]]
    second = [[0, 0, 0, 0], [1, 0, 1, 0]]
    row = np.concatenate([[99], np.ravel(first), np.ravel(second)]).astype(np.float32)
    # left: 1 * 1 + 4 * 1 - 3 * 1 + 0.5, right: 2 * 1 - 3 * 1 + 0.5
    for outputs in both(program, row[None]):
        assert outputs.tolist() == [[2.5, -0.5]]
    pooled = Program(17, (filters, global_max_pool(1, 2)), 1, 0, 0, "choose", ())
    for outputs in both(pooled, row[None]):
        assert outputs.tolist() == [[2.5]]


def test_what_is_heard_by_hand() -> None:
    # own feature, then the ways to the two others; agents 0 and 1 are near each other, agent 2 is too far from both
    hear = aggregate(begin=1, team=3, width=1, reach_squared=4.0)
    program = Program(5, (FIRST, hear), 4, 0, 0, "choose", (), team=3)
    rows = np.array([[10, 1, 1, 0, 2], [20, -1, -1, -1, 9], [40, 0, -2, 1, -9]], np.float32)
    # divided by two: the one heard and the agent itself; the way in reaches of 2; two cells are not less than two
    expected = [[10, 0.25, 0.25, 10], [20, -0.25, -0.25, 5], [40, 0, 0, 0]]
    for outputs in both(program, rows):
        assert np.allclose(outputs, expected)


def test_an_archive_and_the_python_file_take_one_world_and_no_world(tmp_path: Path) -> None:
    weight = np.arange(8, dtype=np.float32)[:, None]
    seen = (convolution(weight, np.ones(1, np.float32), 1, (2, 2, 4), side=2, stride=2), global_max_pool(1, 2))
    program = Program(
        17, (*seen, aggregate(begin=1, team=3, width=1, reach_squared=4.0)), 4, 0, 0, "choose", (), team=3
    )
    (tmp_path / "policy.pt2").write_bytes(content := torch_archive(program, "{}"))
    assert b"torch_file.py" not in content, "files and folders of the machine that wrote it"
    archive, written = torch_runner(tmp_path / "policy.pt2"), numpy_policy(program)
    for worlds in (1, 4):
        rows = np.random.default_rng(worlds).standard_normal((3 * worlds, 17)).astype(np.float32)
        outputs = archive(sample_of(rows))[1]
        expected = written.outputs(rows.reshape(worlds, 3, 17), np.zeros((worlds, 3, 0)))[0]
        assert np.allclose(outputs, expected.reshape(-1, 4), atol=1e-5)
    assert written.act(np.zeros((0, 3, 17))).shape == (0, 3)


@pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")
def test_what_is_not_a_number_stays_so_in_c(tmp_path: Path) -> None:
    weight = np.ones((1, 2), np.float32)
    layers = (affine(weight, np.zeros(2, np.float32)), activation("relu", 2), global_max_pool(1, 2))
    program = Program(1, layers, 1, 0, 0, "choose", ())
    for name, source in c_source(program, "").items():
        (tmp_path / name).write_bytes(source)
    for value, expected in ((np.nan, np.nan), (-1.0, 0.0), (2.0, 2.0)):
        rows = np.array([[value]], np.float32)
        outputs = c_runner(tmp_path / "policy.c", program)(sample_of(rows))[1]
        assert np.array_equal(outputs, [[expected]], equal_nan=True)


@torch.no_grad()
def both(program: Program, rows: np.ndarray) -> list[np.ndarray]:
    through_torch = TorchProgram(program)(torch.from_numpy(rows))[1].numpy()
    return [numpy_policy(program).outputs(rows, np.zeros((len(rows), 0)))[0], through_torch]


@pytest.mark.slow
@torch.no_grad()
def test_those_just_three_cells_away_both_ways_are_not_heard_by_any_of_them(tmp_path: Path) -> None:
    trained = drawn_policy("team")
    program = program_of(trained.policy)
    export(trained, ["onnx"], tmp_path)
    rows = np.random.default_rng(0).standard_normal((3, WIDTH)).astype(np.float32)
    runners = [onnx_runner(tmp_path / "policy.onnx"), runner_of(program)]
    if c_file.compiler():
        export(trained, ["c"], tmp_path / "c")
        runners.append(c_runner(tmp_path / "c" / "policy.c", program))

    def said(ways: list[float]) -> np.ndarray:
        rows[:, -4:] = ways
        outputs = trained.policy.actor(torch.from_numpy(rows)[None])[0].numpy()
        for runner in runners:
            assert np.allclose(runner(sample_of(rows))[1], outputs, atol=1e-4)
        return outputs

    alone_in_the_world = said([99, 99, 99, 99])
    assert np.allclose(said([3, 3, -3, 3]), alone_in_the_world, atol=1e-6)
    assert not np.allclose(said([3, 2, -3, 3]), alone_in_the_world, atol=1e-2)


def runner_of(program: Program) -> check.Runner:
    """Return a runner of an exported Python file's code."""
    policy = numpy_policy(program)

    def run(sample):
        worlds = sample.obs.reshape(-1, program.team, program.num_inputs)
        outputs = policy.outputs(worlds, np.zeros((*worlds.shape[:2], 0)))[0].reshape(len(sample.obs), -1)
        return outputs.argmax(1), outputs, sample.memory

    return run


def test_a_drawn_network_as_layers_and_its_costs() -> None:
    program = program_of(drawn_policy("team", hidden=(12, 10)).policy)
    kinds = [layer.kind for layer in program.layers]
    pictures = ["convolution", "relu", "convolution", "relu", "global_max_pool"]
    assert kinds == [*pictures, *["aggregate", "affine", "relu"] * 2, "affine"]
    assert (program.num_inputs, program.team, program.memory_width) == (WIDTH, 3, 0)
    shapes = [layer.arrays[0].shape for layer in program.layers if layer.kind == "affine"]
    # what a drone found and what it hears, 32 numbers each, and the mean way
    assert shapes == [(32 + 2 + 32, 12), (12 + 2 + 12, 10), (10, program.num_outputs)]
    first, second = (layer for layer in program.layers if layer.kind == "convolution")
    assert (first.width, second.width) == (16 * 8 * 8, 32 * 4 * 4)


@pytest.mark.slow
@pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")
def test_the_worked_example_is_a_whole_world(tmp_path: Path) -> None:
    export(drawn_policy("team"), ["c", "numpy"], tmp_path)
    example = json.loads((tmp_path / "policy.json").read_text())["example"]
    assert np.shape(example["observation"]) == (3, WIDTH)
    assert example["action"] == np.argmax(example["outputs"], 1).tolist()
    assert c_file.example_runs(tmp_path)
    subprocess.run(["python", "policy.py"], cwd=tmp_path, check=True, capture_output=True)
    for file in ("README.md", "policy.h", "policy.py"):
        assert "The 3 agents of a world exchange messages and act together" in (tmp_path / file).read_text()
    changed = (tmp_path / "policy_example.c").read_text()
    changed = re.sub(r"(expected\[\] = \{\s+)\d+", r"\g<1>77", changed)
    (tmp_path / "policy_example.c").write_text(changed)
    assert not c_file.example_runs(tmp_path)


def test_an_exported_team_refuses_rows_that_are_no_world(tmp_path: Path) -> None:
    policy = numpy_policy(program_of(drawn_policy("team").policy))
    assert policy.act(np.zeros((2, 3, WIDTH))).shape == (2, 3)
    for shape in ((WIDTH,), (2, WIDTH), (3, 2, WIDTH), (6, WIDTH)):
        with pytest.raises(ValueError, match=r"the observation has shape .* but \(\.\.\., 3, D\) is needed"):
            policy.act(np.zeros(shape))


@pytest.mark.parametrize("lead", [(3,), (2, 3), (0, 3)])
def test_a_loaded_team_acts_world_by_world(lead: tuple[int, ...]) -> None:
    policy = LoadedPolicy(drawn_policy("team"))
    obs = np.random.default_rng(0).standard_normal((*lead, WIDTH))
    action = policy.act(obs)
    assert action.shape == lead
    if lead == (2, 3):
        assert np.array_equal(action, [policy.act(world) for world in obs])


@pytest.mark.parametrize("shape", [(WIDTH,), (2, WIDTH), (3, 2, WIDTH), (6, WIDTH)])
def test_a_loaded_team_refuses_rows_that_are_no_world(shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=r"exchange messages: give \(\.\.\., 3, 445\), one row for each agent of a world"
    ):
        LoadedPolicy(drawn_policy("team")).act(np.zeros(shape))


def test_an_equivariant_team_is_exported_as_plain_layers() -> None:
    trained = drawn_policy("team, values, equivariant")
    program = program_of(trained.policy)
    sample = check.take_sample(trained, program, 300)
    assert len(sample.obs) == 300
    agreement = check.compare(sample, runner_of(program))
    assert agreement.max_difference < 5e-5
    moved = replace(program, layers=(*program.layers[:5], aggregate(440, 3, 32, 18.0), *program.layers[6:]))
    with pytest.raises(RuntimeError, match="differs from the policy"):
        check.compare(sample, runner_of(moved))


@pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")
def test_c_acts_for_a_team_whose_actions_are_no_choices(tmp_path: Path) -> None:
    program = Program(5, (FIRST, aggregate(1, 3, 1, 4.0)), 4, 0, 0, "squash", (3, 1), team=3)
    rows = np.random.default_rng(0).standard_normal((6, 5)).astype(np.float32)
    action = numpy_policy(program).act(rows.reshape(2, 3, 5))
    example = {"observation": rows[:3].tolist(), "action": action[0].tolist()}
    sources = c_file.c_source(program, "") | {"policy_example.c": c_file.example_source(program, example)}
    for name, source in sources.items():
        (tmp_path / name).write_bytes(source)
    assert np.allclose(c_runner(tmp_path / "policy.c", program)(sample_of(rows))[0], np.concatenate(action))
    assert c_file.example_runs(tmp_path)


def test_an_ensemble_is_refused_by_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"of the kind Symmetrised cannot be exported; .* without symmetrise"):
        export(drawn_policy("ensemble"), ["numpy"], tmp_path)
