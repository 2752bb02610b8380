"""The training loop: resumed bit for bit, stopped cleanly, broken seeds set aside."""

import os
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from esp_cli import app
from esp_cli.training import trainer as training
from esp_cli.training.build import play
from esp_cli.training.config import resolve_config
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_cli.training.trainer import Trainer, checkpoint_seconds
from tests.forks import fork, said, wait
from tests.training.runs import tiny_config, tiny_folder


def trainer(folder):
    return Trainer(parse_config(folder.config, folder.path), folder)


def untimed(folder):
    """The metrics without what depends on the clock."""
    return [
        {name: value for name, value in row.items() if not name.startswith("time/")}
        for row in read_metrics(folder.metrics_path)
    ]


def stop_after(iterations):
    seen = []
    return lambda news: seen.append(news) or len(seen) <= iterations


def final_state(folder):
    tensors, meta = folder.latest_checkpoint(pytest.fail)
    return tensors, meta["iteration"]


def same_bits(a, b):
    return a.shape == b.shape and a.dtype == b.dtype and a.numpy().tobytes() == b.numpy().tobytes()


def small_config(algorithm):
    """A run of any algorithm that learns in its second iteration."""
    if algorithm == "mappo":
        return tiny_config()
    small = {f"{algorithm}.num_envs": 2, f"{algorithm}.batch_episodes": 2, f"{algorithm}.warmup_episodes": 0}
    small |= {"network.hidden": [8], "evaluation.episodes": 2, f"{algorithm}.replay_episodes": 20}
    return resolve_config("navigation", algorithm, steps=300, seeds=(0, 1), overrides=small)


