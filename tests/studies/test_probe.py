"""What a study costs: measured by a probe that leaves nothing behind."""

from __future__ import annotations

import threading

import pytest
import torch

from esp_cli.studies import probe as module
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from tests.training.runs import tiny_config

SMALL = {"network.hidden": [8], "evaluation.episodes": 2, "maddpg.num_envs": 2, "maddpg.replay_episodes": 40}


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(module, "PROBE_SECONDS", 0.0)


def test_twice_the_steps_cost_about_twice_the_iterations_and_evaluations(monkeypatch):
    # a clock that ticks once at every look: an iteration and an evaluation cost the same in both
    ticks = iter(range(10**6))
    monkeypatch.setattr(module.time, "process_time", lambda: float(next(ticks)))
    one, two = module.probe(tiny_config(steps=1000), 4), module.probe(tiny_config(steps=2000), 4)
    # 20 and 40 iterations; 11 and 21 evaluations of 2 x 2 episodes; an episode takes half a tick
    iteration = (two.training_s - one.training_s - 10 * 4 * 0.5) / 20
    assert one.training_s == pytest.approx(20 * iteration + 11 * 4 * 0.5)
    # greedy, drawn, random, and the two heuristics of navigation, four episodes each
    assert one.evaluation_s == two.evaluation_s == 5 * 4 * 0.5


def test_other_work_on_the_machine_costs_a_run_nothing(monkeypatch):
    """The processor time of a process does not pass while it sleeps; a GPU's time does."""
    monkeypatch.setattr(module.time, "process_time", lambda: 7.0)
    own, watch = threading.get_ident(), module.time.monotonic

    def read() -> float:
        return pytest.fail("a watch was read") if threading.get_ident() == own else watch()  # others wait by it

    monkeypatch.setattr(module.time, "monotonic", read)
    assert module.probe(tiny_config(steps=100), 4).training_s == 0.0
    assert module._clock(tiny_config().model_copy(update={"device": "cuda"})) is module.time.monotonic


def test_the_replay_is_counted_as_full_as_it_will_be():
    config = resolve_config("navigation", "maddpg", steps=25 * 30, overrides=SMALL)
    learner = build_learner(config)
    whole = learner.replay.num_bytes
    assert learner.bytes_to_come(config.steps) == whole * 30 // 40
    longer = config.model_copy(update={"steps": 25 * 300})
    assert learner.bytes_to_come(longer.steps) == whole, "it keeps the last 40"
    learner.iterate(0.0)
    assert learner.bytes_to_come(longer.steps) == whole * 38 // 40
    found = module.probe(config, 4)
    assert found.peak_bytes - found.disk_bytes > 3 * (whole * 30 // 40)


def test_an_on_policy_run_has_no_replay_and_threads_are_as_before():
    before = torch.get_num_threads()
    config = tiny_config(steps=100)
    assert build_learner(config).bytes_to_come(config.steps) == 0
    assert module.probe(config, 4).disk_bytes > 0
    assert torch.get_num_threads() == before
