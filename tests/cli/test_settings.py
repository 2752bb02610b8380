"""`esp settings`: what it lists is what the models say, and what --set takes."""

import json
from pathlib import Path
from typing import Any

import pytest

from esp_cli.training.config import resolve_config
from esp_cli.training.settings import Section, section_of, sections
from tests.cli.running import esp, refused

SECTIONS = tuple(sections())


def test_every_setting_says_what_it_does() -> None:
    silent = [one.name for section in SECTIONS for one in section.settings if len(one.description) < 3]
    assert silent == []


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.name)
def test_every_default_is_what_a_run_has_without_a_preset_and_can_be_set(section: Section) -> None:
    choice: dict[str, Any] = {"task": "navigation", "algorithm": "mappo"}
    if section.kind in choice:
        choice[section.kind] = section.name
    overrides: dict[str, object] = {"network.name": section.name} if section.kind == "network" else {}
    overrides |= {one.name: one.default for one in section.settings if one.default is not None}
    stored = resolve_config(**choice, overrides=overrides).model_dump(mode="json")
    key = {"algorithm": "algorithm_settings", "task": "task_settings"}.get(section.kind, section.kind)
    for one in section.settings:
        decided = False if one.default == "auto" else one.default  # the tests know no compiler
        assert stored[key][one.name.partition(".")[2]] == decided, one.name


def test_bounds_units_presets_and_tasks_are_told() -> None:
    found = {
        one.name: one for section in SECTIONS for one in section.settings if section.name in ("mappo", "formation")
    }
    rates = {"fast on navigation": 4e-3, "fast on predator-prey": 4e-3}
    rate, envs, arena = found["mappo.learning_rate"], found["mappo.num_envs"], found["task.arena_m"]
    assert (rate.type, rate.bounds, rate.presets) == ("number", "above 0", {"paper": 7e-4} | rates)
    assert (envs.bounds, envs.unit, envs.tasks) == (
        "from 1",
        "worlds",
        {"formation": 8, "wildlife": 64, "quadruped": 256, "sets on navigation": 128},
    )
    assert (arena.bounds, arena.unit) == ("above 0 to 20", "m")
    assert found["mappo.critic_input"].bounds == "state, observations, own"


def test_the_table_and_the_json_name_every_setting_of_a_section() -> None:
    told = esp("settings", "mappo", "--json", "-").stdout
    names = [one["name"] for section in json.loads(told) for one in section["settings"]]
    table = esp("settings", "mappo").stdout
    assert names
    assert all(name.removeprefix("mappo.") in table for name in names)
    assert "task.num_agents" not in names
    everything = json.loads(esp("settings", "--json", "-").stdout)
    assert [section["name"] for section in everything] == [section.name for section in SECTIONS]


def test_a_task_of_ones_own_has_settings_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wide.py").write_text(
        "from esp_envs.mpe.navigation import Navigation, NavigationSettings\n"
        "from pydantic import Field\n\n"
        "class WideSettings(NavigationSettings):\n"
        "    slope_rad: float = Field(0.5, ge=0, description='of the ground')\n\n"
        "class Wide(Navigation):\n"
        "    Settings = WideSettings\n"
    )
    monkeypatch.chdir(tmp_path)
    (section,) = json.loads(esp("settings", "wide:Wide", "--json", "-").stdout)
    (slope,) = [one for one in section["settings"] if one["name"] == "task.slope_rad"]
    assert (slope["default"], slope["unit"], slope["bounds"]) == (0.5, "rad", "from 0")
    assert section_of("task", "wide:Wide").kind == "task"


def test_a_name_without_settings_is_one_sentence() -> None:
    assert refused("settings", "mapo") == "nothing with settings is called 'mapo'; did you mean 'mappo'?"
    assert "there is mappo, maddpg, qmix, navigation" in refused("settings", "colour")
    assert "quadruped" in refused("settings", "colour"), "which is listed alone"
