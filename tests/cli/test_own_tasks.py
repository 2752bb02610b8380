"""A task of one's own through the application, from training to a study, in processes that know nothing of it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from esp_cli import load_policy
from esp_cli.checking import ElementVerdict, SymmetryReport
from esp_cli.checking.verdicts import LATE, FieldVerdict
from esp_cli.commands.check import _print
from tests.forks import forked_esp
from tests.own_tasks import save_page_files

ROOT = Path(__file__).parents[2]
TASK = "rendezvous:Rendezvous"
SHORT = ["--steps", "200", "--set", "mappo.num_envs=4", "--set", "evaluation.episodes=2"]


def esp(folder: Path, *words: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the application as a user does, in a folder."""
    result = forked_esp(folder, *words)
    assert result.returncode == code, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    return result


def esp_anew(folder: Path, *words: str) -> None:
    """Run the application in a process that has to import everything."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "environments")])
    boot = "from esp_cli.app import main; main()"
    environment = os.environ | {"PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    subprocess.run([sys.executable, "-c", boot, *words], cwd=folder, env=environment, timeout=300, check=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory with the task and a finished run of it."""
    folder = tmp_path_factory.mktemp("own")
    save_page_files(folder)
    esp_anew(folder, "train", "--task", TASK, "--out", "run", *SHORT)
    return folder


def test_a_run_is_resumed_evaluated_drawn_exported_and_reported_with_its_task_named(folder: Path) -> None:
    own = ["--task", TASK]
    esp(folder, "train", "--resume", "run", *own)
    esp(folder, "eval", "run", "--episodes", "2", "--json", "result.json", *own)
    result = json.loads((folder / "result.json").read_text())
    assert result["heuristics"] == ["middle"]
    esp(folder, "render", "run", "-o", "film.gif", *own)
    esp(folder, "export", "run", "-f", "numpy", "-o", "exported", *own)
    esp(folder, "report", "run", *own)
    assert (folder / "film.gif").stat().st_size > 0


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--resume", "run"],
        ["eval", "run"],
        ["render", "run", "-o", "f.gif"],
        ["export", "run", "-f", "numpy", "-o", "e"],
        ["report", "run"],
    ],
    ids=lambda words: words[0],
)
def test_a_run_alone_imports_nothing_and_says_what_to_add(folder: Path, words: list[str]) -> None:
    result = esp(folder, *words, code=2)
    assert f"the task '{TASK}' is not installed; add --task {TASK} to let esp import and run it" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    "words",
    [
        ["eval", "navigation"],
        ["render", "navigation", "-o", "f.gif"],
        ["export", "navigation", "-f", "numpy", "-o", "e"],
        ["report", "plain"],
        ["discover", "plain"],
        ["train", "--resume", "plain"],
    ],
    ids=lambda words: words[0],
)
def test_a_task_that_nothing_given_has_is_refused(folder: Path, words: list[str]) -> None:
    if not (folder / "plain").exists():
        esp(folder, "train", "--out", "plain", "--network", "mlp", *SHORT)
    told = esp(folder, *words, "--task", TASK, code=2).stderr
    assert f"error: --task {TASK} changes nothing here, where the task is navigation; leave it out" in told


def test_a_network_without_a_policy_to_check_is_refused(folder: Path) -> None:
    network = "esp_cli.networks.sets:SetConfig"
    told = esp(folder, "check", "symmetry", TASK, "--network", network, code=2).stderr
    assert f"error: --network {network} changes nothing here; leave it out" in told


