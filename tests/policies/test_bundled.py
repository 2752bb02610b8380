"""Bundled policies: every one does what its manifest says, and is found by name."""

import hashlib
import json
import math
import runpy
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from esp_cli.commands.counts import parse_count, parse_seeds
from esp_cli.commands.options import parse_assignments
from esp_cli.policies import bundled
from esp_cli.policies.bundled import MANIFEST, Entry, bundled_folder, find, read_bundled, standard_name
from esp_cli.policies.evaluation import best_seed, evaluate, play_batches, play_references
from esp_cli.policies.loading import open_policy
from esp_cli.policies.statistics import mean_and_sem, normalised
from esp_cli.training.build import PolicyController
from esp_cli.training.config import RunConfig, resolve_config, resolve_task_settings
from tests.export.policies import drawn_policy

ENTRIES = read_bundled()
bundle = runpy.run_path(str(Path(__file__).parents[2] / "docs" / "bundle_policy.py"))["bundle"]
EPISODES = {"formation": 8}
"""Episodes to judge a policy anew by, where fewer than 128 will do: they are long, and all alike."""


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
def test_a_policy_does_what_its_manifest_says(entry: Entry) -> None:
    file = bundled_folder() / entry.file
    assert hashlib.sha256(file.read_bytes()).hexdigest() == entry.sha256
    trained = open_policy(Path(entry.name))
    assert (trained.spec.version, trained.spec.convention) == (entry.task_version, entry.convention)
    controller = PolicyController(trained.policy)
    played = play_batches(trained.config, controller, "greedy", EPISODES.get(entry.task, 128))
    mean, sem = mean_and_sem(played.returns[0])
    # Four standard errors of the difference: these are the first of the manifest's own episodes, on which another
    # machine's rounding may let a few go otherwise.
    error = math.hypot(sem, entry.score.sem)
    assert abs(mean - entry.score.mean) < 4 * error
    assert entry.score.ci95[0] <= entry.score.mean <= entry.score.ci95[1]
    assert set(played.metrics) >= set(entry.metrics), "later versions may measure more"


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
def test_the_command_of_a_manifest_resolves_to_its_configuration(entry: Entry) -> None:
    config = RunConfig.model_validate(entry.config)
    words = shlex.split(entry.command)
    assert words[:2] == ["esp", "train"]
    options = list(zip(words[2::2], words[3::2], strict=True))
    given = dict(options)
    overrides = parse_assignments(value for name, value in options if name == "--set")
    overrides |= {
        {"--prior": "prior.kind", "--network": "network.name"}[n]: v
        for n, v in options
        if n in ("--prior", "--network")
    }
    resolved = resolve_config(
        given["--task"],
        given["--algo"],
        given.get("--preset", "default"),
        parse_count(given["--steps"]),
        parse_seeds(given["--seeds"]),
        given.get("--device", "cpu"),
        overrides,
    )
    later = resolve_task_settings(config.task, config.task_settings)  # settings that are newer have their default
    assert (config.init_from.source if config.init_from else None) == given.get("--init-from")
    assert resolved == config.model_copy(update={"task_settings": later, "init_from": None})
    assert config.command() == entry.command
    assert entry.seed in config.seeds
    assert len(config.seeds) == entry.chosen_from


def test_no_file_of_the_box_is_without_a_line_in_the_manifest() -> None:
    files = {file.name for file in bundled_folder().iterdir() if file.suffix != ".md"}
    assert files == {MANIFEST, *(entry.file for entry in ENTRIES)}
    assert all((bundled_folder() / name).stat().st_size < 512 * 1024 for name in files)