def same(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("choice", [{}, {"network__name": "gru"}, {"task": "predator-prey", "prior__kind": "none"}])
def test_a_run_stopped_and_resumed_equals_one_run_through(tmp_path, choice):
    straight, halted = tiny_folder(tmp_path / "a", **choice), tiny_folder(tmp_path / "b", **choice)
    assert trainer(straight).run(lambda news: True)
    assert not trainer(halted).run(stop_after(3))
    assert len(read_metrics(halted.metrics_path)) < len(read_metrics(straight.metrics_path))
    assert trainer(halted).run(lambda news: True)
    assert same(final_state(straight)[0], final_state(halted)[0])
    assert untimed(straight) == untimed(halted)
    assert straight.policy_path.is_file()
    assert halted.policy_path.is_file()


def test_metrics_past_the_checkpoint_are_dropped_on_resume(tmp_path):
    folder = tiny_folder(tmp_path / "run")
    trainer(folder).run(stop_after(3))
    kept = untimed(folder)
    with folder.metrics_path.open("a") as file:
        file.write('{"step":100000,"train/return":[1.0,1.0]}\n{"step":1000')
    resumed = trainer(folder)
    assert untimed(folder) == kept
    assert resumed.step == kept[-1]["step"]


def test_a_run_whose_metrics_are_gone_says_so(tmp_path):
    halted = tiny_folder(tmp_path / "halted")
    assert not trainer(halted).run(stop_after(2))
    assert trainer(halted).notes == []
    halted.metrics_path.unlink()
    resumed = trainer(halted)
    assert resumed.notes == [f"{halted.metrics_path} is gone; curves of this run begin at step {resumed.step}"]


def test_a_run_that_is_through_is_ended_though_its_metrics_and_its_policy_are_lost(tmp_path):
    folder = tiny_folder(tmp_path / "run")
    assert trainer(folder).run(lambda news: True)
    written = folder.policy_path.read_bytes()
    folder.metrics_path.unlink()
    folder.policy_path.unlink()
    assert trainer(folder).run(lambda news: True)
    assert folder.policy_path.read_bytes() == written
    assert [row["step"] for row in read_metrics(folder.metrics_path)] == [300]


def test_every_step_is_evaluated_in_worlds_of_its_own(tmp_path):
    """The policy stays as it began, so that the worlds alone make the returns differ."""
    folder = tiny_folder(tmp_path / "run", mappo__learning_rate=1e-30)
    run = trainer(folder)
    began = {name: tensor.clone() for name, tensor in run.learner.policy.state_dict().items()}
    run.run(lambda news: True)
    assert all((tensor - began[name]).abs().max() < 1e-20 for name, tensor in run.learner.policy.state_dict().items())
    rows = [row for row in read_metrics(folder.metrics_path) if "eval/return_greedy" in row]
    assert [row["step"] for row in rows] == [0, 100, 200, 300]
    for seed in (0, 1):
        assert len({row["eval/return_greedy"][seed] for row in rows}) == 4


def test_greedy_evaluations_draw_no_action_and_stochastic_ones_draw_from_new_generators(tmp_path, monkeypatch):
    controllers = []
    monkeypatch.setattr(training, "play", lambda env, by: controllers.append(by) or play(env, by))
    trainer(tiny_folder(tmp_path / "run", steps=100)).run(lambda news: True)
    greedy, first, again, second = (controller.generators for controller in controllers)
    assert greedy is None
    assert again is None
    assert len(first) == len(second) == 2
    assert len({generator.initial_seed() for generator in (*first, *second)}) == 4, "of each seed at each step"


def break_seed_one_in_the_third_iteration(broken):
    """Give its critic a weight that is no number; return what is filled with what seed 1 had before, by name."""
    iterate, good = broken.learner.iterate, {}

    def breaking(progress):
        if broken.iteration == 2:
            state = {name: tensor for name, tensor in broken.learner.state_dict().items() if tensor.dim()}
            parts = ("policy", "critic", "normaliser", "optimiser")
            good.update({name: tensor[1].clone() for name, tensor in state.items() if name.startswith(parts)})
            with torch.no_grad():
                broken.learner.critic.network.layers[0].weight[1, 0, 0] = torch.nan
        return iterate(progress)

    broken.learner.iterate = breaking
    return good


def test_a_seed_that_breaks_stops_alone_and_keeps_its_last_good_policy(tmp_path):
    folder = tiny_folder(tmp_path / "run")
    broken, notes = trainer(folder), []
    good = break_seed_one_in_the_third_iteration(broken)
    assert broken.run(lambda news: notes.extend(news.notes) or True)
    assert broken.stopped_seeds == {1: 150}
    assert any("seed 1 stopped at step 150" in note for note in notes)
    tensors, _ = final_state(folder)
    assert torch.equal(tensors["policy.actor.layers.0.weight"][1], good["policy.actor.layers.0.weight"])
    assert all(t.isfinite().all() for name, t in tensors.items() if name.startswith(("policy", "critic")))
    last = read_metrics(folder.metrics_path)[-1]
    assert last["train/policy_loss"][0] is not None
    assert last["train/policy_loss"][1] is None
    whole = tiny_folder(tmp_path / "whole")
    trainer(whole).run(lambda news: True)
    theirs = final_state(whole)[0]["policy.actor.layers.0.weight"]
    assert torch.equal(tensors["policy.actor.layers.0.weight"][0], theirs[0]), "seed 0 never noticed"
    assert not torch.equal(tensors["policy.actor.layers.0.weight"][1], theirs[1])


def test_a_seed_that_broke_stays_as_it_was_when_its_run_is_resumed(tmp_path):
    folder = tiny_folder(tmp_path / "run")
    broken = trainer(folder)
    good = break_seed_one_in_the_third_iteration(broken)
    assert not broken.run(lambda news: news.step < 200)
    assert broken.step == 200
    resumed = trainer(folder)
    assert resumed.stopped_seeds == {1: 150}
    halted, _ = final_state(folder)
    assert resumed.run(lambda news: True)
    assert resumed.stopped_seeds == {1: 150}
    tensors, _ = final_state(folder)
    assert all(same_bits(tensors[name][1], kept) for name, kept in good.items())
    assert not any(torch.equal(tensors[name][0], halted[name][0]) for name in good if "weight" in name), "the control"
    rows = [row for row in read_metrics(folder.metrics_path) if row["step"] > 0]
    assert [row["step"] for row in rows] == [50, 100, 150, 200, 250, 300]
    assert [row["train/policy_loss"][1] is None for row in rows] == [False, False, True, True, True, True]
    assert rows[-1]["eval/return_greedy"][0] is not None
    assert rows[-1]["eval/return_greedy"][1] is None


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_a_seed_that_breaks_in_the_first_iteration_keeps_all_that_it_began_with(tmp_path, algorithm):
    """Its weights, and the optimiser's moments, which are zeros before the first step."""
    config = small_config(algorithm)
    broken = trainer(RunFolder.create(tmp_path / "run", config.model_dump(mode="json")))
    began = [tensor.clone() for tensor in broken.learner.seed_tensors()]
    iterate = broken.learner.iterate
    broken.learner.iterate = lambda progress: replace(iterate(progress), finite=torch.tensor([True, False]))
    broken.run(stop_after(2))
    now = broken.learner.seed_tensors()
    assert len(now) == len(began)
    assert all(torch.equal(tensor[1], first[1]) for tensor, first in zip(now, began, strict=True))
    assert not all(torch.equal(tensor[0], first[0]) for tensor, first in zip(now, began, strict=True)), "the control"


def test_a_run_whose_every_seed_stopped_trains_no_further_when_it_is_resumed(tmp_path):
    folder = tiny_folder(tmp_path / "run", mappo__learning_rate=1e30, mappo__max_grad_norm=1e30)
    with pytest.raises(ValueError, match="every seed stopped"):
        trainer(folder).run(lambda news: True)
    rows, (tensors, iteration) = read_metrics(folder.metrics_path), final_state(folder)
    assert all(t.isfinite().all() for name, t in tensors.items() if name.startswith(("policy.", "critic.")))
    for _ in range(2):
        resumed = trainer(folder)
        resumed.learner.iterate = lambda progress: pytest.fail("it trains")
        with pytest.raises(ValueError, match="every seed stopped"):
            resumed.run(lambda news: True)
    assert read_metrics(folder.metrics_path) == rows
    again, then = final_state(folder)
    assert then == iteration
    assert all(same_bits(again[name], tensors[name]) for name in tensors)


def test_a_finished_run_without_checkpoints_is_refused_and_keeps_its_metrics(tmp_path):
    folder = tiny_folder(tmp_path / "run", steps=100)
    trainer(folder).run(lambda news: True)
    rows = folder.metrics_path.read_bytes()
    for file in folder.checkpoints():
        file.unlink()
    with pytest.raises(ValueError, match="is trained and has no checkpoint to go on from"):
        trainer(folder)
    assert folder.metrics_path.read_bytes() == rows


def test_a_run_stopped_at_its_first_evaluation_trains_nothing_and_is_resumed(tmp_path):
    straight, halted = tiny_folder(tmp_path / "a", steps=100), tiny_folder(tmp_path / "b", steps=100)
    assert not trainer(halted).run(lambda news: False)
    assert [row["step"] for row in read_metrics(halted.metrics_path)] == [0]
    for folder in (straight, halted):
        assert trainer(folder).run(lambda news: True)
    assert untimed(straight) == untimed(halted)


FORGED = [
    lambda t, name: t.pop(name),
    lambda t, name: t.update({f"{name}x": t.pop(name)}),
    lambda t, name: t.update({f"{name}.new": t[name]}),
    lambda t, name: t.update({name: t[name].unsqueeze(0)}),
    lambda t, name: t.update({name: t[name][:1]}),
    lambda t, name: t.update({name: t[name].to(torch.int32)}),
]
"""A name is missing, another or new; a shape is another, an axis cut, a type another."""


@pytest.mark.parametrize("algorithm", ["mappo", "maddpg", "qmix"])
def test_a_forged_checkpoint_with_a_valid_checksum_is_one_sentence(tmp_path, algorithm):
    """Of every module, optimiser, generator and world, one tensor in two ways; the ways come in turn."""
    config = small_config(algorithm)
    folder = RunFolder.create(tmp_path / "run", config.model_dump(mode="json"))
    trainer(folder).run(stop_after(2))
    tensors, meta = folder.latest_checkpoint(pytest.fail)
    kinds = {name.rsplit(".", 1)[0]: name for name in tensors if tensors[name].dim()}
    pairs = [(name, FORGED[(place + skip) % 6]) for place, name in enumerate(kinds.values()) for skip in (0, 3)]
    for name, forge in pairs:
        changed = dict(tensors)
        forge(changed, name)
        if changed.keys() == tensors.keys() and all(same_bits(changed[n], tensors[n]) for n in tensors):
            continue  # such as the first of one
        folder.write_checkpoint(meta["step"], changed, {k: v for k, v in meta.items() if k != "step"})
        with pytest.raises(ValueError, match=r"does not fit|do not fit") as caught:
            trainer(folder)
        assert "\n" not in str(caught.value)
    folder.write_checkpoint(meta["step"], tensors, {k: v for k, v in meta.items() if k != "step"})
    assert trainer(folder).step == meta["step"]  # negative control: as it was, it loads


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"iteration": 3}, "is of another run"),
        ({"iteration": -1}, "does not say where its run stands"),
        ({"iteration": "many"}, "does not say where its run stands"),
        ({"elapsed_s": -1.0}, "does not say where its run stands"),
        ({"stopped_seeds": [1]}, "does not say where its run stands"),
        ({"stopped_seeds": {"7": 50}}, "is of another run"),
        ({"task_version": 99}, "was trained on navigation version 99, but this is version"),
    ],
)
def test_a_checkpoint_that_says_something_else_of_its_run_is_one_sentence(tmp_path, change, sentence):
    folder = tiny_folder(tmp_path / "run")
    trainer(folder).run(stop_after(2))
    tensors, meta = folder.latest_checkpoint(pytest.fail)
    folder.write_checkpoint(meta.pop("step"), tensors, meta | change)
    with pytest.raises(ValueError, match=sentence):
        trainer(folder)


