"""What tuning tries: spaces, draws, budgets, and the study that judges the best settings."""

import json
import random
import re

import pytest

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.studies.catalogue import Request
from esp_cli.studies.search import Trials
from esp_cli.studies.space import Dimension, default_space, drawn, read_space
from esp_cli.studies.study import StudyFolder
from esp_cli.studies.tuning import Tuning
from esp_envs.errors import UserError
from tests.studies.test_symmetry import benchmark, write_trials
from tests.training.runs import TINY

SPACE = {"mappo.learning_rate": Dimension(low=1e-4, high=1e-1, log=True), "mappo.gamma": Dimension(choices=(0.9, 0.99))}
WHOLE = {**SPACE, "prior.consistency_coef": Dimension(low=0.1, high=1.0)}
BOTH = ("esp", "none")


def tuning(priors=BOTH, budget=4, space=WHOLE, **choice) -> Tuning:
    """Return a search of navigation in a space, or in the default one."""
    plain = {"tasks": ("navigation",), "steps": ((None, 900),), "seeds": (0, 1), "command": "esp tune"}
    plain["overrides"] = {"network.name": "mlp", **TINY}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("esp_cli.studies.tuning.read_space", lambda _: space)
        return Tuning(Request(**(plain | choice)), priors, budget, 2, "a file" if space else None)


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_every_algorithm_has_a_space_of_settings_that_it_takes_and_a_run_has(algorithm):
    assert algorithm in ALGORITHMS
    for task in ("navigation", "predator-prey", "wildlife"):
        asked = tuning(tasks=(task,), algorithms=(algorithm,), overrides={}, space=None, budget=2)
        assert ("network.activation" in asked.space) == (task != "wildlife"), "what its network has"
        assert {f"{algorithm}.gamma", f"{algorithm}.learning_rate"} < set(asked.space) <= set(default_space(algorithm))
        plain, prior = (asked.trials_of[task, name][1].config for name in ("plain", "ESP"))
        assert plain.algorithm_settings == prior.algorithm_settings, "both sides try the same"
        assert prior.prior.consistency_coef == asked.draws[1]["prior.consistency_coef"]


def test_ranges_are_drawn_evenly_or_by_orders_of_magnitude():
    space = {
        "even": Dimension(low=0.0, high=10.0),
        "log": Dimension(low=1e-4, high=1.0, log=True),
        "whole": Dimension(low=3, high=5),
        "orders": Dimension(low=1, high=1000, log=True),
        "choice": Dimension(choices=("a", [1, 2])),
    }
    generator = random.Random(0)
    found = [drawn(space, generator) for _ in range(2000)]
    assert sum(one["even"] < 2.5 for one in found) / 2000 == pytest.approx(0.25, abs=0.04)
    assert sum(one["log"] < 1e-3 for one in found) / 2000 == pytest.approx(0.25, abs=0.04)
    assert all(0 <= one["even"] <= 10 and 1e-4 <= one["log"] <= 1 and 1 <= one["orders"] <= 1000 for one in found)
    assert {one["whole"] for one in found} == {3, 4, 5}
    assert {type(one["orders"]) for one in found} == {int}
    assert {str(one["choice"]) for one in found} == {"a", "[1, 2]"}


def test_trials_have_the_same_draws_whatever_the_budget_and_the_first_the_defaults():
    few, many = tuning(budget=2), tuning(budget=6)
    assert many.draws[:2] == few.draws
    assert (many.draws[0], len(many.draws)) == ({}, 6)
    first = many.trials_of["navigation", "ESP"][0]
    assert (first.name, first.config.seeds, first.config.steps) == ("esp-000", (100, 101), 900)


def test_settings_that_do_not_go_together_and_repeated_ones_are_drawn_again():
    worlds = {"mappo.num_minibatches": Dimension(choices=(1, 2, 4096))}  # more of them than steps in a batch
    asked = tuning(space=worlds, overrides={"network.name": "mlp", "mappo.num_envs": 8}, budget=9)
    assert sorted(one.get("mappo.num_minibatches", 0) for one in asked.draws) == [0, 1, 2]
    assert all("num_minibatches" in reason for reason in asked.refused)
    assert asked.refused


