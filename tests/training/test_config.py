"""The resolved configuration: which choice has the last word, what is refused, and that it survives being stored."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from pydantic import Field

from esp_cli.algorithms.mappo import MappoConfig
from esp_cli.files.documents import validate
from esp_cli.networks.constrained import EquivariantConfig
from esp_cli.networks.message_passing import EmpnConfig, MpnConfig
from esp_cli.networks.plain import GruConfig, MlpConfig
from esp_cli.prior.config import PriorConfig
from esp_cli.studies.plan import Cell
from esp_cli.training import config as config_module
from esp_cli.training.config import EvaluationConfig, RunConfig, completed, resolve_config
from esp_cli.training.settings import parse_config
from esp_envs.errors import UserError
from esp_envs.registry import task_class


def test_without_a_choice_every_default_is_the_models_own():
    config = resolve_config("navigation", overrides={"network.name": "mlp"})
    assert config.algorithm_settings == MappoConfig().model_dump()
    decided = MlpConfig(compiled=False)  # the tests know no compiler
    assert (config.network, config.prior, config.evaluation) == (decided, PriorConfig(), EvaluationConfig())
    assert (config.preset, config.device, config.seeds) == ("default", "cpu", (0,))
    assert config.task_settings["num_agents"] == 3


def test_the_paper_preset_is_supplement_table_2():
    config = resolve_config("navigation", preset="paper")
    mappo, network, prior = config.algorithm_settings, config.network, config.prior
    assert (prior.kind, prior.transforms, prior.consistency_coef) == ("esp", "rot90", 0.5)
    assert (network.name, network.hidden, network.activation, network.layer_norm) == ("gru", (64, 64), "relu", True)
    assert {name: mappo[name] for name in ("num_envs", "num_steps", "num_epochs", "num_minibatches")} == {
        "num_envs": 128,
        "num_steps": 25,
        "num_epochs": 10,
        "num_minibatches": 1,
    }
    assert (mappo["learning_rate"], mappo["gamma"], mappo["gae_lambda"]) == (7e-4, 0.99, 0.95)
    assert (mappo["clip_epsilon"], mappo["entropy_coef"], mappo["max_grad_norm"]) == (0.2, 0.01, 10.0)
    assert (mappo["clip_value"], mappo["anneal_learning_rate"], mappo["anneal_entropy"]) == (True, False, False)


def test_an_override_has_the_last_word_over_a_preset_which_has_it_over_a_default():
    config = resolve_config(
        "navigation", preset="paper", overrides={"mappo.learning_rate": 1e-4, "network.name": "mlp"}
    )
    assert config.algorithm_settings["learning_rate"] == 1e-4, "not the preset's 7e-4"
    assert config.algorithm_settings["num_envs"] == 128, "not the default's 32"
    assert (config.network.name, config.network.layer_norm) == ("mlp", True)


def test_what_a_preset_sets_for_its_network_is_left_out_for_another_that_does_not_have_it():
    config = resolve_config("wildlife", "maddpg", "paper", overrides={"network.name": "empn"})
    assert config.network == EmpnConfig(hidden=(64, 64)), "without the layer_norm of the preset's recurrent network"


@pytest.mark.parametrize(
    ("task", "algorithm", "choice", "idle"),
    [
        ("navigation", "mappo", {}, {"mappo.truncation", "task.local_ratio"}),
        ("navigation", "mappo", {"task.convention": "pettingzoo"}, {"mappo.truncation"}),
        (
            "predator-prey",
            "mappo",
            {"network.name": "equivariant", "network.relaxation": "weights"},
            {"mappo.truncation", "network.relaxation"},
        ),
        (
            "predator-prey",
            "mappo",
            {"network.name": "equivariant", "network.relaxation": "weights", "network.relax": 1},
            {"mappo.truncation"},
        ),
        ("predator-prey", "mappo", {}, {"mappo.truncation"}),
        ("predator-prey", "mappo", {"network.name": "gru"}, set()),
        ("predator-prey", "mappo", {"mappo.entropy_coef": 0}, {"mappo.truncation", "mappo.anneal_entropy"}),
        ("wildlife", "mappo", {}, {"mappo.truncation", "mappo.critic_activation"}),
        ("wildlife", "mappo", {"network.name": "mlp"}, {"mappo.truncation"}),
        ("predator-prey", "maddpg", {}, set()),
        ("predator-prey", "maddpg", {"task.actions": "continuous"}, {"maddpg.actor_gradient"}),
        ("predator-prey", "maddpg", {"maddpg.epsilon_finish": 1}, {"maddpg.epsilon_steps"}),
        ("predator-prey", "qmix", {"qmix.epsilon_start": 0.05}, {"qmix.epsilon_steps"}),
        ("formation", "maddpg", {}, {"maddpg.actor_gradient"}),
        ("formation", "maddpg", {"task.num_obstacles": 0}, {"maddpg.actor_gradient", "task.obstacle_radius_m"}),
        ("navigation", "maddpg", {}, {"maddpg.critic_activation", "task.local_ratio"}),
        ("predator-prey", "maddpg", {"network.name": "set", "task.control": "both"}, {"maddpg.critic_activation"}),
        ("navigation", "qmix", {}, {"qmix.hyper_width", "task.local_ratio"}),
        ("predator-prey", "qmix", {"network.layer_norm": True}, {"network.precision", "network.compiled"}),
        (
            "predator-prey",
            "maddpg",
            {"network.name": "gru", "network.layer_norm": True},
            {"network.precision", "network.compiled"},
        ),
    ],
)
def test_task_learner_and_network_name_the_settings_that_do_nothing_beside_the_others(task, algorithm, choice, idle):
    config = resolve_config(task, algorithm, overrides=choice)
    assert {name for name in config.without_effect() if not name.startswith("prior.")} == idle


def test_kernels_for_the_processor_change_nothing_on_a_gpu():
    config = resolve_config("navigation", "mappo")
    assert "network.compiled" not in config.without_effect()
    assert "network.compiled" in config.model_copy(update={"device": "cuda"}).without_effect()


GONE = [
    ("task_settings", {"prey_policy": None, "prey_policy_seed": 0, "learned_prey": 0.0}, {"learned_prey": 0.5}),
    ("task_settings", {"gust_mean": 0.0, "gust_std": 0.0, "weak_agent": 0.0}, {"weak_agent": 0.5}),
    ("prior", {"stop_gradient": "none", "terms": "both"}, {"stop_gradient": "original", "terms": "value"}),
]
"""By part of a configuration, settings that went: as earlier versions stored them, and one that they acted on."""


@pytest.mark.parametrize(("part", "defaults", "used"), GONE)
def test_a_setting_that_went_is_dropped_at_its_old_default_and_refused_otherwise(part, defaults, used):
    config = resolve_config("predator-prey", "qmix")
    stored = config.model_dump(mode="json")
    stored[part] |= defaults
    assert parse_config(stored, Path("run")) == config
    other = resolve_config("navigation", "qmix").model_dump(mode="json")
    with pytest.raises(UserError, match=r"unknown setting 'task.prey_policy'"):
        parse_config(other | {"task_settings": other["task_settings"] | {"prey_policy": None}}, Path("run"))
    cell = {"name": "a", "panel": "p", "variant": "v", "config": stored}
    assert validate(Cell, cell).config == config, "so does one in a study"
    for name, value in used.items():
        with pytest.raises(UserError, match=f"this esp has no '{name}' any more; use the esp that wrote it"):
            parse_config(stored | {part: stored[part] | {name: value}}, Path("run"))


FLAT = {
    "hidden": [32],
    "activation": "relu",
    "precision": "float32",
    "layer_norm": False,
    "group": "d4",
    "symmetrise": None,
    "separate_parts": False,
}
"""Stored by version 0.1.0 for every network."""


@pytest.mark.parametrize(
    ("name", "network"),
    [
        ("mlp", MlpConfig(hidden=(32,), activation="relu", compiled=False)),
        ("gru", GruConfig(hidden=(32,), activation="relu", compiled=False)),
        ("mpn", MpnConfig(hidden=(32,))),
        ("empn", EmpnConfig(hidden=(32,), group="d4")),
        ("equivariant", EquivariantConfig(hidden=(32,), activation="relu", group="d4")),
    ],
)
def test_a_stored_network_with_the_fields_of_all_networks_is_read_as_its_own(name, network):
    stored = resolve_config("navigation").model_dump(mode="json") | {"network": {"name": name, **FLAT}}
    config = parse_config(stored, Path("run"))
    assert config.network == network
    again = json.loads(config.model_dump_json())
    assert set(again["network"]) == set(type(network).model_fields), "what is stored anew are its own fields alone"
    assert parse_config(again, Path("run")) == config


@pytest.mark.parametrize(
    ("network", "sentence"),
    [
        ({"name": "mlp", "depth": 3}, "unknown setting 'config.network.depth'"),
        ({"name": "mlp", "hidden": ["wide"]}, "bad value 'wide' for 'config.network.hidden.0'"),
        ({"name": "cnn"}, "unknown network 'cnn'"),
        ({"name": ["mlp"]}, "unknown network"),
        ("mlp", "bad value 'mlp' for 'config.network'"),
    ],
)
def test_a_stored_network_that_is_damaged_is_one_sentence(network, sentence):
    stored = resolve_config("navigation").model_dump(mode="json") | {"network": network}
    with pytest.raises(ValueError, match=re.escape(sentence)) as caught:
        parse_config(stored, Path("run"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("task", "algorithm", "overrides", "actions"),
    [
        ("formation", "qmix", {}, "discrete"),
        ("formation", "maddpg", {}, "continuous"),
        ("navigation", "qmix", {}, "discrete"),
        ("navigation", "qmix", {"task.actions": "continuous"}, "continuous"),
        ("wildlife", "qmix", {}, None),
    ],
)
def test_a_learner_asks_its_task_for_actions_that_it_can_choose_where_the_user_is_silent(
    task, algorithm, overrides, actions
):
    assert resolve_config(task, algorithm, overrides=overrides).task_settings.get("actions") == actions


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ({"task": "chess"}, "unknown task 'chess'; the tasks are navigation, predator-prey"),
        ({"algorithm": "magic"}, "unknown algorithm 'magic'; the algorithms are mappo"),
        ({"preset": "best"}, "mappo has no preset 'best'; it has default, paper, fast"),
        (
            {"speed": 1},
            "cannot set 'speed': a setting is SECTION.NAME with a section of task, mappo, network, prior, evaluation",
        ),
        ({"qmix.tau": 1}, "cannot set 'qmix.tau': a setting is SECTION.NAME"),
        ({"prior.force": 1}, "unknown setting 'prior.force'; prior has kind, transforms, copies"),
        (
            {"network.name": "mlp", "network.width": 1},
            "unknown setting 'network.width'; the network mlp has name, hidden, symmetrise, activation",
        ),
        (
            {"network.precision": "bfloat16"},
            "the network 'set' that the preset has for navigation has no 'precision'; add --network mlp",
        ),
        (
            {"network.name": "mpn", "network.group": "d4"},
            "unknown setting 'network.group'; the network mpn has name, hidden, symmetrise",
        ),
        ({"network.name": "cnn"}, "unknown network 'cnn'; the networks are mlp, gru, mpn"),
        ({"network.name": [1]}, "unknown network '[1]'; the networks are mlp"),
        ({"task.prey": "still"}, "unknown setting 'task.prey'; task has convention, actions, horizon"),
        ({"mappo.num_envs": 0}, "bad value 0 for 'mappo.num_envs': input should be greater than or equal"),
        ({"mappo.gamma": float("nan")}, "bad value nan for 'mappo.gamma': it has to be a finite number"),
        ({"network.hidden": "64"}, "bad value 64 for 'network.hidden': it has to be a list, as [64,64]"),
        ({"network.hidden": [64, "wide"]}, "bad value 'wide' for 'network.hidden.1'"),
        ({"mappo.learning_rate": "1e999"}, "bad value 1e999 for 'mappo.learning_rate': it has to be a"),
        ({"evaluation.every_steps": "9" * 400}, "for 'evaluation.every_steps': it has more than 64 bits"),
        ({"mappo.num_envs": "true"}, "bad value true for 'mappo.num_envs': it has to be a number"),
        ({"network.hidden": "[64,true]"}, "bad value [64, true] for 'network.hidden': it has to be"),
        ({"network.hidden": "[" * 20_000}, "for 'network.hidden'"),
        ({"steps": 10**30}, "for 'run.steps': input should be less than or equal to 1000000000000"),
        ({"steps": 0}, "bad value 0 for 'run.steps'"),
        ({"seeds": ()}, "for 'run.seeds'"),
        ({"device": "tpu"}, "bad value 'tpu' for 'run.device'"),
    ],
)
def test_what_is_unknown_or_out_of_range_is_one_sentence(choice, sentence):
    overrides = {name: value for name, value in choice.items() if "." in name or name == "speed"}
    asked = {"task": "navigation", "overrides": overrides} | {n: v for n, v in choice.items() if n not in overrides}
    with pytest.raises(ValueError, match=re.escape(sentence)) as caught:
        resolve_config(**asked)
    assert "\n" not in str(caught.value)


def test_a_stored_configuration_gets_the_settings_that_came_later_and_keeps_its_own() -> None:
    now = resolve_config("navigation", overrides={"network.name": "mlp", "task.num_agents": 4})
    left_out = {"task_settings": {"wind"}, "algorithm_settings": {"gamma"}}
    then = RunConfig.model_validate(now.model_dump(exclude=left_out))
    assert then != now
    assert completed(then) == now


def test_a_setting_that_came_later_may_have_a_default_that_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    class Grown(task_class("navigation").Settings):
        places: tuple[int, ...] = Field(default_factory=lambda: (1, 2))

    then = resolve_config("navigation")
    monkeypatch.setattr(config_module, "task_class", lambda name: SimpleNamespace(Settings=Grown))
    assert completed(then).task_settings["places"] == [1, 2], "as JSON has it"
    assert completed(then) == resolve_config("navigation"), "a run that is on record and one that is asked for again"
