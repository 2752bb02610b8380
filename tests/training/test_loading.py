"""Policies come back as they were, and a description that does not fit them is refused before it costs memory."""

import shutil
from pathlib import Path

import pytest
import torch

from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.checkpoint import POLICY_FORMAT, load_checkpoint, save_checkpoint
from esp_cli.training.config import RunConfig
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_cli.training.trainer import Trainer
from tests.training.runs import tiny_config, tiny_folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Trainer:
    """A finished run of the seeds 3 and 7; its folder may not be changed."""
    folder = tiny_folder(tmp_path_factory.mktemp("runs") / "run", steps=100, seeds=(3, 7))
    trainer = Trainer(parse_config(folder.config, folder.path), folder)
    trainer.run(lambda news: True)
    return trainer


@pytest.fixture
def folder(trained, tmp_path) -> RunFolder:
    return RunFolder.open(shutil.copytree(trained.folder.path, tmp_path / "run"))


def edited_policy(folder, **changes) -> Path:
    """Write the policy file anew, with a right checksum, under another description."""
    tensors, meta = load_checkpoint(folder.policy_path, format_name=POLICY_FORMAT)
    save_checkpoint(folder.policy_path, tensors, meta | changes, format_name=POLICY_FORMAT)
    return folder.policy_path


def test_run_and_policy_file_give_the_weights_that_were_trained(trained):
    weights = trained.learner.policy.state_dict()
    for path in (trained.folder.path, trained.folder.policy_path):
        loaded = TrainedPolicy.read(path)
        assert loaded.config == trained.config
        assert (loaded.step, loaded.source, loaded.notes) == (100, path, ())
        assert loaded.spec == trained.learner.spec
        assert not loaded.policy.training
        assert loaded.policy.state_dict().keys() == weights.keys()
        assert all(torch.equal(tensor, weights[name]) for name, tensor in loaded.policy.state_dict().items())
    _, meta = load_checkpoint(trained.folder.policy_path, format_name=POLICY_FORMAT)
    described = {"task": "navigation", "task_version": 1, "network": "mlp", "activation": "tanh", "step": 100}
    assert {name: meta[name] for name in described} == described
    assert len(meta["greedy_returns"]) == 2


def test_a_run_that_keeps_no_checkpoint_is_loaded_from_its_policy_file(folder):
    shutil.rmtree(folder.path / "checkpoints")
    loaded, file = TrainedPolicy.read(folder.path), TrainedPolicy.read(folder.policy_path)
    assert (loaded.config, loaded.spec, loaded.source) == (file.config, file.spec, folder.path)
    assert (loaded.step, loaded.stopped) == (file.step, file.stopped)
    weights = file.policy.state_dict()
    assert all(torch.equal(tensor, weights[name]) for name, tensor in loaded.policy.state_dict().items())


@pytest.mark.parametrize(
    "changes",
    [
        {"network": {"hidden": [7]}},
        {"network": {"hidden": [8, 8]}},
        {"network": {"name": "gru", "hidden": [8]}},
        {"network": {"hidden": [4096] * 16}},
        {"seeds": [3]},
        {"seeds": list(range(1000))},
        {"task_settings": {"num_agents": 2}},
        {"task_settings": {"actions": "continuous"}},
    ],
)
def test_weights_of_another_shape_are_refused(folder, changes):
    config = tiny_config(steps=100, seeds=(3, 7)).model_dump(mode="json") | changes
    with pytest.raises(ValueError, match="the weights do not fit the configuration") as caught:
        TrainedPolicy.read(edited_policy(folder, config=config))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("hidden", [[2**40, 2**40], [200_000] * 5, [0], [-8], [8] * 17, []])
def test_networks_of_impossible_size_are_refused_before_they_are_built(folder, hidden):
    config = tiny_config(steps=100, seeds=(3, 7)).model_dump(mode="json") | {"network": {"hidden": hidden}}
    with pytest.raises(ValueError, match=r"network\.hidden") as caught:
        TrainedPolicy.read(edited_policy(folder, config=config))
    assert "\n" not in str(caught.value)


def test_a_configuration_lacks_nothing_and_has_nothing_foreign():
    stored = tiny_config().model_dump(mode="json")
    assert isinstance(parse_config(stored, Path("run")), RunConfig)
    without = {name: value for name, value in stored.items() if name != "algorithm"}
    for data, sentence in (
        (without, "run: the setting 'config.algorithm' is missing"),
        (stored | {"seeds": list(range(1001))}, "for 'config.seeds'"),
        ([], "run: bad value"),
    ):
        with pytest.raises(ValueError, match=sentence):
            parse_config(data, Path("run"))
