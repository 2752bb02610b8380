"""What the pages on extending add works as they say: their code is run here, then used through the application."""

import re
import shutil
import sys
import textwrap
from pathlib import Path

import pytest

from esp_cli import load_policy
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.networks.build import NETWORKS
from esp_cli.training.metrics import column, read_metrics
from tests.cli.running import esp, refused

PAGES = Path(__file__).parents[2] / "docs"


@pytest.fixture(autouse=True)
def registries_as_before(monkeypatch):
    """Take what a test registers out again."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    for table in (ALGORITHMS, NETWORKS):
        monkeypatch.setattr(table, "_registered", {})
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name in ("reinforce", "skip"):
            del sys.modules[name]


@pytest.fixture
def saved(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(PAGES / "reinforce.py", tmp_path)
    text = (PAGES / "add-a-network.md").read_text(encoding="utf-8")
    name = re.search(r"Save this as `([\w.]+)`", text)[1]
    (code,) = re.findall(r"```python\n(.*?)```", text, re.S)
    (tmp_path / name).write_text(code, encoding="utf-8")


def test_the_page_on_algorithms_shows_what_stands_in_its_files():
    files = "".join((PAGES / name).read_text(encoding="utf-8") for name in ("reinforce.py", "masac.py"))
    page = (PAGES / "add-an-algorithm.md").read_text(encoding="utf-8")
    excerpts = re.findall(r"```python\n(.*?)```", page, re.S)
    assert len(excerpts) == 2
    for excerpt in excerpts:
        assert textwrap.indent(excerpt, " " * 8) in files


ALGO, NETWORK = ["--algo", "reinforce:Reinforce"], ["--network", "skip:SkipConfig"]
TINY = ["--set", "evaluation.episodes=4", "--set", "evaluation.every_steps=1000000"]


@pytest.mark.parametrize("prior", ["esp", "none"])
def test_the_algorithm_trains_resumes_is_evaluated_and_exported(saved, prior):
    esp("train", *ALGO, "--task", "navigation", "--prior", prior, "--seeds", 2, "--steps", "8k", *TINY, "--out", "run",
        "--set", "reinforce:Reinforce.learning_rate=1e-3")  # fmt: skip
    assert "after 8k steps" in esp("eval", "run", "--episodes", 4, *ALGO).stdout
    esp("export", "run", "-f", "numpy", "-o", "export", *ALGO)
    esp("train", "--resume", "run", *ALGO)


def test_the_algorithm_learns_and_the_prior_moves_it(saved):
    returns = {}
    for prior in ("esp", "none"):
        esp("train", *ALGO, "--task", "navigation", "--prior", prior, "--steps", "40k",
            "--set", "evaluation.episodes=64", "--set", "evaluation.every_steps=1000000", "--out", prior)  # fmt: skip
        returns[prior] = column(read_metrics(Path(prior) / "metrics.jsonl"), "eval/return_stochastic")[1].ravel()
    assert all(values[-1] > values[0] + 5 for values in returns.values()), returns
    assert returns["esp"][-1] != returns["none"][-1]


def test_the_network_trains_and_refuses_what_it_lacks(saved):
    options = ["train", "--task", "navigation", *NETWORK, "--steps", "1k", *TINY]
    esp(*options, "--set", "network.hidden=[16,16,16]", "--out", "run")
    assert "skip:SkipConfig" in Path("run/config.json").read_text()
    esp("eval", "run", "--episodes", 4, *NETWORK)
    assert "equal hidden widths" in refused(*options, "--set", "network.hidden=[16,8]", "--out", "no")
    assert "activation" in refused(*options, "--set", "network.activation=tanh", "--out", "no")


def test_a_folder_never_imports_an_algorithm_or_a_network(saved):
    own = [*ALGO, *NETWORK]
    esp("train", "--task", "navigation", "--steps", "800", *own, *TINY, "--out", "run")
    commands = {
        "eval": ["eval", "run", "--episodes", 4],
        "render": ["render", "run", "-o", "film.gif", "--size", 64],
        "export": ["export", "run", "-f", "numpy", "-o", "export"],
        "report": ["report", "run"],
        "check": ["check", "symmetry", "navigation", "--policy", "run", "--transforms", "rot90"],
        "resume": ["train", "--resume", "run"],
    }
    for table in (ALGORITHMS, NETWORKS):
        table._registered.clear()
    for command in commands.values():
        assert "the network 'skip:SkipConfig' is not installed; add --network skip:SkipConfig" in refused(*command)
    with pytest.raises(ValueError, match="add --network skip:SkipConfig"):
        load_policy("run")
    NETWORKS.register("skip:SkipConfig")
    for command in commands.values():
        assert "the algorithm 'reinforce:Reinforce' is not installed; add --algo" in refused(*command)
    NETWORKS._registered.clear()
    for name, command in commands.items():
        if name == "export":
            assert "skip" in refused(*command, *own).lower()  # it has no rule for this network
        else:
            esp(*command, *own)
        for table in (ALGORITHMS, NETWORKS):
            table._registered.clear()
    policy = load_policy("run", algo="reinforce:Reinforce", network="skip:SkipConfig")
    assert policy.act([[0.0] * policy.spec.observation.width]).shape == (1,)


@pytest.mark.slow
def test_a_study_trains_both_in_jobs_of_their_own(saved):
    esp("ablate", "prior", *ALGO, "--task", "navigation", "--set", "network.name=skip:SkipConfig", "--steps", "800",
        "--seeds", 1, "--episodes", 2, *TINY, "--jobs", 1, "--out", "study")  # fmt: skip
    table = esp("report", "study", *ALGO, *NETWORK, "--full").stdout
    assert "REINFORCE-ESP" in table


DISTRIBUTION = """[esp.algorithms]
theirs = reinforce:Reinforce
[esp.networks]
deep = skip:SkipConfig
"""


def test_an_installed_distribution_brings_both_under_names_of_its_own(saved, tmp_path, monkeypatch):
    place = tmp_path / "site"
    (place / "theirs-1.0.dist-info").mkdir(parents=True)
    (place / "theirs-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (place / "theirs-1.0.dist-info" / "entry_points.txt").write_text(DISTRIBUTION)
    for name in ("reinforce.py", "skip.py"):
        (tmp_path / name).rename(place / name)
    monkeypatch.syspath_prepend(str(place))
    esp("train", "--algo", "theirs", "--network", "deep", "--steps", "800", *TINY, "--out", "run")
    assert "after 800 steps" in esp("eval", "run", "--episodes", 4).stdout
    assert load_policy("run").spec.name == "navigation"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--algo", "no_such_module:A"], "cannot import the module 'no_such_module' of the algorithm: ModuleNotFound"),
        (["--algo", "skip:SkipConfig"], "'skip:SkipConfig' is not an algorithm; an algorithm is a subclass of"),
        (["--network", "skip:Skip"], "'skip:Skip' is not a network; a network is a subclass of"),
        (["--network", "skip:Other"], "the module 'skip' has no class 'Other'"),
        (["--algo", "esp_cli.algorithms.learner:Learner"], "lacks build, build_policy, iterate, steps_per_iteration"),
    ],
)
def test_what_is_no_algorithm_or_network_is_answered_by_a_sentence(saved, words, sentence):
    assert sentence in refused("train", *words, "--out", "no")
