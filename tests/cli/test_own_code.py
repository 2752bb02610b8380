"""Code of the user that fails: one sentence that names the line, exit code 2, and nothing of the run lost."""

import sys
from pathlib import Path

import pytest

from esp_cli.app import report
from esp_envs import installed
from esp_envs.installed import raised_in
from esp_envs.registry import TASKS
from tests.cli.running import esp
from tests.own_tasks import save_page_files

SHORT = ["--steps", "200", "--set", "mappo.num_envs=4", "--set", "evaluation.episodes=2"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory of its own, whose modules are forgotten afterwards."""
    save_page_files(tmp_path)
    (tmp_path / "wrong.py").write_text(WRONG)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(TASKS, "_registered", {})
    monkeypatch.setattr(installed, "_FOREIGN", set())
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name in ("wrong", "rendezvous"):
            del sys.modules[name]


WRONG = """
import sys
from dataclasses import replace
import torch
from rendezvous import Rendezvous

class Raises(Rendezvous):
    steps = 0

    def _advance(self, world, action):
        Raises.steps += 1
        if Raises.steps > 130:
            raise KeyError("lost")
        return super()._advance(world, action)

class Looks(Rendezvous):
    def _advance(self, world, action):
        return [1, 2].index(3)

class Forgets(Rendezvous):
    def _advance(self, world, action):
        return {}["nothing"]

class Builds(Rendezvous):
    def __init__(self, *arguments):
        raise RuntimeError("no simulator here")

class Describes(Rendezvous):
    def _describe(self):
        return None

class Starts(Rendezvous):
    def _start(self, generator):
        return {"position": 1}

class StartsAlone(Rendezvous):
    def _start(self, generator):
        return super()._start(generator)["position"]

class PaysAlone(Rendezvous):
    def _advance(self, world, action):
        return super()._advance(world, action)[0]

class Counts(Rendezvous):
    def _advance(self, world, action):
        return super()._advance(world, action)[0], None

class Averages(Rendezvous):
    def _advance(self, world, action):
        return super()._advance(world, action)[0], {"spread": 0.5}

class Sees(Rendezvous):
    def _observe(self, world):
        return super()._observe(world), world

class Differs(Rendezvous):
    def _advance(self, world, action):
        reward, metrics = super()._advance(world, action)
        return reward.unsqueeze(-1) * torch.arange(3), metrics

class Leaves(Rendezvous):
    def _advance(self, world, action):
        sys.exit(0)

class Misspells(Rendezvous):
    def _describe(self):
        return replace(super()._describe(), totals=("spred",))

class Pays(Rendezvous):
    def _advance(self, world, action):
        reward, metrics = super()._advance(world, action)
        return reward[..., :1], metrics
"""


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Raises", "your code raises in '_advance' (wrong.py, line 13): KeyError: 'lost'"),
        ("Builds", "your code raises in '__init__' (wrong.py, line 26): RuntimeError: no simulator here"),
        ("Looks", "your code raises in '_advance' (wrong.py, line 18): ValueError: 3 is not in list"),
        ("Forgets", "your code raises in '_advance' (wrong.py, line 22): KeyError: 'nothing'"),
        ("Leaves", "your code raises in '_advance' (wrong.py, line 63): SystemExit: 0"),
        ("Misspells", "'_advance' of rendezvous gives no metric 'spred' in a whole episode, but 'totals' of its spec"),
        ("Describes", "'_describe' of Describes returns None; return a TaskSpec"),
        ("Starts", "'position' of what '_start' of rendezvous gives is no tensor; give tensors"),
        ("StartsAlone", "'_start' of rendezvous gives Tensor; give a dict of tensors by name"),
        ("PaysAlone", "'_advance' of rendezvous gives Tensor; return a tensor of rewards and a dict of metrics"),
        ("Counts", "'_advance' of rendezvous gives NoneType; give a dict of tensors by name"),
        ("Averages", "'spread' of what '_advance' of rendezvous gives is no tensor; give tensors"),
        ("Sees", "'_observe' of rendezvous gives tuple; return a tensor [S, E, N, D]"),
        ("Differs", "agents of rendezvous get different rewards, but its spec says that they share them"),
        ("Pays", "the reward that '_advance' of rendezvous gives has shape (1, 1, 3), expected"),
    ],
)
def test_a_task_that_fails_is_answered_by_one_sentence(folder, name, sentence):
    told = esp("train", "--task", f"wrong:{name}", *SHORT, "--out", "run", code=2).stderr
    assert sentence in told.splitlines()[-1]


def test_a_run_whose_task_raised_goes_on_from_its_checkpoint(folder, monkeypatch):
    """The task raises after 130 steps of all worlds; then, put right, it is trained to the end."""
    for name in ("CHECKPOINT_SECONDS", "CHECKPOINT_SPACING"):
        monkeypatch.setattr(f"esp_cli.training.trainer.{name}", 0.0)
    options = ["--set", "mappo.num_envs=4", "--set", "evaluation.episodes=2", "--set", "evaluation.every_steps=100"]
    options.append("--no-check")  # the look takes steps, too
    told = esp("train", "--task", "wrong:Raises", "--steps", 400, *options, "--out", "run", code=2).stderr
    assert "'lost'" in told.splitlines()[-1]
    kept = sorted(path.name for path in (folder / "run" / "checkpoints").glob("*.safetensors"))
    assert kept
    TASKS["wrong:Raises"].steps = -1000
    esp("train", "--resume", "run", "--task", "wrong:Raises")
    assert "after 400 steps" in esp("eval", "run", "--task", "wrong:Raises", "--episodes", 2).stdout


def test_a_training_begins_with_a_line_on_what_a_look_at_the_task_found_unless_it_is_left_out(folder):
    def looks(*words):
        lines = esp("train", "--task", "rendezvous:Rendezvous", *words).stderr.splitlines()
        return [line for line in lines if "esp check task" in line]

    assert looks(*SHORT, "--out", "run") == [
        "looked at rendezvous:Rendezvous: observations rewards and metrics fit the spec, the same seed gives the same "
        "run; 'esp check task rendezvous:Rendezvous' looks longer"
    ]
    assert looks(*SHORT, "--out", "unseen", "--no-check") == []
    (folder / "run" / "policy.safetensors").unlink()
    assert looks("--resume", "run") == [], "it goes on from a checkpoint"
    for file in [*(folder / "run" / "checkpoints").iterdir(), folder / "run" / "policy.safetensors"]:
        file.unlink()
    assert looks("--resume", "run", "--no-check") == []


def test_what_esp_itself_does_wrong_is_no_fault_of_the_users_code(monkeypatch):
    """Negative control: an error whose traceback has no line of the user's."""
    monkeypatch.setattr(installed, "_FOREIGN", {"mine"})  # tests of this process may have registered tasks of theirs
    for fail in (lambda: {}["nothing"], lambda: [1, 2].index(3)):
        with pytest.raises((KeyError, ValueError)) as caught:
            fail()
        assert raised_in(caught.value) is None
        assert report(caught.value) is None, "it keeps its traceback"
