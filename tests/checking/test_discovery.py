"""Symmetries that nobody declared: found in tasks and in logs, and none found where there is none."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from esp_cli.checking import (
    SymmetryReport,
    Transitions,
    check_recorded,
    check_symmetry,
    check_transitions,
    collect,
    measured,
    named,
)
from esp_cli.checking.comparison import state_by_state
from esp_cli.checking.measured import prepared
from esp_cli.checking.recorded import read_transitions
from esp_cli.checking.verdicts import LATE, ElementVerdict, FieldVerdict, Late, concluded, verdicts_of
from esp_cli.symmetry import Element, parse_elements, transform_set
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs import make
from tests.cli.running import esp, refused

FORCES = {"actions": "continuous"}
ROBOTS = {"horizon": 40, "num_agents": 4, "num_obstacles": 2}
NOTHING = {"wind": 0.3, "action_turn_rad": 0.5, "num_agents": 1, "num_landmarks": 1}
DRONES = {"width": 5, "height": 5, "horizon": 30}
FOUND = [
    ("navigation", {}, "d4*agents*landmarks-3"),
    ("navigation", FORCES, "o2*agents*landmarks-3"),
    ("navigation", {"wind": 0.3, **FORCES}, "flip-x*agents*landmarks-3"),
    ("navigation", NOTHING, "c1"),
    ("predator-prey", {}, "d4*agents*obstacles-2"),
    ("predator-prey", {"control": "prey", **FORCES}, "d4*obstacles-2"),
    ("wildlife", DRONES, "d4*agents"),
    ("formation", ROBOTS, "d4*agents"),
]


def discovered(task: str, settings, transforms: str | None = None, logs_alone: bool = False):
    """Discover in a task whose declaration says that there is nothing."""

    def worlds(num_envs, seeds):
        env = make(task, num_envs, seeds, settings)
        env.spec = replace(env.spec, symmetry="c1", nearly="")
        return env

    return check_symmetry(worlds, transforms, logs_alone)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "settings", "group"), FOUND, ids=str)
def test_what_is_there_is_found_without_a_declaration(task, settings, group) -> None:
    robots = "d4,agents-1-0-2-3,agents-0-2-1-3,agents-0-1-3-2" if task == "formation" else None
    found = discovered(task, settings, robots)
    assert (found.method, found.found) == ("paired states", group)
    assert bool(found.transforms) == (group != "c1")
    if found.transforms:
        assert transform_set(found.transforms, make(task, 1, [0], settings).spec).names


@pytest.mark.slow
@pytest.mark.parametrize(("task", "settings", "group"), FOUND[3:5], ids=str)
def test_logs_alone_show_the_same(task, settings, group) -> None:
    found = discovered(task, settings, logs_alone=True)
    assert (found.method, found.found) == ("transitions", group)


@pytest.mark.slow
def test_logs_alone_show_the_quarter_turns_of_all_and_cover_only_some_of_the_others() -> None:
    tried = "d8,agents-1-0-2,agents-0-2-1,agents-2-1-0,landmarks-1-0-2,landmarks-0-2-1,landmarks-2-1-0"
    found = discovered("navigation", FORCES, tried, logs_alone=True)
    outcomes = {one.element: one.outcome for one in found.elements}
    assert (found.method, found.found) == ("transitions", "d4*agents*landmarks-3")
    assert outcomes["rot45"] == "holds"
    assert "not covered" in outcomes.values()
    assert "broken" not in outcomes.values(), "all of o2 holds"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "settings", "left"),
    [("navigation", {"mud": 0.5}, "flip-x"), ("predator-prey", {"wind": 0.2}, "flip-x")],
    ids=str,
)
def test_transitions_accept_nothing_that_is_broken(task, settings, left) -> None:
    env = make(task, 256, [0], settings)
    verdicts = check_transitions(env.spec, collect(env, 1024), parse_elements("d4", 1))
    outcomes = {verdict.element: verdict.outcome for verdict in verdicts}
    assert outcomes.pop(left) != "broken"
    assert "holds" not in outcomes.values()


def test_a_policy_that_prefers_a_direction_accuses_no_symmetric_task() -> None:
    env = make("navigation", 256, [0])
    rows = [env.reset()]
    prefers = torch.tensor([0.1, 0.1, 0.5, 0.1, 0.2])  # mostly to the right
    actions, rewards = [], []
    g = torch.Generator().manual_seed(0)
    for _ in range(8):
        action = torch.multinomial(prefers, 256 * 3, replacement=True, generator=g).view(1, 256, 3)
        step = env.step(action)
        actions.append(action[0])
        rewards.append(step.reward[0])
        rows.append(step.next)
    obs = torch.stack([row.obs[0] for row in rows], 1)
    biased = Transitions(obs[:, :-1], torch.stack(actions, 1), torch.stack(rewards, 1), obs[:, 1:])
    verdicts = check_transitions(env.spec, biased, parse_elements("rot90,rot180,flip-x,flip-y", 3))
    assert "broken" not in {verdict.outcome for verdict in verdicts}


@pytest.mark.parametrize(
    ("accepted", "group", "transforms"),
    [
        ("d4", "d4", "d4"),
        ("rot90,rot180,rot270", "c4", "c4"),
        ("rot180,flip-x", "flip-x", "flip-x"),
        ("rot90", "c1", ""),
        ("flip-diagonal", "flip-diagonal", "flip-diagonal"),
        ("rot180,flip-diagonal,flip-antidiagonal", "rot180,flip-diagonal,flip-antidiagonal", None),
        ("d16,rot57,flip23", "o2", "o2"),
        ("c16,rot57", "so2", "so2"),
        ("rot45,rot57,flip23", "c1", ""),
        ("d4,rot57", "d4", "d4"),
        ("d4,agents-1-0-2,agents-0-2-1,agents-2-1-0", "d4*agents", "d4*agents"),
        ("flip-x,agents-1-0-2", "flip-x and agents-1-0-2", "flip-x,agents-1-0-2"),
        ("d4,marks-1-0-2,marks-0-2-1", "d4*marks-3", "d4*marks-3"),
        ("d4,marks-1-0-2,agents-0-2-1", "d4 and agents-0-2-1,marks-1-0-2", "d4,agents-0-2-1,marks-1-0-2"),
        ("d16,rot57,flip23,marks-1-0-2", "o2 and marks-1-0-2", "o2"),
        ("marks-1-0-2,marks-0-2-1", "c1*marks-3", "marks-3"),
        ("agents-1-0-2,agents-2-1-0", "c1 and agents-1-0-2,agents-2-1-0", "agents-1-0-2,agents-2-1-0"),
        (
            "rot180,flip45,flip135,agents-1-0-2,agents-0-2-1,agents-2-1-0",
            "rot180,flip-diagonal,flip-antidiagonal and agents",
            "rot180,flip-diagonal,flip-antidiagonal,agents",
        ),
    ],
)
def test_accepted_elements_close_to_the_largest_group(accepted: str, group: str, transforms: str | None) -> None:
    tried = parse_elements("d16,rot57,flip23,agents-1-0-2,agents-0-2-1,agents-2-1-0,marks-1-0-2,marks-0-2-1", 3)
    name, text = named(parse_elements(accepted, 3), tried)
    assert name == group
    expected = group if transforms is None else transforms
    assert text == (f"discovered:{expected}" if expected else "")
    if expected:
        parse_elements(expected, 3)


def test_what_is_found_is_complete_in_whatever_order_fields_stand() -> None:
    found = parse_elements("d4,obstacles-1-0,marks-1-0,agents-1-0", 2)
    whole = "d4*agents*marks-2*obstacles-2"
    assert named(found, found) == (whole, f"discovered:{whole}")


@cache
def windy() -> dict[str, np.ndarray]:
    data = collect(make("navigation", 128, [0], {"actions": "continuous", "wind": 0.3}), 1536)
    return {name: getattr(data, name).numpy() for name in ("obs", "action", "reward", "next_obs")}


def recorded(folder: Path, **changes: object) -> Path:
    arrays = windy() | changes
    path = folder / "transitions.npz"
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def test_a_file_of_transitions_is_judged_and_what_is_found_can_be_trained_with(tmp_path: Path) -> None:
    path, out = recorded(tmp_path), tmp_path / "found.json"
    tried = "d4,rot45,agents-1-0-2,agents-0-2-1,landmarks-1-0-2,landmarks-0-2-1"
    options = ("--set", "task.actions=continuous", "--transforms", tried, "--json", out)
    shown = esp("discover", path, "--task", "navigation", *options)
    assert "found flip-x*agents" in shown.stdout
    assert "--transforms discovered:flip-x*agents" in shown.stderr
    told = json.loads(out.read_text())
    assert told["group"] == "flip-x*agents*landmarks-3"
    assert told["transforms"] == "discovered:flip-x*agents*landmarks-3"
    spec = make("navigation", 1, [0], FORCES).spec
    data = read_transitions(path, spec)
    flat = Transitions(*(part.flatten(0, 1).unsqueeze(1) for part in vars(data).values() if part is not None))
    assert check_recorded("rows", spec, flat, "rot90,flip-x").found == "flip-x"
    late = check_recorded("rows", spec, flat, "rot90,flip-x", seconds=0).elements
    assert {element.outcome for element in late} == {"not covered"}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"obs": None}, "has no array obs"),
        ({"reward": np.zeros((1536, 8, 2))}, "'reward' of"),
        ({"action": np.zeros((1536, 8, 3, 2), dtype=complex)}, "holds complex128"),
        ({"reward": np.full((1536, 8, 3), np.nan)}, "not finite"),
        ({"reward": np.zeros((100, 8, 3))}, "'reward' of the transitions has shape [100, 8, 3]"),
        ({"obs": np.array([{}], dtype=object)}, "not an intact .npz file"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(tmp_path: Path, changes, sentence: str) -> None:
    path = recorded(tmp_path, **changes)
    said = refused("discover", path, "--task", "navigation", "--set", "task.actions=continuous")
    assert sentence in said


def test_what_is_no_file_run_or_task_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    junk = tmp_path / "junk.npz"
    junk.write_bytes(b"PK\x03\x04 no archive")
    assert "is not an intact .npz file" in refused("discover", junk, "--task", "navigation")
    assert "does not say what its numbers are; add --task" in refused("discover", recorded(tmp_path))
    navigation = ("--task", "navigation")
    for task in ((), navigation):
        assert "there is no file" in refused("discover", tmp_path / "none.npz", *task)
    forces = ("--set", "task.actions=continuous")
    assert "'obs' of" in refused("discover", recorded(tmp_path, obs=np.zeros(64)), *navigation, *forces)
    scalar = recorded(tmp_path, action=np.zeros((1536, 8, 3), int), action_mask=np.array(True))
    assert "'action_mask' of" in refused("discover", scalar, *navigation)
    nothing = {"obs": (1536, 0, 3, 14), "next_obs": (1536, 0, 3, 14), "action": (1536, 0, 3), "reward": (1536, 0, 3)}
    empty = {name: np.zeros(shape, int if name == "action" else float) for name, shape in nothing.items()}
    assert "'obs' of the transitions has shape [1536, 0, 3, 14]" in refused(
        "discover", recorded(tmp_path, **empty), *navigation
    )
    assert "unknown task 'nowhere'" in refused("discover", "nowhere")
    assert "there is no navigation; leave it out" in refused("discover", "navigation", "--task", "navigation")
    assert "is no run folder" in refused("discover", tmp_path, "--task", "navigation")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "navigation").mkdir()
    assert "unknown setting 'task.nothing'" in refused("discover", "navigation", "--set", "task.nothing=1")
    assert "leave --logs out" in refused("discover", recorded(tmp_path), "--logs", *navigation)


def test_what_breaks_only_the_mask_of_actions_is_broken() -> None:
    env = make("navigation", 64, [0])
    plain = collect(env, 1024, 2)
    mask = torch.ones(*plain.action.shape, 5, dtype=torch.bool)
    mask[..., 2] = plain.obs[..., 0] > 0  # one action, in one half of the plane
    verdicts = [
        check_transitions(env.spec, data, parse_elements("rot90", env.spec))[0]
        for data in (plain, replace(plain, action_mask=mask))
    ]
    assert verdicts[0].outcome != "broken"
    assert {field.field for field in verdicts[1].fields if field.outcome == "broken"} == {"action mask"}


def test_one_number_that_is_not_finite_hides_no_gap() -> None:
    x = torch.randn(500, 1, generator=torch.Generator().manual_seed(0))
    hole = x.clone()
    hole[7] = torch.nan
    found = state_by_state("reward", *({"reward": side} for side in (hole, x, x + 3, hole)))
    assert (found.outcome, found.gap > 1) == ("broken", True)


@pytest.fixture
def _measured_anew():
    measured._breaking.cache_clear()
    yield
    measured._breaking.cache_clear()


@pytest.mark.usefixtures("_measured_anew")
@pytest.mark.parametrize(("method", "weight"), [("paired states", 0.0408), ("transitions", 0.0)])
def test_what_is_broken_weighs_little_and_what_nobody_knows_nothing(method, weight, monkeypatch):
    """Off by 0.4: exp(-8 x 0.4). Transitions show less of a breaking than there is, and a field may hide more."""
    off = (FieldVerdict("reward", "broken", 0.4, 0.01), FieldVerdict("obs.velocity", "broken", 0.1, 0.01))
    unseen = (FieldVerdict("reward", "not covered", 0.0, 0.01), FieldVerdict("obs.velocity", "holds", 0.0, 0.01, 0.0))
    held = FieldVerdict("reward", "holds", 0.1, 0.001, 0.0)
    fields = {"rot90": off, "rot180": (held,), "rot270": unseen, "flip-x": (), "flip-y": (off[1], unseen[0])}
    verdicts = [ElementVerdict(name, False, found) for name, found in fields.items()]
    monkeypatch.setattr(measured, "judged", lambda *_: (method, verdicts))
    config = resolve_config("navigation", overrides={"prior.kind": "auto", "prior.transforms": ",".join(fields)})
    weights = {"rot90": pytest.approx(weight, abs=5e-5), "rot180": 1.0, "rot270": 0.0, "flip-x": 0.0, "flip-y": 0.0}
    assert prepared(config).prior.weights == weights


def test_the_p_value_of_an_element_by_hand() -> None:
    unsure, sure = concluded("reward", 0.05, 0.05, False, 0.06), concluded("obs.velocity", 0.0, 0.01, False, 1e-9)
    assert [unsure.outcome, sure.outcome] == ["not covered", "holds"], "one of twenty may be accepted falsely, not more"
    verdict = ElementVerdict("a", False, (unsure, sure))
    assert (verdict.outcome, verdict.p_value, verdict.worst) == ("not covered", 1.0, unsure)
    broken = concluded("end", 0.2, 0.01, True, 0.0)
    assert ElementVerdict("a", False, (unsure, sure, broken)).worst == broken
    assert concluded("reward", np.nan, 0.01, False, np.nan).outcome == "not covered"


def test_agents_that_were_never_exchanged_are_not_claimed() -> None:
    """Agent 3 of four is in no exchange that was tried."""
    tried = parse_elements("agents-1-0-2-3,agents-0-2-1-3,agents-2-1-0-3", 4)
    assert named(tried, tried)[1] == "discovered:agents-1-0-2-3,agents-0-2-1-3,agents-2-1-0-3"


def test_training_takes_what_it_discovers_and_a_run_is_looked_at_with_its_settings(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    esp("train", "--task", "navigation", "--set", "task.wind=0.3", "--transforms", "discovered", "--steps", "50",
        "--set", "mappo.num_envs=2", "--out", folder)  # fmt: skip
    assert (
        json.loads((folder / "config.json").read_text())["prior"]["transforms"]
        == "discovered:flip-x*agents*landmarks-3"
    )
    assert "found flip-x*agents*landmarks-3" in esp("discover", folder).stdout
    assert "--task wildlife changes nothing here, where the task is navigation" in refused(
        "discover", folder, "--task", "wildlife"
    )
    esp("train", "--resume", folder)


def test_what_is_discovered_needs_no_declaration_and_other_transforms_do() -> None:
    found = resolve_config("navigation", overrides={"prior.transforms": "discovered:flip-x"})
    learner = build_learner(found)
    assert learner.prior.transforms.names == ("flip-x",)
    weighed = {
        "prior.transforms": "rot90",
        "task.wind": 0.3,
        "prior.trust": "measured",
        "prior.weights": {"rot90": 0.5},
    }
    assert build_learner(resolve_config("navigation", overrides=weighed)).prior.transforms.names == ("rot90",)
    with pytest.raises(ValueError, match="45 degrees"):
        build_learner(resolve_config("navigation", overrides={"prior.transforms": "discovered:rot45"}))


@pytest.mark.parametrize(("declared", "trust"), [("d4*agents", "full"), ("c1", "measured")])
def test_what_holds_and_nobody_declared_is_planned_as_measured(declared, trust, monkeypatch) -> None:
    spec = replace(make("navigation", 1, [0]).spec, symmetry=declared, nearly="")
    monkeypatch.setattr(measured, "_maker", lambda task: lambda num_envs, seeds: SimpleNamespace(spec=spec))
    weights = dict.fromkeys(("rot90", "rot180"), 1.0)
    config = resolve_config("navigation", overrides={"prior.kind": "auto", "prior.weights": weights})
    assert measured.planned(config).prior.trust == trust


def test_a_task_is_searched_once_however_many_runs_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def found(make_worlds):
        asked.append(make_worlds)
        return SymmetryReport("navigation", "paired states", "d4", "c4", "discovered:c4", (), ())

    measured._discovered.cache_clear()
    monkeypatch.setattr(measured, "check_symmetry", found)
    choices = {"prior.transforms": "discovered"}
    for changed in ({}, {"mappo.learning_rate": 0.01}, {"task.horizon": 9}):
        config = prepared(resolve_config("navigation", overrides=choices | changed))
        assert config.prior.transforms == "discovered:c4"
    measured._discovered.cache_clear()
    assert len(asked) == 2, "one search for each task"


@pytest.mark.slow
def test_what_is_weighed_is_listed() -> None:
    """Four agents and four landmarks under d4 are 4608 elements, too many to weigh: landmarks stay then."""
    settings = {"task.num_agents": 4, "prior.transforms": "discovered", "prior.trust": "measured"}
    prior = prepared(resolve_config("navigation", overrides=settings)).prior
    assert prior.transforms == "discovered:d4*agents"
    assert len(prior.weights) == 8 * 24 - 1


@pytest.mark.parametrize(("settings", "outcome"), [({}, "holds"), ({"num_landmarks": 2}, "broken")])
def test_declared_orders_of_landmarks_are_checked(settings, outcome, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a false declaration: two landmarks of which the first counts twice."""

    def worlds(num_envs, seeds):
        env = make("navigation", num_envs, seeds, settings)
        env.spec = replace(env.spec, symmetry=f"d4*agents*landmarks-{settings.get('num_landmarks', 3)}")
        if outcome == "broken":
            step = env.step
            monkeypatch.setattr(env, "step", lambda action: weighted(step(action), env.spec))
        return env

    def weighted(step, spec):
        return replace(step, reward=step.reward + step.next.obs[..., spec.observation.slices()["landmarks"].start])

    report = check_symmetry(worlds)
    found = [one for one in report.elements if one.element.startswith("landmarks-")]
    assert len(found) == (3 if outcome == "holds" else 1), "each exchange of two"
    assert {(one.declared, one.outcome) for one in found} == {(True, outcome)}
    assert ("landmarks-" in report.found) == (outcome == "holds")


