"""What tuning tries and how it scores: spaces, curves, budgets, and the study that judges the best settings."""

import json
import math
import re

import pytest

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.studies import symmetry
from esp_cli.studies.tuning import TUNING_FORMAT, Point, Tuning, curve_of, fresh_study, score
from esp_cli.studies.tuning_space import Dimension, default_space, read_space, space_of
from esp_cli.training.metrics import MetricsError
from esp_envs.errors import UserError
from tests.training.runs import TINY

SPACE = {"mappo.learning_rate": Dimension(low=1e-4, high=1e-1, log=True), "mappo.gamma": Dimension(choices=(0.9, 0.99))}
UNFIXED = {name: value for name, value in TINY.items() if name not in ("mappo.num_envs", "mappo.num_minibatches")}


def tuning(**changes) -> Tuning:
    plain = {
        "task": "navigation",
        "algorithm": "mappo",
        "priors": ("esp", "none"),
        "budget": 4,
        "steps": 900,
        "trial_seeds": (1000, 1001),
        "overrides": {"network.name": "mlp", **TINY},
        "space": SPACE | {"prior.consistency_coef": Dimension(low=0.1, high=1.0)},
        "command": "esp tune",
    }
    return Tuning(**(plain | changes))


def points(*means: float) -> list[Point]:
    return [Point(100 * k, mean, mean) for k, mean in enumerate(means)]


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_every_algorithm_has_a_space_whose_corners_are_settings_that_it_takes(algorithm):
    assert algorithm in ALGORITHMS
    for task in ("navigation", "predator-prey", "wildlife"):
        asked = tuning(task=task, algorithm=algorithm, overrides={}, space=default_space(algorithm))
        (searched := asked.around_defaults()).check((0, 1))
        assert ("network.activation" in searched.space) == (task != "wildlife"), "what its network has"
    without = space_of(default_space(algorithm), "none")
    assert set(default_space(algorithm)) - set(without) == {"prior.consistency_coef"}


def test_the_default_space_is_widened_to_hold_the_defaults_of_the_task():
    given = default_space("mappo")
    searched = tuning(task="navigation", algorithm="mappo", overrides={}, space=given).around_defaults()
    values = searched.default_values("esp", given)
    assert given["mappo.learning_rate"].holding(0.04) == Dimension(low=1e-4, high=0.04, log=True)
    assert searched.space["network.hidden"].choices == ([64], [64, 64], [128, 128])
    assert searched.space["mappo.entropy_coef"] == given["mappo.entropy_coef"]
    assert all(searched.space[name].encoded(value) is not None for name, value in values.items())
    assert Dimension(low=0.1, high=1.0, log=True).holding(0.0).low == 0.1, "no logarithm"


@pytest.mark.parametrize("algorithm", symmetry.SPACES)
def test_the_default_space_holds_all_that_the_benchmark_tries(algorithm):
    space = default_space(algorithm)
    for name, values in symmetry.SPACES[algorithm].items():
        assert [value for value in values if space[f"{algorithm}.{name}"].encoded(value) is None] == []


def test_an_algorithm_without_a_space_asks_for_one():
    with pytest.raises(ValueError, match="mine has no default space; name the settings to tune with --space FILE"):
        default_space("mine")


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".json", '{"mappo.learning_rate": {"low": 1e-4, "high": 1e-1, "log": true}, "mappo.gamma": [0.9, 0.99]}'),
        (".toml", "[mappo]\ngamma = [0.9, 0.99]\nlearning_rate = {low = 1e-4, high = 1e-1, log = true}\n"),
    ],
)
def test_a_space_is_read_flat_or_nested_as_json_or_toml(tmp_path, suffix, text):
    file = tmp_path / f"space{suffix}"
    file.write_text(text)
    assert read_space(file) == SPACE


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('{"mappo.gamma": 0.9}', "gives 'mappo.gamma' one value; write a list"),
        ("{}", "names no setting"),
        (
            '{"mappo.gamma": {"low": 0.1, "high": 1, "lg": true}}',
            "says 'lg' of the range 'mappo.gamma'; did you mean 'log'?",
        ),
        ('{"mappo.gamma": {"low": 0.1, "hgh": 1}}', "says 'hgh' of the range 'mappo.gamma'; did you mean 'high'?"),
        (
            '{"mappo.gamma": {"low": 0.1, "high": 1, "colour": []}}',
            "of the range 'mappo.gamma'; write low, high and log",
        ),
        ('{"mappo": {"gamma": 0.1, "lambda": 1}}', "gives 'mappo.gamma' one value; write a list"),
        ('{"mappo.gamma": {"low": 1, "high": 0}}', "the smaller one first"),
        ('{"mappo.gamma": {"low": 0, "high": 1, "log": true}}', "log needs a low above 0"),
        ('{"mappo.gamma": {"low": "a", "high": 1}}', "bad value 'a' for 'mappo.gamma.low': it has to be a number"),
        ('{"mappo.gamma": []}', "write a list of values, or low and high"),
    ],
)
def test_a_space_that_says_nothing_is_refused(tmp_path, text, sentence):
    (tmp_path / "space.json").write_text(text)
    with pytest.raises(ValueError, match=re.escape(sentence)):
        read_space(tmp_path / "space.json")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"space": {"mappo.colour": Dimension(choices=(1, 2))}}, "mappo.colour"),
        ({"space": {"mappo.gamma": Dimension(low=0.5, high=2.0)}}, "mappo.gamma"),
        (
            {"space": {"task.num_agents": Dimension(choices=(2, 3))}},
            "varies 'task.num_agents', and then trials are not",
        ),
        ({"space": {"evaluation.episodes": Dimension(low=1, high=9)}}, "fix it by --set evaluation.episodes=VALUE"),
        ({"overrides": {"mappo.gamma": 0.9}}, "--set mappo.gamma fixes what the space varies"),
        (
            {"space": SPACE | {"prior.replay": Dimension(choices=("sampled", "stored"))}},
            r"varies 'prior\.replay', which is without effect",
        ),
        (
            {"space": {"prior.consistency_coef": Dimension(low=0.1, high=1.0)}},
            "with --prior none no setting of the space",
        ),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        tuning(**changes).check((0, 1))


