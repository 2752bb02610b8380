"""BenchMARL's own experiments on VMAS with the callback: they train, and what they train on has its copies."""

from __future__ import annotations

import re
import warnings
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch

from esp_cli import Continuous, Discrete, Field, Kind, Symmetry, layout

pytest.importorskip("vmas", reason="needs BenchMARL and VMAS, of the extra benchmarl")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of gym, which VMAS imports
    pytest.importorskip("benchmarl", reason="needs BenchMARL and VMAS, of the extra benchmarl")

from benchmarl.algorithms import IppoConfig, MaddpgConfig, MappoConfig, QmixConfig
from benchmarl.environments import VmasTask
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from esp_cli.loop.benchmarl import SymmetryCallback
from esp_cli.loop.torchrl import SymmetricLoss

# VMAS's navigation without its lidar, and the nine pairs of forces that its discrete actions stand for
SEEN = layout(Field("position", Kind.VECTOR), Field("velocity", Kind.VECTOR), Field("from goal", Kind.VECTOR))
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
PUSHES = tuple(product((0.0, -1.0, 1.0), repeat=2))
MOVES = Discrete(Kind.VECTOR, PUSHES, tuple(map(str, PUSHES)))


def experiment(
    folder: Path, algorithm: Any, callback: SymmetryCallback | None, discrete: bool = False, collisions: bool = False
) -> Experiment:
    config = ExperimentConfig.get_from_yaml()
    config.prefer_continuous_actions = not discrete
    config.loggers, config.create_json, config.evaluation, config.render = [], False, False, False
    config.max_n_frames, config.save_folder = 400, str(folder)
    config.on_policy_collected_frames_per_batch = config.off_policy_collected_frames_per_batch = 200
    config.on_policy_n_envs_per_worker = config.off_policy_n_envs_per_worker = 2
    config.on_policy_minibatch_size, config.on_policy_n_minibatch_iters = 100, 2
    config.off_policy_n_optimizer_steps, config.off_policy_train_batch_size = 4, 32
    task = VmasTask.NAVIGATION.get_from_yaml()
    task.config |= {"collisions": collisions, "max_steps": 20}
    model = MlpConfig(num_cells=[16], layer_class=torch.nn.Linear, activation_class=torch.nn.Tanh)
    return Experiment(task, algorithm.get_from_yaml(), model, 0, config, None, [callback] if callback else [])


def symmetry(discrete: bool = False, **choice: Any) -> Symmetry:
    action = MOVES if discrete else FORCE
    return Symmetry(observation=SEEN, action=action, group="d4", num_agents=3, **choice)


def weights(run: Experiment) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in run.policy.parameters()])


@pytest.mark.parametrize(("algorithm", "discrete"), [(MappoConfig, False), (IppoConfig, True), (QmixConfig, True)])
def test_an_experiment_trains_on_copies(tmp_path, algorithm, discrete, monkeypatch):
    sizes: list[tuple[int, int]] = []
    ask = SymmetricLoss._ask

    def counted(self: SymmetricLoss, data: Any, size: int) -> Any:
        answer = ask(self, data, size)
        sizes.append((len(data), sum(map(len, answer[2]))))
        return answer

    monkeypatch.setattr(SymmetricLoss, "_ask", counted)
    run = experiment(tmp_path, algorithm, SymmetryCallback(symmetry(discrete), coefficient=0.1), discrete)
    before = weights(run).clone()
    run.run()
    assert not torch.equal(weights(run), before)
    assert weights(run).isfinite().all()
    rows = 32 if algorithm is QmixConfig else 100
    assert set(sizes) == {(2 * rows, 2 * rows)}


def test_without_the_prior_the_callback_changes_nothing(tmp_path: Path) -> None:
    plain = experiment(tmp_path, MappoConfig, None)
    plain.run()
    off = experiment(tmp_path, MappoConfig, SymmetryCallback(symmetry(), coefficient=0.0, augment=False))
    off.run()
    assert torch.equal(weights(off), weights(plain))
    on = experiment(tmp_path, MappoConfig, SymmetryCallback(symmetry(), coefficient=1.0))
    on.run()
    assert (weights(on) - weights(plain)).abs().max() > 1e-5


def test_the_example_of_the_documentation_trains(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "library.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```text\n(from esp_cli import Continuous.*?)```", page, re.DOTALL)
    *lines, last = example.strip().splitlines()
    assert len(lines) + 1 <= 10
    told: dict[str, Any] = {}
    exec("\n".join(lines), told)  # noqa: S102 - the documentation's own lines
    callback = eval(re.search(r"callbacks=\[(.*)\]\)", last)[1], told)  # type: ignore[index]  # noqa: S307 - likewise
    run = experiment(tmp_path, MappoConfig, callback, collisions=True)
    run.run()
    assert weights(run).isfinite().all()


def test_a_group_that_is_not_there_and_an_algorithm_without_a_policy_loss_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no group 'robots'; the groups are agents"):
        experiment(tmp_path, MappoConfig, SymmetryCallback({"robots": symmetry()}))
    with pytest.raises(ValueError, match="DDPGLoss is not known"):
        experiment(tmp_path, MaddpgConfig, SymmetryCallback(symmetry()))