def test_where_nothing_is_found_there_is_no_prior() -> None:
    broken = {f"task.{name}": value for name, value in NOTHING.items()}
    config = resolve_config("navigation", overrides={**broken, "prior.transforms": "discovered"})
    prior = prepared(config).prior
    assert (prior.kind, prior.transforms) == ("none", "discovered:"), "a run says that it looked"
    with pytest.raises(ValueError, match="nothing was discovered that transforms could name"):
        build_learner(resolve_config("navigation", overrides={"prior.transforms": "discovered:"}))
    plain = resolve_config("navigation")
    assert prepared(plain) is plain


@pytest.mark.parametrize("logs", [False, True])
def test_what_does_not_fit_into_the_time_is_not_covered(logs: bool) -> None:
    """Collecting takes no more than half of the time and tells how far it is, whatever comes of it."""
    told: list[tuple[int, int, str]] = []
    elements = check_symmetry(
        lambda n, seeds: make("navigation", n, seeds), "rot90,flip-x", logs, lambda *news: told.append(news), seconds=0
    ).elements
    assert [(element.outcome, element.reason) for element in elements] == [("not covered", LATE)] * 2
    assert told == [(256, 16 * 8 * 256, "steps") if logs else (1, 22, "steps"), (1, 2, "elements"), (2, 2, "elements")]


def test_declared_elements_are_tried_first_until_the_time_is_over_within_one() -> None:
    first, second = parse_elements("rot90,flip-x", 1)

    def judge(element: Element) -> ElementVerdict:
        if element == first:
            raise Late
        return ElementVerdict(element.name, True, (concluded("reward", 0.0, 0.0, False, 0.0),))

    late, declared = verdicts_of([first, second], judge, lambda element: element == second)
    assert (late.outcome, late.reason, declared.outcome) == ("not covered", LATE, "holds")


def test_few_transitions_say_nothing() -> None:
    env = make("navigation", 64, [0])
    verdicts = check_transitions(env.spec, collect(env, 64, 1), parse_elements("d4", 3))
    assert {verdict.outcome for verdict in verdicts} == {"not covered"}
