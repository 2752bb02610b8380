"""The application as functions: the same numbers as the commands, metrics as arrays, stopping and going on."""

import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from esp_cli import Field, Kind, Progress, Run, Symmetry, discrete_moves, layout, load_policy, train
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.run import begin
from esp_cli.training.config import resolve_config
from esp_cli.training.metrics import Metrics, column, read_metrics
from tests.cli.running import esp

SMALL = {"mappo.num_envs": 4, "mappo.num_steps": 25, "evaluation.every_steps": 200, "evaluation.episodes": 2}
OPTIONS = [word for name, value in SMALL.items() for word in ("--set", f"{name}={value}")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a finished run of two seeds."""
    out = tmp_path_factory.mktemp("runs") / "cn"
    return train("navigation", steps=400, seeds=(3, 7), settings=SMALL, out=out)


def test_a_new_folder_has_a_name_that_is_no_host_of_a_copy_command(tmp_path: Path, monkeypatch) -> None:
    """`scp` and `rsync` read a:b as the path b on the host a."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(ALGORITHMS._registered, "mine:Learner", ALGORITHMS["mappo"])
    config = resolve_config("navigation", overrides=SMALL).model_copy(update={"algorithm": "mine:Learner"})
    begin(config, None, None)
    (made,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(r"navigation-mine-learner-esp-\d{8}-\d{6}", made.name)


def test_a_run_has_the_weights_of_the_command(run: Run, tmp_path: Path) -> None:
    words = ["train", "--task", "navigation", "--steps", "400", "--seed-list", "3,7", "--out", str(tmp_path / "cn")]
    esp(*words, *OPTIONS)
    obs = np.random.default_rng(0).standard_normal((20, 14))
    for seed in (3, 7):
        mine, theirs = load_policy(run.path, seed=seed), load_policy(tmp_path / "cn", seed=seed)
        for one, other in zip(
            mine.trained.policy.state_dict().values(), theirs.trained.policy.state_dict().values(), strict=True
        ):
            assert (one == other).all()
    assert np.array_equal(run.policy.act(obs), load_policy(run.path, seed=3).act(obs))
    assert run.is_complete


def test_metrics_are_arrays_of_updates_and_seeds(run: Run) -> None:
    metrics, rows = run.metrics, read_metrics(run.folder.metrics_path)
    assert metrics.steps.tolist() == [row["step"] for row in rows]
    assert metrics.seeds == (3, 7)
    returns = metrics["eval/return_greedy"]
    assert returns.shape == (len(rows), 2)
    measured = ~np.isnan(returns[:, 0])
    steps, values = column(rows, "eval/return_greedy")
    assert metrics.steps[measured].tolist() == steps.tolist()
    assert np.array_equal(returns[measured], values)
    assert metrics["time/steps_per_second"].shape == (len(rows), 1)
    assert set(metrics) == {name for row in rows for name in row} - {"step"}
    assert len(metrics) == len(set(metrics))


def test_a_stopped_seed_and_a_number_that_was_not_measured_are_nan() -> None:
    metrics = Metrics([{"step": 0, "a": [None, 2.0]}, {"step": 5, "b": None}], (0, 1))
    assert np.array_equal(metrics["a"], [[np.nan, 2], [np.nan, np.nan]], equal_nan=True)
    assert metrics["b"].shape == (2, 1)
    with pytest.raises(KeyError):
        _ = metrics["c"]


def test_metrics_become_a_table(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = pytest.importorskip("pandas", reason="needs pandas")
    table = run.metrics.to_pandas()
    assert list(table.index) == run.metrics.steps.tolist()
    assert np.array_equal(table["train/return", 7], run.metrics["train/return"][:, 1], equal_nan=True)
    assert ("time/elapsed_s", "run") in table.columns
    assert isinstance(table, pandas.DataFrame)
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(ValueError, match="to_pandas needs pandas, which is not installed"):
        run.metrics.to_pandas()


def test_a_listener_stops_a_run_and_training_goes_on_bit_for_bit(run: Run, tmp_path: Path) -> None:
    told: list[Progress] = []

    def listen(news: Progress) -> bool:
        told.append(news)
        return len(told) < 3

    stopped = train("navigation", steps=400, seeds=(3, 7), settings=SMALL, out=tmp_path / "cn", listener=listen)
    assert [news.step for news in told] == [0, 100, 200]
    assert not stopped.is_complete
    again = Run(stopped.path)
    assert again.train()
    assert again.is_complete
    assert again.train(), "nothing is left to do"
    assert np.array_equal(again.metrics["train/return"], run.metrics["train/return"], equal_nan=True)


def test_a_listener_that_says_nothing_stops_nothing(tmp_path: Path) -> None:
    told: list[int] = []
    assert train(
        "navigation", steps=np.int64(200), settings=SMALL, out=tmp_path / "cn", listener=lambda p: told.append(p.step)
    ).is_complete
    assert told == [0, 100, 200]


def test_a_listener_is_told_of_the_policy_that_a_run_starts_from(run: Run, tmp_path: Path) -> None:
    begun = shutil.copytree(run.path, tmp_path / "begun")
    for file in (begun / "checkpoints").iterdir():
        file.write_bytes(file.read_bytes()[:-5])
    told: list[Progress] = []
    later = tmp_path / "later"
    train(steps=100, seeds=(3, 7), settings=SMALL, listener=told.append, out=later, init_from=begun)
    assert any("taking" in note and "policy.safetensors" in note for note in told[0].notes)
    assert not any(news.notes for news in told[1:])


def test_a_run_is_evaluated_and_drawn_as_by_the_commands(run: Run, tmp_path: Path) -> None:
    result = run.evaluate(4)
    esp("eval", run.path, "--episodes", 4, "--json", tmp_path / "result.json")
    written = type(result).model_validate_json((tmp_path / "result.json").read_text())
    assert written.greedy == result.greedy
    assert run.evaluate(4, {"convention": "pettingzoo"}).convention != result.convention
    drawing = run.render(tmp_path / "cn.gif", episodes=1, size=64, view="top")
    assert drawing.path.read_bytes().startswith(b"GIF")
    assert drawing.steps == 25
    assert drawing.frames > 5


@pytest.mark.parametrize(
    ("ask", "sentence"),
    [
        (lambda run, file: run.evaluate(0), "episodes is 0; play at least one"),
        (lambda run, file: run.render(file, episodes=0), "episodes is 0; a film has at least one"),
        (lambda run, file: run.render(file, speed=-1), "speed is -1; give times real time, 0.01 or more"),
        (lambda run, file: run.render(file, speed=math.inf), "speed is inf; give times real time"),
        (lambda run, file: run.render(file, episodes=1, speed=1e-4), "speed is 0.0001; give times real time"),
        (lambda run, file: run.render(file, episodes=1, view="side"), "no view 'side'; choose auto, top, 3d"),
    ],
)
def test_what_cannot_be_played_or_drawn_is_refused(run: Run, tmp_path: Path, ask, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        ask(run, tmp_path / "cn.gif")


@pytest.mark.parametrize(
    ("choice", "sentence"),
    [
        ({"settings": {"mappo.lr": 1}}, "unknown setting 'mappo.lr'"),
        ({"seeds": 3}, r"not how many; write seeds=range\(3\)"),
        ({"seeds": np.int64(3)}, r"not how many; write seeds=range\(3\)"),
        ({"seeds": "01"}, r"seeds are whole numbers, not '01'; write for example seeds=range\(10\)"),
        ({"seeds": ["0"]}, r"seeds are whole numbers, not \['0'\]"),
        ({"seeds": None}, "seeds are whole numbers, not None"),
        ({"settings": {1: 2}}, r"settings are \{1: 2\}; give values by dotted name"),
        ({"settings": [("a", 1)]}, r"settings are \[\('a', 1\)\]; give values by dotted name"),
        ({"steps": "1k"}, "steps are a whole number, not '1k'"),
        ({"seeds": (-1,)}, "bad value -1 for 'run.seeds.0': input should be greater than or equal to 0"),
        ({"device": "cuda:1"}, "there is no device 'cuda:1'; choose cpu, cuda or auto"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_no_folder(choice, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence) as caught:
        train(**{"out": tmp_path / "run", **choice})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_what_is_not_a_run_is_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="nothing"):
        Run(tmp_path / "nothing")
    with pytest.raises(ValueError, match="exists: resume with"):
        train(out=run.path)
    with pytest.raises(ValueError, match="cannot write"):
        run.render(tmp_path / "film.txt")


def test_a_name_that_another_program_has_taken_is_left_to_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda _: "20261125-090121")
    taken = tmp_path / "runs/navigation-mappo-esp-20261125-090121"
    taken.mkdir(parents=True)
    run = train(steps=8, settings={"mappo.num_envs": 2, "task.horizon": 4, "evaluation.episodes": 1})
    assert run.path.name == f"{taken.name}-2"
    assert not [*taken.iterdir()]


def test_runs_metrics_policies_and_symmetries_say_what_they_are(run: Run) -> None:
    symmetry = Symmetry(observation=layout(Field("a<b", Kind.VECTOR)), action=discrete_moves(4), group="d4")
    for thing, *words in (
        (run, str(run.path), "mappo on navigation", "400 of 400", "eval/return_greedy"),
        (run.metrics, "rows: 5 of", "steps 0 to 400", "eval/return_greedy"),
        (run.policy, "mappo on navigation", "seed: 3", "choices"),
        (symmetry, "group: d4", "copies: draw"),
    ):
        shown, table = repr(thing), thing._repr_html_()
        assert "\n" not in shown
        assert all(word in shown for word in words), shown
        assert table.startswith(f"<table><caption>{type(thing).__name__}</caption><tr><th>")
        assert "a<b" not in table
        assert [row.count("<td>") for row in table.split("<tr>")[1:]] == [1] * (table.count("<tr>"))