def test_the_box_is_beside_the_packages_or_in_the_wheel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert bundled_folder() == Path(__file__).parents[2] / "checkpoints"
    package = tmp_path / "site-packages" / "esp_cli"
    (package / "policies").mkdir(parents=True)
    monkeypatch.setattr(bundled, "__file__", str(package / "policies" / "bundled.py"))
    assert bundled_folder() == tmp_path / "site-packages" / "checkpoints"
    shutil.copytree(Path(__file__).parents[2] / "checkpoints", package / "checkpoints")
    assert bundled_folder() == package / "checkpoints"
    assert read_bundled() == ENTRIES


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drawn policies in a manifest: two of navigation, one with a name of its own, and one by another algorithm."""
    folder = tmp_path_factory.mktemp("bundled")
    for policy, name in (("exploring choice, recurrent", "maddpg-esp"), ("vector", "vectors")):
        bundle(drawn_policy(policy), f"navigation-{name}", folder, 4)
    bundle(drawn_policy("choice", seeds=(3, 7)), "navigation-mappo-esp", folder, 4)
    return folder


@pytest.fixture
def small(made: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of `made`, as that of this installation."""
    monkeypatch.setattr(bundled, "bundled_folder", lambda: made)
    return made


def test_what_is_put_in_is_found_and_plays_the_same(small: Path) -> None:
    entry = find("navigation")
    assert (entry.name, entry.file) == ("navigation-mappo-esp", "navigation-mappo-esp.safetensors")
    assert (entry.chosen_from, entry.score.episodes, entry.step) == (2, 4, 100)
    trained = open_policy(Path(entry.name))
    assert trained.config.seeds == (entry.seed,)
    found = evaluate(trained, 4)
    assert found.greedy.mean == pytest.approx(entry.score.mean)
    # the scale is that of seed 0, which is that of all policies of the task
    scale = play_references(trained.config.model_copy(update={"seeds": (0,)}), found.heuristics, 4)
    alike = {name: float(played.returns.mean()) for name, played in scale.items()}
    assert entry.normalised == pytest.approx(float(normalised(entry.score.mean, alike)), abs=1e-4)


def test_bundled_policies_of_one_task_are_ordered_by_their_scores_on_the_scale() -> None:
    kinds = {(e.task, e.convention, e.algorithm): [] for e in ENTRIES}
    for entry in ENTRIES:
        kinds[entry.task, entry.convention, entry.algorithm].append((entry.score.mean, entry.normalised))
    for pairs in kinds.values():
        assert [scaled for _, scaled in sorted(pairs)] == sorted(scaled for _, scaled in pairs)


def test_the_seed_is_the_one_that_did_best(tmp_path: Path) -> None:
    trained = drawn_policy("choice", seeds=(3, 7))
    best = best_seed(trained, 64)
    with_seed = {seed: evaluate(trained.single_seed(seed), 64).greedy.mean for seed in (3, 7)}
    assert best == max(with_seed, key=with_seed.__getitem__) == bundle(trained, "best", tmp_path, 64).seed


def test_a_seed_that_stopped_is_not_the_best_unless_all_did() -> None:
    trained = drawn_policy("choice", seeds=(3, 7))
    best = trained.config.seeds.index(best_seed(trained, 64))
    assert best_seed(replace(trained, stopped=(best,)), 64) == trained.config.seeds[1 - best]
    assert best_seed(replace(trained, stopped=(0, 1)), 64) == trained.config.seeds[best]


@pytest.mark.parametrize(
    ("asked", "name"),
    [
        (("navigation", None, None), "navigation-mappo-esp"),
        (("navigation", "maddpg", None), "navigation-maddpg-esp"),
        (("navigation", "mappo", "esp"), "navigation-mappo-esp"),
        (("navigation-vectors", None, None), "navigation-vectors"),
        (("navigation-vectors", "mappo", None), "navigation-vectors"),
    ],
)
def test_a_policy_is_found_by_task_algorithm_and_prior(small: Path, asked: tuple, name: str) -> None:
    assert find(*asked).name == name
    assert open_policy(Path(asked[0]), *asked[1:]).source.name == f"{name}.safetensors"


