"""Every export does what the policy does, on thousands of observations; one that does not is found."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from esp_cli.commands import export as command
from esp_cli.export import c_file, check, onnx_file
from esp_cli.export.check import compare, take_sample
from esp_cli.export.export import FORMATS, export
from esp_cli.export.numpy_policy import NumpyPolicy
from esp_cli.export.program import program_of
from esp_envs.errors import UserError
from esp_envs.registry import TASKS
from tests.export.policies import KINDS, drawn_policy, imported
from tests.own_tasks import save_page_files

pytestmark = pytest.mark.usefixtures("few_scenes")
FAST = ("numpy", "c")
ALSO_TORCH = ("wheels", "choice, normalised", "values, recurrent", "team")  # sets: test_sets.py
needs_cc = pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")


@needs_cc
@pytest.mark.parametrize("kind", KINDS)
def test_exports_agree_with_the_policy(kind: str, tmp_path: Path) -> None:
    formats = [*FAST, *["torch", "onnx"] * (kind in ALSO_TORCH)]
    results = export(drawn_policy(kind), formats, tmp_path / "out").formats
    assert [result.name for result in results] == formats
    for result in results:
        assert result.agreement is not None
        assert result.agreement.observations == (10_002 if kind.startswith("team") else 10_000)
        assert result.agreement.max_difference < 5e-5
        assert (result.agreement.other_actions or 0) <= 2
        assert (result.agreement.other_actions is None) == (kind in ("vector", "wheels", "point", "point, recurrent"))
        assert all((tmp_path / "out" / file).stat().st_size for file in result.files)


def test_both_halves_of_the_sample_are_there() -> None:
    trained = drawn_policy("choice, recurrent")
    program = program_of(trained.policy)
    sample = take_sample(trained, program, 400)
    assert sample.obs.shape == (400, program.num_inputs)
    assert not sample.memory[: trained.spec.num_agents].any(), "an episode begins with empty memory"
    assert sample.memory[100:200].any()
    # of random observations one in three lies beyond 1, of those of the task hardly any of the first steps
    assert (np.abs(sample.obs[200:]) > 1).mean() == pytest.approx(0.317, abs=0.03)
    assert len(np.unique(sample.action)) > 1


@pytest.mark.parametrize("kind", ["choice", "wheels"])
def test_a_wrong_weight_is_found(kind: str) -> None:
    trained = drawn_policy(kind)
    program = program_of(trained.policy)
    sample = take_sample(trained, program, 500)

    def runner(spoilt: float) -> check.Runner:
        weights = np.frombuffer(program.weights, "<f4").copy()
        weights[5] += spoilt
        policy = NumpyPolicy(json.loads(json.dumps(program.describe())), weights.tobytes())

        def run(sample):
            action, after = policy.step(sample.obs, sample.memory)
            return action, policy.outputs(sample.obs, sample.memory)[0], after

        return run

    assert compare(sample, runner(0.0)).max_difference < 1e-5
    with pytest.raises(RuntimeError, match="differs from the policy"):
        compare(sample, runner(0.05))


def test_another_choice_that_is_no_tie_is_found() -> None:
    trained = drawn_policy("choice")
    sample = take_sample(trained, program_of(trained.policy), 100)
    others = (sample.action + 1) % 5
    with pytest.raises(RuntimeError, match="differs from the policy"):
        compare(sample, lambda sample: (others, sample.outputs, sample.after))


@pytest.mark.parametrize(("kind", "spoilt"), [("choice, recurrent", "memory"), ("wheels", "action")])
def test_another_memory_or_another_bounded_action_is_found(kind: str, spoilt: str) -> None:
    trained = drawn_policy(kind)
    sample = take_sample(trained, program_of(trained.policy), 100)
    right, wrong = {"action": sample.action, "memory": sample.after}, 0.01

    def runner(said: dict[str, np.ndarray]) -> check.Runner:
        return lambda sample: (said["action"], sample.outputs, said["memory"])

    assert compare(sample, runner(right)).max_difference == 0
    with pytest.raises(RuntimeError, match=r"differs from the policy by 0\.01"):
        compare(sample, runner(right | {spoilt: right[spoilt] + wrong}))


def test_a_single_choice_agrees() -> None:
    trained = drawn_policy("choice")
    sample = take_sample(trained, program_of(trained.policy), 10)
    one = replace(sample, outputs=sample.outputs[:, :1], action=np.zeros_like(sample.action))
    assert compare(one, lambda sample: (sample.action, sample.outputs, sample.after)).other_actions == 0


def test_layers_of_a_small_policy_by_hand() -> None:
    program = program_of(drawn_policy("wheels", hidden=(3,)).policy)
    first, _, last = program.layers
    assert (first.kind, last.kind) == ("affine", "affine")
    assert (first.arrays[0].shape, last.arrays[0].shape) == ((8, 3), (3, 2))
    assert program.num_parameters == 8 * 3 + 3 + 3 * 2 + 2 == 35
    assert (program.head, program.groups, program.memory_width) == ("squash", [1, 1], 0)


def test_layers_of_a_recurrent_policy_with_its_previous_action() -> None:
    program = program_of(drawn_policy("exploring choice, recurrent", hidden=(6, 4)).policy)
    (unit,) = [layer for layer in program.layers if layer.kind == "gru"]
    assert [array.shape for array in unit.arrays] == [(4, 12), (12,)] * 2
    assert (program.hidden, program.previous, program.memory_width) == (4, 5, 9)
    assert program.num_inputs == 14
    assert program.head == "choose"
    assert program_of(drawn_policy("vector").policy).groups == [2]


def test_the_python_file_runs_alone_and_checks_itself(tmp_path: Path) -> None:
    export(drawn_policy("values, recurrent"), ["numpy"], tmp_path)
    code = (
        "import sys, runpy\n"
        "try:\n    runpy.run_path('policy.py', run_name='__main__')\n"
        "except SystemExit as done:\n    assert done.code == 0, done.code\n"
        "assert not {'torch', 'esp_cli', 'esp_envs'} & set(sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False, env={}
    )
    assert done.returncode == 0, done.stderr
    assert "expected" in done.stdout


def test_the_python_file_refuses_what_does_not_fit(tmp_path: Path) -> None:
    export(drawn_policy("choice, recurrent"), ["numpy"], tmp_path)
    module = imported(tmp_path / "policy.py")
    with pytest.raises(ValueError, match="this policy remembers"):
        module.act(np.zeros((3, 14)))
    with pytest.raises(ValueError, match=r"the observation has shape \(3, 4\)"):
        module.step(np.zeros((3, 4)), module.initial_memory(3))
    with pytest.raises(ValueError, match=r"the memory has shape \(2, 10\)"):
        module.step(np.zeros((3, 14)), module.initial_memory(2))
    for rows, memory, what in (
        (np.full((3, 14), np.nan), module.initial_memory(3), "observation"),
        (np.zeros((3, 14)), np.full((3, 10), np.inf), "memory"),
    ):
        with pytest.raises(ValueError, match=f"the {what} holds a number that is not finite"):
            module.step(rows, memory)


@needs_cc
def test_the_worked_example_in_c_fails_where_the_weights_are_others(tmp_path: Path) -> None:
    export(drawn_policy("wheels"), ["c"], tmp_path)
    assert c_file.example_runs(tmp_path)
    source = (tmp_path / "policy.c").read_text()
    begin = source.index("= {\n", source.index("static const float w4_1")) + 4
    (tmp_path / "policy.c").write_text(source[:begin] + "    0.5f," + source[source.index(",", begin) + 1 :])
    assert not c_file.example_runs(tmp_path)


def test_every_export_says_what_its_numbers_are(tmp_path: Path) -> None:
    trained = drawn_policy("wheel pairs")
    export(trained, [name for name in FORMATS if name != "torch"], tmp_path)
    said = json.loads((tmp_path / "policy.json").read_text())
    fields = [(row["index"], row["field"], row["unit"]) for row in said["observation"]]
    assert fields == [
        ("0..1", "heading", "direction"),
        ("2..3", "obstacle", "m"),
        ("4..5", "goal", "m"),
        ("6..7", "robots", "m"),
    ]
    assert len(said["action"]["options"]) == 121
    assert said["action"]["options"][120] == {"index": 120, "name": "1/1", "means": [1.0, 1.0]}
    assert said["task"]["control_period_s"] == 0.1
    example = said["example"]
    assert len(example["observation"]) == 8
    assert example["action"] == int(np.argmax(example["outputs"]))
    page = (tmp_path / "README.md").read_text()
    for part in ("   2..3  obstacle: vector x 1 (m)\n", "never on hardware", "Worked example", "10000"):
        assert part in page
    assert page.count("float64") == 1, "of onnx alone"
    import onnx

    model = onnx.load(tmp_path / "policy.onnx")
    stored = {item.key: item.value for item in model.metadata_props}
    assert json.loads(stored["esp"])["example"] == example
    assert "heading: vector x 1 (direction)" in (tmp_path / "policy.h").read_text()


@needs_cc
def test_a_name_with_a_control_of_direction_is_escaped_in_sources(tmp_path: Path) -> None:
    trained = drawn_policy("choice")
    first, *others = trained.spec.observation.fields
    seen = replace(trained.spec.observation, fields=(replace(first, name="\u202eabc"), *others))
    export(replace(trained, spec=replace(trained.spec, observation=seen)), FAST, tmp_path)
    for source in ("policy.h", "policy.py"):
        text = (tmp_path / source).read_text()
        assert "\u202e" not in text
        assert "u202eabc" in text


def test_a_policy_that_sees_no_number_goes_out_where_a_format_holds_it(tmp_path, monkeypatch):
    save_page_files(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(KINDS, "alone", (TASKS.register("rendezvous:Rendezvous"), "mappo", {}))
    trained = drawn_policy("alone", num_agents=1)
    with pytest.raises(UserError, match="sees no number, which c and torch cannot hold; choose onnx or numpy"):
        export(trained, ["numpy", "torch", "c"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert export(trained, ["numpy"], tmp_path / "out").formats[0].agreement.max_difference < 1e-5


def test_an_export_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    trained = drawn_policy("choice")
    export(trained, ["numpy"], tmp_path)
    before = (tmp_path / "policy.py").read_bytes()
    (tmp_path / "policy.onnx").mkdir()
    with pytest.raises(UserError, match=r"policy\.onnx is a folder in the place of a file"):
        export(trained, ["onnx"], tmp_path, force=True)
    assert (tmp_path / "policy.py").read_bytes() == before


def test_a_killed_export_leaves_no_description_of_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = drawn_policy("choice")
    export(trained, ["numpy"], tmp_path)
    monkeypatch.setattr("esp_cli.export.export.replace_file", lambda path, content: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        export(trained, ["torch"], tmp_path, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["README.md"]


def test_an_onnx_export_without_its_libraries_names_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ValueError, match=r"needs the package onnx: pip install 'onnx>=1\.17'"):
        onnx_file.library("onnx")


def test_the_command_lists_every_format() -> None:
    assert tuple(FORMATS) == command.FORMATS
