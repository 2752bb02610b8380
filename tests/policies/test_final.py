"""The final evaluation of a policy: numbers by hand, anchors, and batches that depend on seeds alone."""

import json
import math
from dataclasses import replace
from operator import methodcaller

import pytest
import torch

from esp_cli.networks.policy import StochasticPolicy
from esp_cli.policies import evaluation as final
from esp_cli.policies.evaluation import (
    FinalEvaluation,
    evaluate,
    play_batches,
    play_references,
    rough_anchors,
    summarise_returns,
)
from esp_cli.policies.loading import TrainedPolicy, _stopped
from esp_cli.policies.statistics import SeedSummary
from esp_cli.training.build import PolicyController, ScriptedController, build_environment, generators, play
from esp_cli.training.config import resolve_config
from tests.training.runs import tiny_config


def untrained(tmp_path, seeds=(3, 7), **choice) -> TrainedPolicy:
    """Policies with their first weights, which depend on the seeds alone."""
    config = tiny_config(seeds=seeds, **choice)
    spec = build_environment(config, 1, "shape").spec
    policy = StochasticPolicy(spec, config.network, generators(seeds, "weights"))
    return TrainedPolicy(config, policy, spec, 0, tmp_path)


def test_the_summary_by_hand():
    # episodes 1 3 and 5 7: seeds 2 and 6, mean 4, s.e.m. |2 - 6| / 2; the bootstrap of two seeds reaches from 2 to 6
    two = summarise_returns(torch.tensor([[1.0, 3.0], [5.0, 7.0]]))
    assert two == SeedSummary(mean=4.0, sem=pytest.approx(2.0), ci95=(2.0, 6.0), per_seed=(2.0, 6.0))
    one = summarise_returns(torch.tensor([[1.0, 3.0]]))
    assert one == SeedSummary(mean=2.0, sem=None, ci95=None, per_seed=(2.0,))


def test_a_final_evaluation_states_what_was_played_and_is_json(tmp_path):
    trained = untrained(tmp_path)
    result = evaluate(trained, 3)
    assert (result.task, result.task_version, result.convention) == ("navigation", 1, trained.spec.convention)
    assert (result.source, result.step, result.seeds, result.episodes) == (str(tmp_path), 0, (3, 7), 3)
    assert result.greedy.per_seed != result.stochastic.per_seed
    assert json.loads(result.model_dump_json())["anchors"].keys() == {"random", "heuristic", "cover", "blind"}
    assert result.heuristics == ("nearest", "cover", "blind")
    assert result.anchor_metrics.keys() == result.anchors.keys()
    assert all(metrics.keys() == result.metrics.keys() for metrics in result.anchor_metrics.values())
    for name, values in result.metrics_per_seed.items():
        assert sum(values) / len(values) == pytest.approx(result.metrics[name])
    assert result.task_settings["num_agents"] == 3
    assert evaluate(trained, 3) == result, "the same every time"
    assert FinalEvaluation.model_validate_json(result.model_dump_json()) == result


def test_the_measures_of_the_task_are_those_of_the_greedy_policy(tmp_path):
    trained = untrained(tmp_path, task__horizon=8)
    result = evaluate(trained, 3)
    greedy = play_batches(trained.config, PolicyController(trained.policy), "greedy", 3).metrics
    noise = generators(trained.config.seeds, "judgement", "noise")
    drawn = play_batches(trained.config, PolicyController(trained.policy, noise), "stochastic", 3).metrics
    assert result.metrics == pytest.approx({name: value.mean().item() for name, value in greedy.items()})
    for name, value in greedy.items():
        assert result.metrics_per_seed[name] == pytest.approx(value.mean(1).tolist())
    assert any(drawn[name].mean().item() != pytest.approx(value) for name, value in result.metrics.items())