@pytest.mark.parametrize(
    ("asked", "sentence"),
    [
        (("navigation", "qmix", None), "no policy fits navigation --algo qmix; the bundled policies are navigation-"),
        (("navigation", None, "none"), "no policy fits navigation --prior none; the bundled policies are"),
        (("formation", None, None), "no policy fits formation; the bundled policies are navigation-"),
        (("nothing", "mappo", None), "--algo and --prior choose among a task's policies, but nothing is not a task"),
        (("nothing", None, None), "nothing does not exist"),
    ],
)
def test_what_is_not_there_is_told_in_one_sentence(small: Path, asked: tuple, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        open_policy(Path(asked[0]), *asked[1:])


def test_a_folder_of_the_name_goes_before_the_box(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("navigation").mkdir()
    with pytest.raises(ValueError, match="navigation is no run folder"):
        open_policy(Path("navigation"))
    assert open_policy(Path("navigation"), "mappo").source.parent == small


def test_an_entry_of_the_same_name_is_replaced(tmp_path: Path) -> None:
    first = bundle(drawn_policy("choice"), "own", tmp_path, 4)
    second = bundle(drawn_policy("choice", hidden=(5,)), "own", tmp_path, 4)
    assert first.sha256 != second.sha256
    assert read_bundled(tmp_path) == (second,)


@pytest.fixture
def changed(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder of `made`, to be changed, as that of this installation."""
    folder = Path(shutil.copytree(made, tmp_path / "bundled"))
    monkeypatch.setattr(bundled, "bundled_folder", lambda: folder)
    return folder


def test_a_file_that_is_not_the_manifests_is_refused(changed: Path) -> None:
    shutil.copy(changed / "navigation-vectors.safetensors", changed / "navigation-mappo-esp.safetensors")
    with pytest.raises(ValueError, match="is not the file that its manifest names: their SHA-256 differ"):
        open_policy(Path("navigation"))
    (changed / "navigation-mappo-esp.safetensors").unlink()
    with pytest.raises(ValueError, match="does not exist"):
        open_policy(Path("navigation"))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda m: m | {"version": 99}, "was written by a newer esp; update esp"),
        (lambda m: m | {"version": "1"}, "is foreign"),
        (lambda m: m | {"format": "other"}, "is foreign"),
        (lambda m: m | {"policies": {}}, "bad value for 'policies'"),
        (lambda m: m | {"policies": [{}]}, "the setting 'policies.0.name' is missing"),
        (lambda m: m | {"policies": m["policies"] * 2}, "names a policy twice"),
        (lambda m: m | {"policies": [m["policies"][0] | {"file": "../../etc/passwd"}]}, "'policies.0.file'"),
        (lambda m: m | {"policies": [m["policies"][0] | {"sha256": "0"}]}, "'policies.0.sha256'"),
        (lambda m: [m], "is no JSON object"),
    ],
)
def test_a_damaged_manifest_is_told_in_one_sentence(small: Path, tmp_path: Path, change, sentence: str) -> None:
    manifest = json.loads((small / MANIFEST).read_text())
    (tmp_path / MANIFEST).write_text(json.dumps(change(manifest)))
    with pytest.raises(ValueError, match=sentence) as caught:
        read_bundled(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_manifest_is_an_empty_box(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundled, "bundled_folder", lambda: tmp_path)
    assert read_bundled() == ()
    with pytest.raises(ValueError, match="no policy fits navigation; no policy is bundled"):
        find("navigation")


def test_a_policy_of_a_task_that_is_not_installed_gets_a_name_that_can_be_written() -> None:
    assert standard_name("mine.tasks:My_Task", "mappo", "none") == "mine-tasks-my-task-mappo-plain"
    assert standard_name("pkg._tasks:T", "mappo", "esp") == "pkg-tasks-t-mappo-esp"
    assert standard_name("navigation", "qmix", "esp") == "navigation-qmix-esp"


def test_the_scores_on_file_are_normalised() -> None:
    assert all(0.7 < entry.normalised < 3 for entry in read_bundled())