def test_defaults_that_cannot_be_trained_are_refused_before_the_draws():
    space = {"maddpg.num_envs": Dimension(choices=(4,))}
    with pytest.raises(UserError, match="one round brings 8 episodes"):
        tuning(algorithms=("maddpg",), space=space, overrides={"network.name": "mlp", "maddpg.replay_episodes": 4})


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
        tuning(**changes)


def test_a_setting_that_another_one_of_the_space_gives_an_effect_is_searched():
    doubt = {"prior.doubt": Dimension(low=1.0, high=9.0)}
    with pytest.raises(UserError, match=r"varies 'prior\.doubt', which is without effect"):
        tuning(priors=("esp",), space=doubt)
    tuning(priors=("esp",), space=doubt | {"prior.trust": Dimension(choices=("full", "measured"))})


def test_a_setting_of_the_task_may_be_fixed_though_none_is_searched():
    assert tuning(overrides={"navigation.num_agents": 2, "evaluation.episodes": 2}).overrides["task.num_agents"] == 2


def test_what_a_prior_leaves_to_be_measured_is_measured_for_every_trial():
    asked = tuning(overrides={"task.wind": 0.3, "network.name": "mlp"}, priors=("auto",), budget=2)
    for cell in asked.trials.cells:
        prior = cell.config.prior
        assert (prior.kind, prior.trust, prior.weights["flip-x"]) == ("esp", "measured", 1.0)
        assert prior.weights["rot180"] < 0.1


def test_the_best_settings_are_judged_beside_the_default_ones_on_other_seeds():
    asked = tuning()
    # trial 0 of the plain learner has the default settings, so that it is both
    cells = plain, default, tuned = asked.fresh({("navigation", "ESP"): 3, ("navigation", "plain"): 0})
    assert [cell.variant for cell in cells] == ["plain, default", "ESP, default", "ESP, tuned (trial 3)"]
    assert {cell.config.seeds for cell in cells} == {(0, 1)}
    assert tuned.config.algorithm_settings["learning_rate"] == asked.draws[3]["mappo.learning_rate"]
    assert [cell.reference for cell in cells] == [None, "plain-default", "plain-default"]
    later = asked.fresh({("navigation", "plain"): 0, ("navigation", "ESP"): 2})
    assert later[:2] == [plain, default], "another best adds a cell and changes no other"
    with pytest.raises(UserError, match="seed 101 belongs to the trials"):
        tuning(seeds=(0, 101))


def test_tuned_is_compared_with_tuned_and_default_with_default():
    def references(priors=BOTH, **numbers: int) -> dict[str, str | None]:
        asked = tuning(priors=priors)
        names = {"esp": ("navigation", "ESP"), "none": ("navigation", "plain")}
        return {cell.name: cell.reference for cell in asked.fresh({names[one]: n for one, n in numbers.items()})}

    assert references(esp=3, none=2) == {
        "plain-default": None,
        "plain-tuned-trial-2": "plain-default",
        "esp-default": "plain-default",
        "esp-tuned-trial-3": "plain-tuned-trial-2",
    }
    assert references(esp=0, none=2)["esp-tuned-trial-0"] == "plain-tuned-trial-2"
    assert references(("esp",), esp=3) == {"esp-default": None, "esp-tuned-trial-3": "esp-default"}
    assert references(esp=3)["esp-tuned-trial-3"] == "plain-default"


