"""What the pages on extending add works as they say: their code is run here, then used through the application."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from esp_cli import load_policy
from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.networks.build import NETWORKS
from esp_cli.prior import PriorConfig, SeedBatch, SymmetryPrior
from esp_cli.symmetry import Element, FiniteGroup, build_transform, parse, transform_set
from esp_cli.training.metrics import column, read_metrics
from esp_envs.spec import Continuous, Field, Kind, Spaces, layout
from tests.cli.running import esp, refused

PAGES = Path(__file__).parents[2] / "docs"


def code_of(page: str) -> ModuleType:
    """Run all Python blocks of a page, in one module, and return its names."""
    blocks = re.findall(r"```python\n(.*?)```", (PAGES / page).read_text(encoding="utf-8"), re.S)
    module = ModuleType(f"extending_{page.removesuffix('.md').replace('-', '_')}")
    sys.modules[module.__name__] = module  # dataclasses and pydantic look their module up
    for block in blocks:
        exec(compile(block, page, "exec"), module.__dict__)  # noqa: S102 - the page is part of the repository
    return module


@pytest.fixture(autouse=True)
def registries_as_before(monkeypatch):
    """Take what a test registers out again."""
    readers = parse.READERS.copy()
    monkeypatch.setattr(sys, "path", list(sys.path))
    for table in (ALGORITHMS, NETWORKS):
        monkeypatch.setattr(table, "_registered", {})
    before = set(sys.modules)
    yield
    parse.READERS[:] = readers
    for name in set(sys.modules) - before:
        if name in ("reinforce", "skip"):
            del sys.modules[name]


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """Save the file of each page where the page says, in the working directory."""
    monkeypatch.chdir(tmp_path)
    for page in ("add-an-algorithm.md", "add-a-network.md"):
        text = (PAGES / page).read_text(encoding="utf-8")
        name = re.search(r"Save this as `([\w.]+)`", text)[1]
        (code,) = re.findall(r"```python\n(.*?)```", text, re.S)
        (tmp_path / name).write_text(code, encoding="utf-8")


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
    table = esp("report", "study", *ALGO, *NETWORK).stdout
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


def test_an_unknown_algorithm_and_network_are_refused(tmp_path):
    """Negative control: without an entry point and without module:Class there is neither."""
    assert "unknown algorithm 'theirs'" in refused("train", "--algo", "theirs", "--out", tmp_path / "no")
    assert "unknown network 'deep'" in refused("train", "--network", "deep", "--out", tmp_path / "no")


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


def walker(kind: Kind) -> Spaces:
    return Spaces(
        num_agents=1,
        observation=layout(Field("speed", Kind.VECTOR), Field("knees", kind, 2)),
        state=layout(Field("knees", kind)),
        action=Continuous(layout(Field("torque", kind))),
        symmetry="legs",
    )


def test_the_symmetry_reaches_transforms_groups_and_the_prior():
    code = code_of("add-a-symmetry.md")
    spaces = walker(code.LEGS)
    transform = transform_set("legs", spaces).each()[0]
    assert transform.elements[0].name == "swap-legs"
    assert transform.obs(torch.tensor([[5.0, 6, 1, 2, 3, 4]])).tolist() == [[5, 6, 2, 1, 4, 3]]
    assert transform.pull_back(torch.tensor([[1.0, 2]])).tolist() == [[2, 1]]
    batch = SeedBatch(torch.randn(2, 3, 1, 1, 6), torch.randn(2, 3, 1, 2), torch.randn(2, 3, 1, 1, 2))
    prior = SymmetryPrior(PriorConfig(transforms="swap-legs"), spaces)
    assert torch.equal(prior.copies(batch, []).rows.state[:, 3:], batch.state.flip(-1))
    with pytest.raises(ValueError, match="rot90 is no symmetry of its dynamics and reward, which carry legs"):
        transform_set("rot90", spaces)
    with pytest.raises(ValueError, match="several kinds"):
        transform_set("rot90*swap-legs", spaces)


def test_without_its_line_the_symmetry_is_unknown():
    code = code_of("add-a-symmetry.md")
    parse.READERS.remove(code.read_legs)
    with pytest.raises(ValueError, match="unknown transform 'legs'"):
        transform_set("legs", walker(code.LEGS))


class SpaceTurn(Element):
    """A quarter turn in space: a signed permutation of the three axes with determinant 1."""

    permutation = None

    def __init__(self, matrix: np.ndarray) -> None:
        self.rows = tuple(map(tuple, np.rint(matrix).astype(int).tolist()))

    name = property(lambda self: f"turn{self.rows}")
    order = property(lambda self: (self.rows != ((1, 0, 0), (0, 1, 0), (0, 0, 1)), self.rows))
    in_place = property(lambda self: self)
    is_identity = property(lambda self: not self.order[0])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SpaceTurn) and self.rows == other.rows

    def __hash__(self) -> int:
        return hash(self.rows)

    def __matmul__(self, other: SpaceTurn) -> SpaceTurn:
        return SpaceTurn(np.array(self.rows) @ np.array(other.rows))

    def inverse(self) -> SpaceTurn:
        return SpaceTurn(np.array(self.rows).T)

    def block(self, field: Field) -> np.ndarray:
        return np.array(self.rows, dtype=float) if field.kind.width == 3 else np.eye(field.item_width)


def test_turns_in_space_need_no_more_than_an_element():
    about_z, about_x = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    cube = FiniteGroup.generated_by("cube", [SpaceTurn(about_z), SpaceTurn(about_x)])
    assert cube.order == 24
    assert cube.elements[0].is_identity
    space = Kind("vector3", 3, is_vector=True)
    row = layout(Field("position", space), Field("mass", Kind.SCALAR))
    spaces = Spaces(
        num_agents=1, observation=row, state=row, action=Continuous(layout(Field("force", space))), symmetry="c1"
    )
    (first,) = (build_transform([SpaceTurn(about_z)], spaces),)
    assert first.obs(torch.tensor([[1.0, 2, 3, 7]])).tolist() == [[-2, 1, 3, 7]]
    g, h = cube.elements[5], cube.elements[17]
    x = torch.tensor([[0.5, -1.0, 2.0, 1.0]])
    both = build_transform([g @ h], spaces).obs(x)
    assert torch.equal(both, build_transform([g], spaces).obs(build_transform([h], spaces).obs(x)))
