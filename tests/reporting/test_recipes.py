"""A configuration gives its command line, and the command line the configuration."""

from __future__ import annotations

import json
import shlex

import pytest

from esp_cli.reporting.recipes import command_of
from esp_cli.studies.catalogue import Request, plan
from tests.cli.running import esp
from tests.training.runs import tiny_config


def test_what_the_preset_has_is_left_out():
    command = command_of(plan("table1", Request(algorithms=("mappo",), tasks=("navigation",))).cells[0].config)
    assert command == (
        "esp train --task navigation --algo mappo --preset default --steps 500000 --seeds 10 --device cpu "
        "--set 'prior.kind=\"none\"'"
    )


@pytest.mark.parametrize(
    "choice",
    [
        {"steps": 50, "seeds": (3, 7), "task__num_agents": 2, "prior__transforms": "rot90,flip-x"},
        {"steps": 50, "seeds": (5,), "task": "predator-prey", "task__prey": "fleeing", "mappo__gamma": 0.9},
    ],
)
def test_the_command_line_trains_the_same_run(tmp_path, choice):
    config = tiny_config(**choice)
    esp(*shlex.split(command_of(config))[1:], "--out", tmp_path / "run")
    made = json.loads((tmp_path / "run" / "config.json").read_text())
    assert {k: v for k, v in made.items() if k not in ("format", "version")} == config.model_dump(mode="json")