def test_a_seed_that_stopped_has_no_numbers(tmp_path):
    whole = untrained(tmp_path)
    result = evaluate(replace(whole, stopped=(1,)), 3)
    alone = evaluate(whole, 3).greedy.per_seed
    assert result.greedy.per_seed == (alone[0], None)
    assert (result.greedy.mean, result.stochastic.per_seed[1]) == (alone[0], None)
    assert {values[1] for values in result.metrics_per_seed.values()} == {None}
    assert all(math.isfinite(value) for value in result.metrics.values())
    assert FinalEvaluation.model_validate_json(result.model_dump_json()) == result
    nobody = evaluate(replace(whole, stopped=(0, 1)), 3)
    assert (nobody.greedy.mean, nobody.metrics) == (None, {})


@pytest.mark.parametrize(
    ("meta", "stopped"),
    [
        ({"stopped_seeds": {"1": 200}}, (1,)),
        ({"greedy_returns": [None, -3.0]}, (0,)),
        ({"greedy_returns": [-2.0, -3.0]}, ()),
        ({}, ()),
    ],
)
def test_a_checkpoint_and_a_policy_file_say_who_stopped(meta, stopped):
    assert _stopped(meta, 2) == stopped


def test_anchors_lie_where_the_card_says(tmp_path):
    anchors = evaluate(untrained(tmp_path), 256).anchors
    # the card of navigation: random -218, nearest -112; a mean over 512 episodes has an error of about 2
    assert anchors["random"] == pytest.approx(-218, abs=8)
    assert anchors["heuristic"] == pytest.approx(-112, abs=5)


def test_a_seed_is_evaluated_alone_as_among_others(tmp_path, monkeypatch):
    monkeypatch.setattr(final, "EPISODES", 2)  # of a batch; the third episode is of the next one
    both, first, second = (evaluate(untrained(tmp_path, seeds), 3) for seeds in ((3, 7), (3,), (7,)))
    for mode in ("greedy", "stochastic"):
        alone = getattr(first, mode).per_seed + getattr(second, mode).per_seed
        assert getattr(both, mode).per_seed == pytest.approx(alone, rel=1e-5)
    for name in ("random", "heuristic"):
        mean = (first.anchors[name] + second.anchors[name]) / 2
        assert both.anchors[name] == pytest.approx(mean, rel=1e-5)
    assert first.anchors["random"] != second.anchors["random"]


def test_more_episodes_than_fit_at_once_are_played_in_batches(tmp_path, monkeypatch):
    trained = untrained(tmp_path)
    monkeypatch.setattr(final, "EPISODES", 2)
    result = evaluate(trained, 5)
    streams = [(0, 2), (2, 2), (4, 1)]  # first episode and number of worlds of each batch
    parts = [
        play(
            build_environment(trained.config, worlds, "judgement", "heuristic", begin),
            ScriptedController(methodcaller("heuristic")),
        )
        for begin, worlds in streams
    ]
    episodes = torch.cat([part.returns for part in parts], 1)
    assert episodes.shape == (2, 5)
    assert result.anchors["heuristic"] == pytest.approx(episodes.mean().item())
    assert len({round(x, 4) for x in episodes.flatten().tolist()}) == 10, "each episode is another one"


def test_rough_anchors_are_near_those_of_many_episodes_and_absent_where_they_would_say_little() -> None:
    config = resolve_config("predator-prey", seeds=[0, 1])
    rough, many = (
        rough_anchors(config, 64),
        play_references(config, build_environment(config, 1, "shape").heuristics, 200),
    )
    for name, value in rough.items():
        assert value == pytest.approx(float(many[name].returns.mean()), abs=12), "of 85 between them"
    assert set(rough) == set(many) - {"blind"}, "which is no end of the scale"
    assert rough_anchors(config, 1) == {}, "one episode has no error"
    crowd = resolve_config("navigation", seeds=[0], overrides={"task.num_agents": 120, "task.num_landmarks": 120})
    assert rough_anchors(crowd, 64) == {}, "one episode is more than a second's worth"