def test_a_program_loads_such_a_policy_by_naming_its_task(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from esp_envs import registry

    monkeypatch.chdir(folder)
    monkeypatch.setattr(registry.TASKS, "_registered", {})
    with pytest.raises(ValueError, match="add --task rendezvous:Rendezvous"):
        load_policy(folder / "run")
    policy = load_policy(folder / "run", task=TASK)
    assert policy.spec.name == "rendezvous"


def test_a_task_without_heuristics_is_evaluated_beside_the_random_policy_alone(folder: Path) -> None:
    source = (folder / "rendezvous.py").read_text()
    (folder / "bare.py").write_text(
        source.replace('    heuristics = ("middle",)\n', "")
        .replace("def heuristic(", "def h(")
        .replace("def scene(", "def s(")
    )
    told = esp(folder, "train", "--task", "bare:Rendezvous", "--out", "bare-run", *SHORT)
    assert "next: esp eval bare-run --task bare:Rendezvous\n" in told.stderr, (
        "what cannot be drawn is not to be rendered"
    )
    shown = esp(folder, "eval", "bare-run", "--episodes", "2", "--task", "bare:Rendezvous").stdout
    assert "random" in shown
    assert "heuristic" not in shown


def test_a_study_hands_the_task_to_its_workers(folder: Path) -> None:
    words = f"ablate modules --task {TASK} --algo mappo --seeds 1 --out study --episodes 2".split()
    assert f"next: esp report study --task {TASK}\n" in esp(folder, *words, *SHORT).stderr
    assert "found nothing" not in esp(folder, "report", "study", "--task", TASK).stdout
    chart = (folder / "study" / "report" / "curves.svg").read_text(encoding="utf-8")
    assert "<!-- Rendezvous, MAPPO, 200 -->" in chart, "a chart is titled by the class; letters are shapes there"
    assert esp(folder, "report", "study", code=2).stderr.count("add --task") == 1


def test_check_says_whether_a_task_is_what_it_claims(folder: Path) -> None:
    assert "broken" not in esp(folder, "check", "task", TASK).stdout
    source = (folder / "rendezvous.py").read_text()
    windy = source.replace("+ 0.1 * action", "+ 0.1 * action + torch.tensor([0.05, 0.0])")
    (folder / "windy.py").write_text(windy)
    shown = esp(folder, "check", "symmetry", "windy:Rendezvous", "--json", "windy.json", code=1).stdout
    assert "declared o2*agents, found flip-x*agents" in shown
    report = json.loads((folder / "windy.json").read_text())
    assert report["holds"] is False
    held = {e["element"]: e for e in report["report"]["elements"]}
    broken = {f["field"] for f in held["rot90"]["fields"] if f["outcome"] == "broken"}
    assert broken == {"state.position"}, "the others drift along, and so does the reward"
    assert esp(folder, "check", "symmetry", "windy:Rendezvous", "--transforms", "flip-x").returncode == 0


def test_settings_and_reports_of_what_is_not_installed(folder: Path) -> None:
    assert "num_agents" in esp(folder, "settings", TASK).stdout
    (folder / "learners.py").write_text(
        "from esp_cli.algorithms.mappo import Mappo\nfrom esp_cli.networks.plain import MlpConfig\n"
        "class Own(Mappo):\n    pass\nclass OwnNetwork(MlpConfig):\n    pass\n"
    )
    assert "learners:Own.learning_rate" in esp(folder, "settings", "learners:Own", "--json", "-").stdout
    listed = esp(folder, "settings", "learners:OwnNetwork", "--json", "-").stdout
    assert "network.hidden" in listed
    assert "network.name" not in listed
    (folder / "mine").mkdir()
    (folder / "mine" / "learners.py").write_text(
        "from esp_cli.algorithms.learner import Learner\nfrom learners import Own\nclass Half(Learner):\n    pass\n"
    )
    shown = esp(folder, "settings", "mine.learners:Own").stdout
    assert "--set mine.learners:Own.NAME=VALUE" in shown
    assert "learners:Own." not in shown.replace("learners:Own.NAME", "")
    assert "the algorithm 'mine.learners:Half' lacks" in esp(folder, "settings", "mine.learners:Half", code=2).stderr
    assert "cannot import the module 'learners.x'" in esp(folder, "settings", "learners.x:Own", code=2).stderr
    assert "'rendezvous:RendezvousSettings' is no task, algorithm or network" in (
        esp(folder, "settings", "rendezvous:RendezvousSettings", code=2).stderr
    )
    shown = esp(folder, "report", "a=run", "b=run", "--task", TASK, "--full").stdout
    assert f"esp report a=run b=run --task {TASK}" in " ".join(shown.split())


def test_check_says_where_a_task_raises_and_what_symmetry_is_none(folder: Path) -> None:
    source = (folder / "rendezvous.py").read_text()
    (folder / "slips.py").write_text(source.replace("return -distance.mean(-1)", "return -distanse.mean(-1)"))
    found = json.loads(esp(folder, "check", "task", "slips:Rendezvous", "--json", "-", code=1).stdout)
    slips = [f["broken"] for f in found if "NameError: name 'distanse' is not defined" in str(f["broken"])]
    assert len(slips) == 1, "told once"
    assert "in '_advance' (slips.py" in slips[0]
    assert any(f["not_asked"] == "it fails in the same way" for f in found)
    (folder / "noname.py").write_text(source.replace('"o2*agents"', '"dihedral"'))
    found = json.loads(esp(folder, "check", "task", "noname:Rendezvous", "--json", "-", code=1).stdout)
    assert [f["promise"] for f in found if f["broken"]] == ["actions and layouts can carry the declared symmetry"]
    assert "unknown transform 'dihedral'" in found[0]["broken"]


def test_a_task_is_trained_with_the_symmetry_that_it_declares(folder: Path) -> None:
    source = (folder / "rendezvous.py").read_text()
    (folder / "mirrored.py").write_text(source.replace('"o2*agents"', '"flip-x"'))
    told = esp(folder, "train", "--task", "mirrored:Rendezvous", *SHORT, "--out", "mirrored").stderr
    assert "prior esp (flip-x, c = 0.1)" in told
    told = esp(folder, "train", "--task", "mirrored:Rendezvous", *SHORT, "--prior", "auto", "--out", "weighed").stderr
    assert "prior esp (d4, c = 0.1)" in told


def test_check_measures_a_policy_too(folder: Path) -> None:
    words = ["check", "symmetry", TASK, "--transforms", "rot90,flip-x", "--policy", "run", "--json", "-"]
    result = json.loads(esp(folder, *words).stdout)
    assert [m["element"] for m in result["policy"]] == ["rot90", "flip-x"]
    assert all(0 <= m["agreement"] <= 1 for m in result["policy"])


def test_what_was_not_tried_is_not_said_to_have_shown_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    late = ElementVerdict("rot90", True, (), LATE)
    blind = ElementVerdict("flip-x", True, (FieldVerdict("reward", "not covered", 0, 0),))
    _print(SymmetryReport("calm", "paired states", "d4", "c1", "", (late, blind), {}), [])
    assert "declared, but not covered: flip-x; what was seen could not" in " ".join(capsys.readouterr().err.split())


def test_nothing_to_try_is_no_fault_of_a_task_that_declares_nothing(folder: Path) -> None:
    (folder / "speedy.py").write_text(
        "import torch\n"
        "from esp_envs import BatchedTask, Discrete, Field, Kind, TaskSpec, layout\n"
        "class Speedy(BatchedTask):\n"
        "    def _describe(self):\n"
        "        act = Discrete(Kind.SCALAR, ((0.0,), (1.0,)), ('stay', 'push'))\n"
        "        seen = layout(Field('speed', Kind.SCALAR))\n"
        "        return TaskSpec(name='speedy', version=1, convention='speed', horizon=5, num_agents=1,\n"
        "            observation=seen, action=act, state=seen, symmetry='c1')\n"
        "    def _start(self, generator):\n"
        "        return {'speed': self.draw(1, 1, generator=generator)}\n"
        "    def _advance(self, world, action):\n"
        "        world['speed'] = world['speed'] + action.unsqueeze(-1)\n"
        "        return world['speed'].mean((-1, -2)), {}\n"
        "    def _observe(self, world):\n"
        "        return world['speed']\n"
    )
    shown = esp(folder, "check", "symmetry", "speedy:Speedy", "--json", "-")
    assert json.loads(shown.stdout) == {"report": None, "holds": True, "policy": []}
    assert "declares no symmetry either" in esp(folder, "check", "symmetry", "speedy:Speedy").stdout
    asked = esp(folder, "check", "symmetry", "speedy:Speedy", "--transforms", "flip-x", code=2)
    assert "no transform can be tried on speedy" in asked.stderr


def test_check_refuses_what_it_does_not_take(folder: Path) -> None:
    for words in (["--transforms", "d4"], ["--policy", "run"], ["--network", "mine:Network"]):
        told = esp(folder, "check", "task", "navigation", *words, code=2).stderr
        assert "belong to 'esp check symmetry'" in told
