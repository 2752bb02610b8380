"""Policies come back as they were, and a description that does not fit them is refused before it costs memory."""

import shutil
import warnings
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
    """A copy of the run, to be changed."""
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


def test_a_damaged_checkpoint_is_passed_over_with_a_note_and_no_warning(folder):
    good = folder.checkpoints()[-1]
    folder.checkpoint_path(150).write_bytes(good.read_bytes()[:-1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = TrainedPolicy.read(folder.path)
    assert loaded.step == 100
    assert [("step-000000000150" in note, "going back to step 100" in note) for note in loaded.notes] == [(True, True)]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"config": None}, "bad value None for 'config'"),
        ({"config": "navigation"}, "bad value 'navigation' for 'config'"),
        ({"step": None}, "does not say after how many steps"),
        ({"step": 1.5}, "does not say after how many steps"),
        ({"step": True}, "does not say after how many steps"),
        ({"step": -1}, "does not say after how many steps"),
        ({"task_version": 2}, "was trained on navigation version 2, but this is version 1"),
    ],
)
def test_a_policy_file_with_a_wrong_description_is_refused(folder, changes, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        TrainedPolicy.read(edited_policy(folder, **changes))
    assert str(folder.policy_path) in str(caught.value)


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


def test_where_there_is_no_gpu_a_policy_of_one_lands_on_the_cpu(folder, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    config = tiny_config(steps=100, seeds=(3, 7)).model_copy(update={"device": "cuda"})
    loaded = TrainedPolicy.read(edited_policy(folder, config=config.model_dump(mode="json")))
    assert loaded.config.device == "cpu"
    assert all(tensor.device.type == "cpu" for tensor in loaded.policy.state_dict().values())


def test_a_configuration_lacks_nothing_and_has_nothing_foreign():
    stored = tiny_config().model_dump(mode="json")
    assert isinstance(parse_config(stored, Path("run")), RunConfig)
    without = {name: value for name, value in stored.items() if name != "algorithm"}
    for data, sentence in (
        (without, "run: the setting 'config.algorithm' is missing"),
        (stored | {"mood": "good"}, "run: unknown setting 'config.mood'"),
        (stored | {"algorithm": "magic"}, "run: unknown algorithm 'magic'; the algorithms are mappo"),
        (stored | {"seeds": []}, "for 'config.seeds'"),
        (stored | {"seeds": list(range(1001))}, "for 'config.seeds'"),
        ([], "run: bad value"),
    ):
        with pytest.raises(ValueError, match=sentence):
            parse_config(data, Path("run"))
