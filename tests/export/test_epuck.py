"""What surrounds an exported policy on an e-puck: observations from poses and safety stops."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from esp_cli.export import check, epuck
from esp_cli.export.esp_epuck import PATIENCE_S, Pilot
from esp_cli.export.export import export
from esp_envs import Field, Kind, layout
from esp_envs.epuck.formation import Formation
from esp_envs.registry import TASKS
from tests.export.policies import KINDS, drawn_policy

SETTINGS = {
    "offset": {},
    "goal in its unit": {"goal_sight_m": 0.3},
    "nearness, three neighbours": {"sight": "nearness", "neighbours": 3, "num_agents": 5},
    "no pillars, noise": {"num_obstacles": 0, "num_agents": 4, "sensor_noise_m": 0.1, "heading_noise_rad": 0.1},
    "a robot alone": {"num_obstacles": 0, "num_agents": 1},
}


@pytest.mark.parametrize("case", SETTINGS)
def test_a_pilot_sees_from_poses_what_the_task_shows(case, tmp_path, monkeypatch):
    trained = drawn_policy("wheels", **SETTINGS[case])
    assert epuck.STATES == 10_000, "in an export; that the formulas are the same shows in fewer"
    states = 1_000 if case == "offset" else 300
    scenes = epuck.take_scenes(trained, states)
    poses, *_, observations = scenes
    assert len(poses) == len(observations) == states
    assert len(np.unique(poses[:, 0, 0])) > 0.99 * states, "states differ"
    monkeypatch.setattr(epuck, "take_scenes", lambda trained: scenes)
    results = export(trained, ["numpy", "torch"], tmp_path).formats
    seen = {result.name: result.seen for result in results}
    assert 0 < seen["numpy"] < epuck.TOLERANCE
    assert seen["torch"] is None
    assert (tmp_path / "esp_epuck.py").is_file()
    assert "Observations built from poses were compared" in (tmp_path / "README.md").read_text()


def test_a_policy_over_sets_takes_no_rows_and_so_no_pilot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "wheels over sets", ("formation", "mappo", {"network.name": "set"}))
    export(drawn_policy("wheels over sets"), ["numpy"], tmp_path)
    assert not (tmp_path / "esp_epuck.py").exists()


def test_an_observation_that_is_built_wrongly_is_found() -> None:
    trained = drawn_policy("wheels", sight="nearness")
    scenes = epuck.take_scenes(trained, 300)
    description = described(trained)
    assert epuck.compare_scenes(scenes, description) < 1e-6
    for part, wrong in (("fading_m", 0.201), ("body_radius_m", 0.038)):
        spoilt = description | {"robot": description["robot"] | {part: wrong}}
        with pytest.raises(ValueError, match="differs from the task's"):
            epuck.compare_scenes(scenes, spoilt)
    swapped = description | {"observation": description["observation"][::-1]}
    with pytest.raises(ValueError, match="differs from the task's"):
        epuck.compare_scenes(scenes, swapped)
    unseen = (*scenes[:-1], np.full_like(scenes[-1], np.nan))
    with pytest.raises(ValueError, match="differs from the task's by nan"):
        epuck.compare_scenes(unseen, description)


class Battery(Formation):
    """Formation change in which each robot also sees its battery."""

    def _describe(self):
        spec = super()._describe()
        return replace(spec, observation=layout(*spec.observation.fields, Field("battery", Kind.SCALAR, 1, "")))

    def _observe(self, world):
        seen = super()._observe(world).flatten(-2)
        return torch.cat([seen, torch.ones_like(seen[..., :1])], -1)


class Scaled(Formation):
    """Formation change in half the unit."""

    def _observe(self, world):
        return 2 * super()._observe(world)


class Same(Formation):
    """Formation change as it is."""


@pytest.mark.usefixtures("few_scenes")
@pytest.mark.parametrize(
    ("task", "told"),
    [(Battery, "sees: battery; esp_epuck.py is left out"), (Scaled, "by .*; esp_epuck.py is left out"), (Same, None)],
)
def test_a_task_of_ones_own_that_shows_other_numbers_goes_out_without_poses(task, told, tmp_path, monkeypatch):
    monkeypatch.setitem(KINDS, "own", (TASKS.register(task), "mappo", {}))
    (written,) = export(drawn_policy("own"), ["numpy"], tmp_path).formats
    assert (told is None) == (tmp_path / "esp_epuck.py").exists() == (written.note is None)
    assert told is None or re.search(told, written.note)


def described(trained) -> dict:
    from esp_cli.export.card import describe
    from esp_cli.export.program import program_of

    program = program_of(trained.policy)
    return describe(trained, program, check.take_sample(trained, program, 16))


def test_what_poses_do_not_tell_is_refused() -> None:
    description = described(drawn_policy("wheels"))
    description["observation"] = [*description["observation"], {"field": "camera", "index": "8..9"}]
    with pytest.raises(ValueError, match="poses do not tell what this policy sees: camera"):
        Pilot(description, lambda obs: obs)


TEAM = np.array([[-0.5, 0.1, 0.3], [0.4, -0.2, 2.0], [0.0, 0.6, -1.0]], np.float32)
GOALS, PILLARS = -TEAM[:, :2], np.array([[0.2, 0.2]], np.float32)


def spoilt(array: np.ndarray, place: tuple[int, int], value: float) -> np.ndarray:
    changed = array.copy()
    changed[place] = value
    return changed


UNSAFE = {
    "a pose is not a number": {"poses": spoilt(TEAM, (2, 0), np.nan)},
    "a heading is infinite": {"poses": spoilt(TEAM, (1, 2), np.inf)},
    "the goal is not a number": {"goals": spoilt(GOALS, (0, 1), np.nan)},
    "a pillar is not a number": {"pillars": spoilt(PILLARS, (0, 0), np.nan)},
    "the poses are old": {"age_s": PATIENCE_S + 0.01},
    "the age is not a number": {"age_s": float("nan")},
    "the poses come from the future": {"age_s": -PATIENCE_S - 0.01},
}


@pytest.mark.parametrize("case", UNSAFE)
def test_a_team_stands_still_where_it_is_not_safe_to_drive(case: str) -> None:
    trained = drawn_policy("wheels")
    pilot = Pilot(described(trained), lambda obs: obs[..., :2])
    safe = {"poses": TEAM, "goals": GOALS, "pillars": PILLARS, "age_s": PATIENCE_S}
    assert np.abs(pilot.wheels(**safe)).min() > 0
    assert not pilot.wheels(**safe | UNSAFE[case]).any()


@pytest.mark.parametrize("pillars", [[[0.2, 0.2, 0.0]], [[0.2, 0.2, 0.0]] * 2, [0.2, 0.2]])
def test_pillars_of_another_shape_are_refused(pillars: list) -> None:
    pilot = Pilot(described(drawn_policy("wheels")), lambda obs: obs[..., :2])
    with pytest.raises(ValueError, match=r"pillars \(.*\) should be \[M, 2\]"):
        pilot.wheels(TEAM, GOALS, pillars)


def test_a_team_stands_still_where_its_policy_says_no_number() -> None:
    pilot = Pilot(described(drawn_policy("wheels")), lambda obs: np.full((3, 2), np.nan))
    assert not pilot.wheels(TEAM, GOALS, PILLARS).any()


def test_what_remembers_goes_out_without_poses(tmp_path: Path) -> None:
    trained = drawn_policy("point, recurrent")
    export(trained, ["numpy"], tmp_path)
    assert not (tmp_path / "esp_epuck.py").exists()