def test_the_best_settings_are_written_for_training_and_all_scores_are_on_file(tmp_path):
    asked = tuning(overrides={"network.name": "mlp"})
    study = asked.judged(write_trials(tmp_path / "s", asked, {"esp-003": 5.0, "none-000": 5.0}))
    assert (study.kind, study.rows, len(study.cells)) == ("tuned", "variants", 3)
    written = {name: json.loads((tmp_path / "s" / f"preset-{name}.json").read_text()) for name in BOTH}
    assert written["none"] == {
        "task": "navigation", "algorithm": "mappo", "preset": "default", "steps": 900, "network.name": "mlp",
        "prior.kind": "none",
    }  # fmt: skip
    assert written["esp"] == written["none"] | {"prior.kind": "esp"} | asked.draws[3]
    trials = json.loads((tmp_path / "s" / "trials.json").read_text())
    assert trials["scores"] == {
        "navigation, 900: ESP": [0.0, 0.0, 0.0, 5.0],
        "navigation, 900: plain": [5.0, 0.0, 0.0, 0.0],
    }
    assert (trials["draws"], trials["seeds"]) == (asked.draws, [100, 101])


@pytest.mark.parametrize(
    ("dimension", "ends", "inside"),
    [
        (Dimension(low=0.0, high=10.0), (0.0, 0.4, 9.6), (0.6, 5.0, 9.4)),
        (Dimension(low=1e-4, high=1.0, log=True), (1.5e-4, 0.7), (1.7e-4, 0.01, 0.6)),  # ends at 1.58e-4 and 0.631
        (Dimension(low=3, high=16), (3, 16), (4, 15)),
        (Dimension(choices=(64, 128, 256)), (64, 256), (128,)),
        (Dimension(choices=([32, 32], [64, 64], [128, 128])), ([32, 32], [128, 128]), ([64, 64],)),
        (Dimension(choices=("c4", "d4", "d8")), (), ("c4", "d8")),
        (Dimension(choices=(0.9, 0.99)), (), (0.9, 0.99)),
    ],
)
def test_what_lies_at_an_end_by_hand(dimension, ends, inside):
    assert [dimension.is_at_end(value) for value in (*ends, *inside)] == [True] * len(ends) + [False] * len(inside)


def test_a_best_trial_at_an_end_of_the_space_is_told(tmp_path):
    space = {"mappo.num_epochs": Dimension(choices=(3, 5, 8)), "mappo.gamma": Dimension(low=0.9, high=1.0)}
    asked = tuning(space=space, budget=8, overrides={"network.name": "mlp"})
    number = next(k for k, draw in enumerate(asked.draws) if draw.get("mappo.num_epochs") == 8)
    asked.judged(write_trials(tmp_path / "s", asked, {f"esp-{number:03d}": 5.0}))
    (hint,) = asked.hints
    assert hint.startswith("the best of ESP lies at an end of what was tried: mappo.num_epochs 8")
    assert "plain" not in hint, "whose best is the default"


def test_a_longer_search_goes_on_in_its_folder_and_one_in_another_space_does_not(tmp_path):
    write_trials(tmp_path / "s", tuning(), {})
    assert len(Trials.create(tmp_path / "s", tuning(budget=5).trials).study.cells) == 10
    with pytest.raises(UserError, match="holds another study"):
        Trials.create(tmp_path / "s", benchmark().trials)
    asked = tuning(budget=5)
    StudyFolder.create(tmp_path / "s" / "fresh", asked.judged(write_trials(tmp_path / "s", asked, {})), keep=False)
    assert len(Trials.planned(tmp_path / "s", tuning(budget=6).trials, keep=False)[0].study.cells) == 12
    for fewer in ({"budget": 4}, {"budget": 5, "priors": ("esp",)}):
        with pytest.raises(
            UserError, match="5 each, and fresh judges them; keep its --budget or more, and all its kinds of --prior"
        ):
            Trials.planned(tmp_path / "s", tuning(**fewer).trials, keep=False)
    other = tuning(space={"mappo.gamma": Dimension(low=0.5, high=0.6)})
    with pytest.raises(UserError, match=r"holds another study .esp-001 has other seeds or settings"):
        Trials.create(tmp_path / "s", other.trials)