def test_the_seconds_of_a_resumed_run_go_on_from_those_of_its_checkpoint(tmp_path):
    folder = tiny_folder(tmp_path / "run")
    trainer(folder).run(stop_after(2))
    tensors, meta = folder.latest_checkpoint(pytest.fail)
    folder.write_checkpoint(meta.pop("step"), tensors, meta | {"elapsed_s": 1000.0})
    trainer(folder).run(lambda news: True)
    seconds = [row["time/elapsed_s"] for row in read_metrics(folder.metrics_path) if "time/elapsed_s" in row]
    assert [second >= 1000 for second in seconds] == [False, False, True, True, True, True]
    assert seconds[2] < 2000


def test_the_speed_is_that_of_all_seeds_together(tmp_path, monkeypatch):
    """Of 50 steps of two seeds each, in a second of learning and an hour of evaluation."""
    folder, now = tiny_folder(tmp_path / "run"), [0.0]
    run = trainer(folder)
    iterate, evaluate = run.learner.iterate, run._evaluate

    def pass_a_second(progress):
        now[0] += 1.0
        return iterate(progress)

    def pass_an_hour():
        now[0] += 3600.0
        return evaluate()

    run.learner.iterate, run._evaluate = pass_a_second, pass_an_hour
    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: now[0]))
    run.run(lambda news: True)
    rows = read_metrics(folder.metrics_path)[1:]
    assert [row["time/steps_per_second"] for row in rows] == [100.0] * 6
    assert [row["time/elapsed_s"] % 3600 for row in rows] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize("text", ["nan", "inf", "-1", "often", ""])
