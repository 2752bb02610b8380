"""A configuration gives its command line, and the command line the configuration."""

import json
import shlex

import pytest

from esp_cli.studies.catalogue import Request, plan
from esp_cli.training.config import seed_words
from tests.cli.running import esp
from tests.training.runs import tiny_config


def test_what_the_preset_has_is_left_out():
    study = plan("table1", Request(algorithms=("mappo",), tasks=("navigation",)))
    assert study.cells[0].config.command() == (
        "esp train --task navigation --algo mappo --seeds 10 --steps 500000 --network mlp --prior none"
    )


@pytest.mark.parametrize(
    "choice",
    [
        {"steps": 50, "seeds": (3, 7), "task__num_agents": 2, "prior__transforms": "rot90,flip-x"},
        {"steps": 50, "seeds": (5,), "task": "predator-prey", "task__prey": "fleeing", "mappo__gamma": 0.9},
        {"steps": 50, "network__name": "gru", "prior__kind": "none"},
        {"steps": 50, "network__name": "equivariant", "network__group": "d4", "prior__kind": "consistency"},
    ],
)
def test_the_command_line_trains_the_same_run(tmp_path, choice):
    config = tiny_config(**choice)
    esp(*shlex.split(config.command())[1:], "--out", tmp_path / "run")
    made = json.loads((tmp_path / "run" / "config.json").read_text())
    assert {k: v for k, v in made.items() if k not in ("format", "version", "run_id")} == config.model_dump(mode="json")


def test_a_decision_on_kernels_that_another_setting_changes_is_written():
    config = tiny_config(steps=200_000, network__layer_norm=True)
    decided = config.model_copy(update={"network": config.network.model_copy(update={"compiled": True})})
    assert "network.compiled=true" in decided.command()
    assert "network.compiled" not in config.command()


def test_what_a_shell_would_take_apart_is_quoted_and_a_text_like_a_number_stays_a_text():
    config = tiny_config(steps=50).model_copy(update={"task_settings": {"name": "a b; $(rm)", "number": "1"}})
    words = shlex.split(config.command())
    assert "task.name=a b; $(rm)" in words
    assert 'task.number="1"' in words
    assert "'task.name=a b; $(rm)'" in config.command()


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ((0, 1, 2), ["--seeds", "3"]),
        ((0,), ["--seeds", "1"]),
        ((3, 7), ["--seed-list", "3,7"]),
        ((7,), ["--seed-list", "7"]),
    ],
)
def test_seeds_are_a_count_or_a_list(seeds, words):
    assert seed_words(seeds) == words
