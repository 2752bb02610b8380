"""Exports of policies whose task says which actions are allowed."""

import json
import re
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from esp_cli.export import c_file, onnx_file
from esp_cli.export.c_file import c_runner, c_source
from esp_cli.export.check import Sample, compare, take_sample
from esp_cli.export.export import export
from esp_cli.export.numpy_policy import NumpyPolicy
from esp_cli.export.onnx_file import onnx_model, onnx_runner
from esp_cli.export.program import program_of
from esp_cli.export.torch_file import TorchProgram
from esp_envs import register
from esp_envs.registry import TASKS
from tests.export.policies import KINDS, drawn_policy
from tests.fenced import Fenced

needs_cc = pytest.mark.skipif(c_file.compiler() is None, reason="needs a C compiler")
MASKED = {
    "masked choice": ("tests.fenced:Fenced", "mappo", {}),
    "masked choice, recurrent": ("tests.fenced:Fenced", "maddpg", {"network.name": "gru"}),
    "masked values, recurrent": ("tests.fenced:Fenced", "qmix", {"network.name": "gru"}),
    "masked choice over sets": ("tests.fenced:Fenced", "mappo", {"network.name": "set"}),
}


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TASKS, "_registered", {})
    register(Fenced)
    for kind, told in MASKED.items():
        monkeypatch.setitem(KINDS, kind, told)


@needs_cc
@pytest.mark.parametrize("kind", MASKED)
def test_exports_choose_among_allowed_actions_as_the_policy_does(kind, tmp_path, monkeypatch):
    results = export(drawn_policy(kind), ("numpy", "c", "onnx", "torch"), tmp_path).formats
    for result in results:
        assert result.agreement is not None
        assert result.agreement.observations == 10_000
        assert result.agreement.max_difference < 5e-5
        assert (result.agreement.other_actions or 0) <= 2
    assert "allowed" in (tmp_path / "policy.h").read_text()
    assert "action_mask" in (tmp_path / "policy.json").read_text()
    monkeypatch.chdir(tmp_path)
    _run_calls((tmp_path / "README.md").read_text(), json.loads((tmp_path / "policy.json").read_text())["example"])


def _run_calls(page: str, example: dict) -> None:
    """Run the calls of a README on its worked example, in the folder of the export."""
    rows = {name: np.asarray([example[name]], np.float32) for name in ("observation", "memory")}
    rows["action_mask"] = np.asarray([example["action_mask"]])
    sets = {name: np.asarray([table], np.float32) for name, table in example.get("sets", {}).items()}
    policy = SimpleNamespace(**runpy.run_path("policy.py"))
    scope = {"policy": policy, "num_agents": 1, "obs": rows["observation"], "action_mask": rows["action_mask"]}
    scope["sets"] = sets
    for call in re.findall(r"`([^`]* = policy\.[^`]*)`", page):
        exec(call, scope)  # noqa: S102 - the export's own lines
    assert scope["action"].tolist() == [example["action"]]
    (call,) = re.findall(r"`(torch\.export[^`]*)`", page)
    given = {"torch": torch} | {name: torch.from_numpy(array) for name, array in rows.items()}
    given["sets"] = {name: torch.from_numpy(table) for name, table in sets.items()}
    action = eval(call, given)[0]  # noqa: S307 - likewise
    assert action.tolist() == [example["action"]]
    (told,) = re.findall(r"Inputs: (.*); outputs", page)
    rows |= {f"set_{name}": table for name, table in sets.items()}
    read = {name: rows[name] for name in re.findall(r"`(\w+)`", told)}
    session = onnx_file.library("onnxruntime").InferenceSession("policy.onnx", providers=["CPUExecutionProvider"])
    assert session.run(["action"], read)[0].tolist() == [example["action"]]
    tables = "".join(f", set_{name}, num_{name}" for name in sets)
    assert f"esp_policy_act(observation{tables}, allowed, " in page
    assert f"| action_mask | {', '.join(str(int(allowed)) for allowed in example['action_mask'])} |" in page


def test_an_export_that_ignores_masks_is_found() -> None:
    trained = drawn_policy("masked choice")
    sample = take_sample(trained, program_of(trained.policy), 400)
    assert sample.mask is not None
    assert not sample.mask.all()
    free = sample.outputs.argmax(-1)
    with pytest.raises(RuntimeError, match="differs from the policy"):
        compare(sample, lambda sample: (free, sample.outputs, sample.after))


def test_a_mask_is_asked_for_and_has_a_shape() -> None:
    program = program_of(drawn_policy("masked choice").policy)
    policy, obs = NumpyPolicy(program.describe(), program.weights), np.zeros((2, 4), np.float32)
    with pytest.raises(ValueError, match=r"has shape \(\), but \(2, 5\) is needed"):
        policy.act(obs)
    free = NumpyPolicy(replace(program, masked=False).describe(), program.weights)
    with pytest.raises(ValueError, match="no action masks"):
        free.act(obs, np.ones((2, 5), bool))
    assert policy.act(obs, np.zeros((2, 5), bool)).tolist() == free.act(obs).tolist(), "none allowed: all are"


@needs_cc
@torch.no_grad()
def test_agents_that_exchange_messages_choose_among_allowed_actions(tmp_path: Path) -> None:
    program = replace(program_of(drawn_policy("team").policy), masked=True)
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((6 * program.team, program.num_inputs)).astype(np.float32)
    memory = np.zeros((len(rows), 0), np.float32)
    mask = rng.random((len(rows), program.num_outputs)) < 0.4
    mask[0], mask[1] = False, [True, *[False] * (program.num_outputs - 1)]
    for name, content in c_source(program, "").items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "policy.onnx").write_bytes(onnx_model(program, "{}"))
    sample = Sample(rows, memory, mask, {}, memory, memory, memory)
    action, outputs, _ = c_runner(tmp_path / "policy.c", program)(sample)
    expected = np.where(mask | ~mask.any(-1, keepdims=True), outputs, -np.inf).argmax(-1)
    assert action.tolist() == expected.tolist()
    assert (action[0], action[1]) == (outputs[0].argmax(), 0)
    first = {
        "observation": rows[: program.team],
        "action_mask": mask[: program.team],
        "action": expected[: program.team],
    }
    (tmp_path / "policy_example.c").write_bytes(c_file.example_source(program, first))
    assert c_file.example_runs(tmp_path)
    assert onnx_runner(tmp_path / "policy.onnx")(sample)[0].tolist() == expected.tolist()
    through_torch = TorchProgram(program)(torch.from_numpy(rows), action_mask=torch.from_numpy(mask))[0]
    assert through_torch.tolist() == expected.tolist()