def test_a_setting_that_another_one_of_the_space_gives_an_effect_is_searched():
    doubt = {"prior.doubt": Dimension(low=1.0, high=9.0)}
    with pytest.raises(ValueError, match=r"varies 'prior\.doubt', which is without effect"):
        tuning(priors=("esp",), space=doubt).check((0, 1))
    tuning(priors=("esp",), space=doubt | {"prior.trust": Dimension(choices=("full", "measured"))}).check((0, 1))


def test_a_setting_of_the_task_may_be_fixed_though_none_is_searched():
    tuning(overrides={"task.num_agents": 2, "evaluation.episodes": 2}).check((0, 1))


def test_what_a_prior_leaves_to_be_measured_is_measured_for_every_trial():
    found = tuning(overrides={"task.wind": 0.3}, priors=("auto",))
    found.check((0, 1))
    prior = found.config("auto", {}).prior
    assert (prior.kind, prior.trust, prior.weights["flip-x"]) == ("esp", "measured", 1.0)
    assert prior.weights["rot180"] < 0.1


def test_a_curve_is_scored_by_its_end():
    assert score(points(-30.0, -20.0, -10.0, -12.0)) == -12.0
    assert score(points(-30.0, math.nan)) is None
    assert score([]) is None


def test_a_tuning_of_an_earlier_version_loads_unless_it_was_for_steps_or_seconds(tmp_path):
    path, stored = tmp_path / "tuning.json", tuning().model_dump(mode="json")
    TUNING_FORMAT.write(path, stored | {"goal": "return", "reach": None})
    assert TUNING_FORMAT.parse(path, Tuning) == tuning()
    TUNING_FORMAT.write(path, stored | {"goal": "steps", "reach": -15.0})
    with pytest.raises(UserError, match=r"tuning\.json: this esp has no 'goal' any more; use the esp that wrote it"):
        TUNING_FORMAT.parse(path, Tuning)


def test_the_value_of_a_point_is_the_mean_of_the_newest_evaluations(tmp_path):
    path = tmp_path / "metrics.jsonl"
    rows = [{"step": 100 * k, "eval/return_greedy": [-8.0 * k, 0.0]} for k in range(5)]
    rows.insert(1, {"step": 50})
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    found = curve_of(path)
    assert [point.step for point in found] == [0, 100, 200, 300, 400]
    assert [point.mean for point in found] == [0.0, -4.0, -8.0, -12.0, -16.0]
    assert [point.value for point in found] == [0.0, -2.0, -4.0, -8.0, -12.0]
    assert curve_of(tmp_path / "none") == []
    path.write_text('{"step": 0}\nno row\n{"step": 1}\n')
    with pytest.raises(MetricsError, match=r"metrics\.jsonl is damaged: line 2"):
        curve_of(path)


def test_the_best_settings_are_judged_beside_the_default_ones_on_other_seeds():
    best = {"esp": (3, {"mappo.learning_rate": 0.002}), "none": (0, {})}
    study = fresh_study(tuning(), best, (0, 1), 4)
    # trial 0 of the plain learner has the default settings, so that it is both
    assert [cell.variant for cell in study.cells] == ["plain, default", "ESP, default", "ESP, tuned (trial 3)"]
    assert {cell.config.seeds for cell in study.cells} == {(0, 1)}
    assert study.cells[2].config.algorithm_settings["learning_rate"] == 0.002
    assert [cell.reference for cell in study.cells] == [None, "plain-default", "plain-default"]
    later = fresh_study(tuning(), best | {"esp": (5, {"mappo.learning_rate": 0.003})}, (0, 1), 4)
    assert later.cells[:2] == study.cells[:2], "another best adds a cell and changes no other"
    with pytest.raises(ValueError, match="seed 1001 belongs to the trials"):
        tuning().check((0, 1001))


def test_tuned_is_compared_with_tuned_and_default_with_default():
    faster, slower = ({"mappo.learning_rate": rate} for rate in (0.002, 0.0002))
    study = fresh_study(tuning(), {"esp": (3, faster), "none": (2, slower)}, (0, 1), 4)
    assert {cell.name: cell.reference for cell in study.cells} == {
        "plain-default": None,
        "plain-tuned-trial-2": "plain-default",
        "esp-default": "plain-default",
        "esp-tuned-trial-3": "plain-tuned-trial-2",
    }
    equal = fresh_study(tuning(), {"esp": (0, {}), "none": (2, slower)}, (0, 1), 4)
    assert (equal.cells[3].name, equal.cells[3].reference) == ("esp-tuned-trial-0", "plain-tuned-trial-2")
    assert equal.cells[3].config == equal.cells[2].config, "so that it is trained once"
    alone = fresh_study(tuning(priors=("esp",)), {"esp": (3, faster)}, (0, 1), 4)
    assert {cell.name: cell.reference for cell in alone.cells} == {
        "esp-default": None,
        "esp-tuned-trial-3": "esp-default",
    }
    without = fresh_study(tuning(), {"esp": (3, faster)}, (0, 1), 4)
    assert [cell.name for cell in without.cells] == ["plain-default", "esp-default", "esp-tuned-trial-3"]
    assert without.cells[2].reference == "plain-default"