def test_a_wrong_number_of_seconds_between_checkpoints_is_one_sentence(monkeypatch, text):
    monkeypatch.setenv("ESP_CHECKPOINT_SECONDS", text)
    with pytest.raises(ValueError, match=f"^ESP_CHECKPOINT_SECONDS is '{text}'; set it to a number of seconds"):
        checkpoint_seconds()
    monkeypatch.setenv("ESP_CHECKPOINT_SECONDS", "0.5")
    assert checkpoint_seconds() == 0.5


def _newest(folder):
    return max((int(file.name[5:17]) for file in (folder / "checkpoints").glob("step-*")), default=0)


def _wait_for_steps(folder, steps):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        if _newest(folder) > steps:
            return
        time.sleep(0.01)
    raise AssertionError(f"no checkpoint within a minute: {said(folder)}")


def _go_on(folder):
    """Go on with a run in a fork that writes a checkpoint in every iteration; return its number."""

    def job():
        training.CHECKPOINT_SECONDS = training.CHECKPOINT_SPACING = 0
        app.app(["train", "--resume", str(folder)])

    return fork(job, folder)


def test_a_killed_process_is_resumed_bit_for_bit_and_a_second_one_is_refused(tmp_path):
    steps = 5000
    straight, killed = tiny_folder(tmp_path / "a", steps=steps), tiny_folder(tmp_path / "b", steps=steps)
    for _ in range(2):
        reached = _newest(killed.path)
        process = _go_on(killed.path)
        _wait_for_steps(killed.path, reached)
        os.kill(process, signal.SIGSTOP)  # it holds the run, and comes no further
        assert wait(_go_on(killed.path)) == 2
        assert f"{process}" in said(killed.path)
        assert "Traceback" not in said(killed.path)
        os.kill(process, signal.SIGKILL)
        assert wait(process) == -signal.SIGKILL
    assert trainer(killed).step < steps, "it was killed on the way"
    trainer(straight).run(lambda news: True)
    assert wait(_go_on(killed.path)) == 0, said(killed.path)
    assert same(final_state(straight)[0], final_state(RunFolder.open(killed.path))[0])
    assert untimed(straight) == untimed(killed)
