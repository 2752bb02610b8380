"""Learners learn the same with the kernels, and a missing compiler is told."""

import gc
import os
import weakref
from pathlib import Path

import pytest
import torch
from torch.autograd.function import BackwardCFunction
from typer.testing import CliRunner

from esp_cli.app import app
from esp_cli.networks import plain
from esp_cli.networks.joint_q import MonotonicMixer
from esp_cli.networks.kernels import library
from esp_cli.networks.layers import SeedMLP
from esp_cli.networks.plain import MlpConfig
from esp_cli.networks.recurrent import SeedGRU
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_cli.training.settings import parse_config
from tests.networks.kernels.compiler import needs_compiler
from tests.networks.test_layers import generators


@needs_compiler
@pytest.mark.parametrize(
    ("algorithm", "network"), [("mappo", "mlp"), ("mappo", "gru"), ("maddpg", "mlp"), ("qmix", "mlp"), ("qmix", "gru")]
)
def test_learners_learn_the_same_up_to_rounding(algorithm, network):
    def parameters(compiled):
        settings = {"network.name": network, "network.compiled": compiled}
        learner = build_learner(resolve_config("navigation", algorithm, seeds=(0, 1), overrides=settings))
        start = [p.detach().clone() for p in learner.policy.parameters()]
        learner.iterate(0.0)
        return start, list(learner.policy.parameters())

    (start, ours), (_, theirs) = parameters(True), parameters(False)
    moved = max((a - b).abs().max() for a, b in zip(start, theirs, strict=True))
    apart = max((a - b).abs().max() for a, b in zip(ours, theirs, strict=True))
    assert 0 < apart < 0.05 * moved


@needs_compiler
def test_a_policy_trained_with_it_needs_no_compiler(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    options = ["--steps", "800", "--set", "network.compiled=true", "--set", "evaluation.episodes=1"]
    result = CliRunner().invoke(app, ["train", *options, "--out", str(folder)])
    assert result.exit_code == 0, result.output
    monkeypatch.setattr(library, "library", without_compiler)
    assert TrainedPolicy.read(folder).config.network.compiled
    assert not TrainedPolicy.read(folder).single_seed(0).config.network.compiled


def without_compiler(_name):
    raise AssertionError("the kernel is asked for")


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        ("no-such-compiler", "network.compiled needs a C++ compiler"),
        ('g++ "', "the environment variable CXX is no command (No closing quotation)"),
    ],
)
def test_a_missing_compiler_is_named_in_one_sentence(tmp_path, monkeypatch, command, sentence):
    library.library.cache_clear()
    library.begin.cache_clear()
    monkeypatch.setenv("CXX", command)
    result = CliRunner().invoke(app, ["train", "--set", "network.compiled=true", "--out", str(tmp_path / "run")])
    assert result.exit_code == 2
    assert sentence in " ".join(result.output.split())
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        (
            "echo 'error: no such option' >&2; exit 1",
            r"compiler does not compile the kernels .*: error: no such option",
        ),
        ('while [ "$1" != -o ]; do shift; done; echo > "$2"', r"cannot be loaded .*; set TMPDIR to a folder"),
    ],
)
def test_a_compiler_that_fails_and_one_that_makes_no_library_are_told(tmp_path, monkeypatch, script, sentence):
    library.library.cache_clear()
    library.begin.cache_clear()
    compiler = tmp_path / "compiler"
    compiler.write_text(f"#!/bin/sh\n{script}\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    with pytest.raises(ValueError, match=sentence):
        library.library("mixer")


def test_a_forked_process_compiles_for_itself(tmp_path, monkeypatch):
    """What a thread of its parent had begun would never end in it."""
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\nsleep 1\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CXX", str(compiler))
    library.begin.cache_clear()
    begun = library.begin("mixer")
    child = os.fork()
    if child == 0:
        os._exit(library.begin("mixer") is begun)
    assert os.waitpid(child, 0)[1] == 0
    assert library.begin("mixer") is begun
    library.begin.cache_clear()


@needs_compiler
def test_a_forked_process_leaves_what_its_parent_compiled():
    library.library.cache_clear()
    library.begin.cache_clear()
    folder = Path(library.begin("mixer").result())
    child = os.fork()
    if child == 0:
        library._remove_all()  # as at its exit
        os._exit(library.begin.cache_info().currsize)
    assert os.waitpid(child, 0)[1] == 0
    assert (folder / "mixer").is_file()
    assert library.library("mixer")
    assert not folder.exists()


def test_bfloat16_and_the_kernel_exclude_each_other():
    with pytest.raises(ValueError, match="compiled perceptrons compute in float32"):
        MlpConfig(compiled=True, precision="bfloat16")


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("kind", ["perceptron", "recurrent", "mixer"])
def test_what_a_pass_keeps_goes_with_its_outputs(kind, compiled):
    """Not with the next visit of the garbage collector: until then a learner would fill gigabytes."""
    x = torch.randn(1, 8, 5, 4, requires_grad=True)
    perceptron = SeedMLP(generators(0), (4, 6, 3), "relu", 1.0, activate_output=True, compiled=compiled)
    unit = SeedGRU(generators(0), 4, 6, compiled)
    mixer = MonotonicMixer(generators(0), 5, 4, 3, 6, compiled)
    gc.collect()
    gc.disable()
    try:
        made = {"perceptron": lambda: perceptron(x.flatten(1, 2)), "recurrent": lambda: unit.unroll(x)}
        outputs = (made | {"mixer": lambda: mixer(x[..., 0], x[:, :, 0])})[kind]()
        node = outputs.grad_fn
        while not isinstance(node, BackwardCFunction):  # the mixer's stands behind views
            ((node, _), *_) = node.next_functions
        kept = weakref.ref(node)
        del node
        assert kept() is not None
        del outputs
        assert kept() is None
    finally:
        gc.enable()


@pytest.mark.parametrize(
    ("steps", "device", "choice", "decided"),
    [
        (100_000, "cpu", {}, True),
        (99_999, "cpu", {}, False),
        (100_000, "cuda", {}, False),
        (100_000, "cpu", {"network.precision": "bfloat16"}, False),
        (100_000, "cpu", {"network.layer_norm": True}, False),
        (100_000, "cpu", {"network.compiled": False}, False),
        (100, "cpu", {"network.compiled": True}, True),
    ],
)
def test_long_runs_compute_by_kernels_and_say_so(steps, device, choice, decided, monkeypatch):
    monkeypatch.setattr(plain, "has_compiler", lambda: True)
    config = resolve_config("navigation", steps=steps, device=device, overrides={"network.name": "mlp", **choice})
    assert config.network.compiled is decided
    stored = config.model_dump(mode="json")
    assert parse_config(stored, Path("run")).network.compiled is decided
    del stored["network"]["compiled"]
    assert parse_config(stored, Path("run")).network.compiled is False, "stored before there was a choice"


def test_without_a_compiler_nothing_is_compiled(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert not library.has_compiler()
    monkeypatch.setattr(plain, "has_compiler", library.has_compiler)
    assert resolve_config("navigation").network.compiled is False
