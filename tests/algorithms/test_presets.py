"""The preset `fast` is `default` with the changes that its table states; `paper` goes with the paper's tasks."""

import pytest

from esp_cli.algorithms.presets import FAST, PRESETS, SETS, preset_layers
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config


@pytest.mark.parametrize(("algorithm", "task"), [(algorithm, task) for algorithm in FAST for task in FAST[algorithm]])
def test_fast_is_the_default_of_the_task_but_for_what_its_table_states(algorithm: str, task: str) -> None:
    perceptron = {"network.name": "mlp"}
    default, fast = (
        resolve_config(task, algorithm, preset, overrides=perceptron).model_dump(mode="json", exclude={"preset"})
        for preset in ("default", "fast")
    )
    for section, values in FAST[algorithm][task].items():
        part = "algorithm_settings" if section == algorithm else section
        for name, value in values.items():
            assert fast[part][name] == value
            assert default[part].pop(name) != fast[part].pop(name), f"{section}.{name} is stated though it is the same"
    assert fast == default


def test_fast_keeps_what_the_task_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FAST["mappo"], "formation", {"mappo": {"num_epochs": 3}})
    settings = resolve_config("formation", "mappo", "fast").algorithm_settings
    assert (settings["num_steps"], settings["num_epochs"]) == (300, 3)


def test_an_override_has_the_last_word_over_fast() -> None:
    config = resolve_config("navigation", "mappo", "fast", overrides={"mappo.num_envs": 16})
    assert config.algorithm_settings["num_envs"] == 16
    assert "--preset fast" in config.command()
    assert "num_epochs" not in config.command(), "the preset says it"


def test_a_task_that_fast_was_not_tuned_on_is_refused() -> None:
    with pytest.raises(ValueError, match="mappo has no preset 'fast' for wildlife; it has one for navigation, "):
        preset_layers("wildlife", "mappo", "fast")


def test_a_learner_without_fast_settings_is_told_what_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FAST, "qmix", {})
    with pytest.raises(ValueError, match=r"^qmix has no preset 'fast'; it has default, paper$"):
        preset_layers("navigation", "qmix", "fast")
    assert preset_layers("navigation", "qmix", "paper") == [PRESETS["qmix"]["paper"], {}, {}]


@pytest.mark.parametrize("algorithm", SETS)
def test_a_network_over_sets_is_the_default_where_it_is_best_unless_another_is_chosen(algorithm: str) -> None:
    for preset in ("default", *(["fast"] if algorithm in FAST else [])):
        assert resolve_config("navigation", algorithm, preset).network.name == "set"
    stated = SETS[algorithm]["navigation"].get(algorithm, {})
    sets = resolve_config("navigation", algorithm, overrides={"network.name": "set"}).algorithm_settings
    assert {name: sets[name] for name in stated} == stated
    perceptron = resolve_config("navigation", algorithm, overrides={"network.name": "mlp"}).algorithm_settings
    assert all(perceptron[name] != value for name, value in stated.items())
    assert resolve_config("navigation", algorithm, "paper").network.name == "gru"


@pytest.mark.parametrize("task", ["navigation", "predator-prey", "formation"])
@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_the_papers_settings_go_together_on_the_papers_tasks(task: str, algorithm: str) -> None:
    small = {"mappo.num_envs": 1} if algorithm == "mappo" else {f"{algorithm}.replay_episodes": 32}
    learner = build_learner(resolve_config(task, algorithm, "paper", seeds=(0,), overrides=small))
    assert learner.policy.actor.memory_width == 64
