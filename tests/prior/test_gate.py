"""The gate per state and action: hand-worked predictions, what is let through, and training with it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from esp_cli.checking.measured import prepared
from esp_cli.prior import PriorConfig, SeedBatch, SymmetryPrior
from esp_cli.prior.gate import Gate, GatedTransform, fit_gate, gated, inputs_of
from esp_cli.symmetry import transform_set
from esp_cli.training.build import build_learner
from esp_cli.training.checkpoint import read_policy
from esp_cli.training.config import resolve_config
from esp_envs import make
from esp_envs.mpe.task import MOVES
from esp_envs.spec import Continuous, Field, Kind, Spaces, layout
from tests.cli.running import esp
from tests.prior.test_copies import Squared
from tests.prior.test_imperfect import SMALL, generators, train_small

ONE = Spaces(
    num_agents=1,
    observation=layout(Field("velocity", Kind.VECTOR)),
    state=layout(Field("velocity", Kind.VECTOR)),
    action=MOVES,
    symmetry="d4",
)
RIGHT, UP = 2, 4


def one_body(wind: float, doubt: float = 2.0, certain: tuple[str, ...] = ()) -> Gate:
    """Return predictors of a body that a move pushes by 1, and a wind along x by `wind` times its x: [1, 28, 3].

    The inputs are 1, x, y, left, right, down, up, and products of two of these.
    """
    assert inputs_of(ONE, torch.zeros(1, 1, 1, 2), torch.zeros(1, 1, 1, dtype=torch.int64)).shape[-1] == 28
    weights = torch.zeros(1, 28, 3)
    weights[0, 3:7, :2] = torch.tensor([[-1.0, 0], [1, 0], [0, -1], [0, 1]])
    weights[0, 7, 0] = wind  # x squared, the first product
    return Gate(ONE, weights, torch.full((3,), 2.0), torch.full((3,), 0.01), doubt, certain)


def test_copies_are_kept_by_how_far_the_predictors_disagree() -> None:
    """With a push of x^2 / 2 along x: at (2, 1) by 2. Turned by 180 degrees it should be -2 and is 2: off by 4, 2 s.d.

    A quarter turn sees 2 along y where there is 1/2 along x: off by 2 along y, 1 s.d. A mirror in the x-axis agrees.
    """
    obs = torch.tensor([2.0, 1.0]).view(1, 1, 1, 1, 2)
    found = {
        g.elements[0].name: float(one_body(0.5).kept(g, obs, torch.full((1, 1, 1, 1), UP)))
        for g in transform_set("rot90,rot180,flip-x", ONE).each()
    }
    expected = {"rot90": math.exp(-2 * 1), "rot180": math.exp(-2 * 2), "flip-x": 1.0}
    assert found == pytest.approx(expected)
    still = torch.zeros(1, 1, 1, 1, 2)
    for g in transform_set("rot90,rot180,flip-x", ONE).each():
        assert float(one_body(0.5).kept(g, still, torch.full((1, 1, 1, 1), RIGHT))) == 1, "there is no wind at x = 0"


def test_what_predictors_read_by_hand() -> None:
    """1, (x, y), two of the four moves, products of two; behind them what the others see and do, in agent order."""
    spaces = Spaces(
        num_agents=3, observation=layout(Field("velocity", Kind.VECTOR)), state=layout(), action=MOVES, symmetry="d4"
    )
    obs = torch.tensor([[2.0, 3.0], [5.0, 7.0], [11.0, 13.0]]).view(1, 1, 3, 2)
    inputs = inputs_of(spaces, obs, torch.tensor([0, RIGHT, 1]).view(1, 1, 3))
    rows = torch.tensor([[2.0, 3, 0, 0, 0, 0], [5, 7, 0, 1, 0, 0], [11, 13, 1, 0, 0, 0]])
    others = ((1, 2), (0, 2), (0, 1))
    for agent, (first, second) in enumerate(others):
        own = rows[agent]
        pairs = torch.cat([own[k:] * own[k] for k in range(6)])
        expected = torch.cat([torch.ones(1), own, pairs, rows[first], rows[second]])
        assert torch.equal(inputs[0, 0, agent], expected)
    assert inputs[0, 0, 1, 7:13].tolist() == [25, 35, 0, 5, 0, 0], "the products of x = 5, with what moves to the right"


def test_each_row_is_moved_or_stays_and_a_last_state_goes_with_the_last_step() -> None:
    (turn,) = transform_set("rot90", ONE).each()
    some = gated(turn, torch.tensor([[[True, False], [False, True]]]))
    obs = torch.tensor([3.0, 1.0]).expand(1, 2, 3, 1, 2)
    moved, kept = [-1.0, 3.0], [3.0, 1.0]
    assert some.obs(obs)[0, :, :, 0].tolist() == [[moved, kept, kept], [kept, moved, moved]]
    actions = torch.full((1, 2, 2, 1), RIGHT)
    assert some.action(actions)[0, ..., 0].tolist() == [[UP, RIGHT], [RIGHT, UP]]
    assert some.part(1, 2).open.tolist() == [[[False, True]]]
    outputs = torch.arange(5.0).expand(1, 2, 2, 1, 5)
    assert torch.equal(some.pull_back(some.push_outputs(outputs)), outputs)


def test_a_row_that_is_not_moved_equals_its_original_and_costs_no_penalty() -> None:
    config = PriorConfig(transforms="rot90", trust="gate", weights={"rot90": 0.5}, consistency_coef=0.5)
    prior = SymmetryPrior(config, ONE)
    prior.gate = one_body(1e6)
    batch = _batch(torch.tensor([[0.0, 0.0], [9.0, 0.0]]))
    made = prior.copies(batch, generators(1))
    assert made.rows.obs[0, 2:, 0, 0].tolist() == [[0, 0], [9, 0]], "the second is far off, so it stays"
    assert made.rows.action[0, 2:, 0, 0].tolist() == [UP, RIGHT]
    logits = torch.tensor([0.0, 0, 1, 0, 0]).expand(1, 4, 1, 1, 5)
    assert float(made.penalty(policy=(Squared(), logits)).value) == pytest.approx(0.5 * 2 / 2), (
        "the first row's gap alone"
    )
    for size in (1, 2):
        parts = made.chunks(size)
        assert torch.equal(torch.cat([part.obs[:, part.originals.count :] for part in parts], 1), made.obs[:, 2:])


def _batch(obs: torch.Tensor) -> SeedBatch:
    rows = obs.view(1, 2, 1, 1, 2)
    return SeedBatch(rows, rows[..., 0, :], torch.full((1, 2, 1, 1), RIGHT))


def test_elements_that_hold_are_never_gated_and_a_prior_without_its_gate_says_so() -> None:
    weights = {"rot90": 0.5, "flip-x": 1.0}
    config = PriorConfig(transforms="rot90,flip-x", trust="gate", weights=weights, copies="all")
    prior = SymmetryPrior(config, ONE)
    batch = _batch(torch.ones(2, 2))
    with pytest.raises(ValueError, match="needs predictors of its task"):
        prior.copies(batch, generators(1))
    prior.gate = one_body(1e6, certain=("flip-x",))
    turn, mirror = prior.copies(batch, generators(1)).transforms
    assert [isinstance(g, GatedTransform) for g in (turn, mirror)] == [True, False]
    certain = SymmetryPrior(config.model_copy(update={"weights": {"rot90": 1.0, "flip-x": 1.0}}), ONE)
    assert not any(isinstance(g, GatedTransform) for g in certain.copies(batch, generators(1)).transforms)
    uncovered = SymmetryPrior(config.model_copy(update={"weights": {"rot90": 0.0, "flip-x": 0.0}}), ONE)
    uncovered.gate = one_body(1e6)
    assert not uncovered.copies(batch, generators(1)).transforms, "what nobody knows is not copied, in no row"


LEFT_AND_BROKEN = [
    ("navigation", {"wind": 0.3}, ["flip-x"], ["rot90", "rot180"]),
    ("navigation", {"action_turn_rad": 1.0}, ["rot90", "rot180"], ["flip-x"]),
    ("predator-prey", {"action_turn_rad": 1.0}, ["rot90", "rot180"], ["flip-x"]),
    ("navigation", {}, ["rot90", "rot180", "flip-x"], []),
]


@pytest.mark.parametrize(("task", "settings", "left", "broken"), LEFT_AND_BROKEN, ids=str)
def test_predictors_of_a_task_let_through_what_holds(task: str, settings, left: list[str], broken: list[str]) -> None:
    env = make(task, 128, [5], settings)
    gate = fit_gate(env, 2.0, (), alike=True)
    seen, action = env.reset(), env.random_action()
    for g in transform_set("rot90,rot180,flip-x", env.spec).each():
        kept = float(gate.kept(g, seen.obs.unsqueeze(2), action.unsqueeze(2)).mean())
        name = g.elements[0].name
        assert kept > 0.97 if name in left else kept < 0.7
        assert name in left + broken


def test_mud_closes_the_gate_where_something_moves_and_nowhere_else() -> None:
    env = make("navigation", 128, [5], {"mud": 0.5})
    gate = fit_gate(env, 2.0, (), alike=True)
    (turn,) = transform_set("rot180", env.spec).each()
    obs = torch.zeros(1, 2, 1, 3, env.spec.observation.width)
    obs[0, 1, ..., 0], obs[..., 2] = 2.0, 0.8  # one world at rest and one that moves, all right of x = 0
    resting, moving = gate.kept(turn, obs, torch.zeros(1, 2, 1, 3, dtype=torch.int64)).flatten().tolist()
    assert resting > 0.9
    assert moving < 0.2


def test_who_differs_is_seen_where_agents_are_exchanged() -> None:
    def kept(weak_agent: float) -> float:
        env = make("navigation", 128, [5], {"weak_agent": weak_agent})
        (swap,) = transform_set("agents-1-0-2", env.spec).each()
        seen, action = env.reset(), torch.full((1, 128, 1, 3), RIGHT)
        return float(fit_gate(env, 2.0, (), alike=False).kept(swap, seen.obs.unsqueeze(2), action).mean())

    assert kept(0.8) < 0.5
    assert kept(0.0) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", SMALL)
def test_training_with_a_gate_is_esp_where_nothing_is_broken_and_differs_where_something_is(
    algorithm: str, tmp_path: Path
) -> None:
    gate = ("--set", "prior.trust=gate", "--set", "prior.transforms=rot90,flip-x")
    bare = gate[2:]
    assert train_small(tmp_path / "a", algorithm, *gate) == train_small(tmp_path / "b", algorithm, *bare)
    windy = ("--set", "task.wind=0.5")
    broken = train_small(tmp_path / "c", algorithm, *gate, *windy)
    assert broken != train_small(tmp_path / "d", algorithm, *bare, *windy)
    assert broken == train_small(tmp_path / "e", algorithm, *gate, *windy), "the gate is the same each time"
    weights = json.loads((tmp_path / "c" / "config.json").read_text())["prior"]["weights"]
    assert weights["flip-x"] == 1
    assert weights["rot90"] < 0.7


@pytest.mark.parametrize("choice", ["prior.copies=all", "prior.fade=1"])
def test_a_seed_draws_the_same_alone_and_beside_others_whose_elements_are_certain(tmp_path: Path, choice) -> None:
    gate = ("--set", "task.wind=0.3", "--set", "prior.trust=gate", "--set", "prior.transforms=d4", "--set", choice)
    for name, seeds in (("alone", "1"), ("among", "0,1,2")):
        esp("train", *SMALL["mappo"].split(), *gate, "--seed-list", seeds, "--out", tmp_path / name)
    alone, among = (read_policy(tmp_path / name / "policy.safetensors")[0] for name in ("alone", "among"))
    for name, tensor in alone.items():
        torch.testing.assert_close(tensor[0], among[name][1], rtol=1e-4, atol=1e-5)
        assert not torch.allclose(tensor[0], among[name][2], rtol=1e-3) or tensor.std() == 0, "the control"


def test_the_share_of_copies_is_that_of_the_rows_that_are_moved() -> None:
    """Of four states at (2, 1) and (0, 0), seed 0 turns by a half: two moved; the mirror of seed 1 is certain: all."""
    config = PriorConfig(transforms="rot180,flip-x", trust="gate", weights={"rot180": 0.01, "flip-x": 1.0})
    prior = SymmetryPrior(config, ONE)
    prior.gate = one_body(0.5, doubt=1000.0, certain=("flip-x",))
    obs = torch.tensor([[2.0, 1.0], [0, 0], [2, 1], [0, 0]]).view(1, 4, 1, 1, 2).expand(2, -1, -1, -1, -1)
    batch = SeedBatch(obs, obs[:, :, :, 0], torch.full((2, 4, 1, 1), UP))
    assert prior.augmented_share(2).tolist() == [0.5, 0.5], "before anything is drawn: one copy of each row"
    own, seen = generators(2), set()
    for _ in range(20):
        (g,) = prior.copies(batch, own).transforms
        for element, share in zip(g.elements, prior.augmented_share(2).tolist(), strict=True):
            seen.add((element.name, share))
    assert seen == {("rot180", 0.25), ("flip-x", 0.5)}


def test_a_gate_is_asked_about_what_the_task_was_given() -> None:
    """A latent force of 3 along x acts as 0.5: turned it should push as much along y, where it does nothing."""
    forces = Spaces(
        num_agents=1,
        observation=layout(Field("velocity", Kind.VECTOR)),
        state=layout(),
        action=Continuous(layout(Field("force", Kind.VECTOR))),
        symmetry="d4",
    )
    weights = torch.zeros(1, inputs_of(forces, torch.zeros(1, 1, 1, 2), torch.zeros(1, 1, 1, 2)).shape[-1], 3)
    weights[0, 3, 0] = 1.0  # pushed along x by the force's x, and not along y
    gate = Gate(forces, weights, torch.ones(3), torch.zeros(3), 1.0, to_environment=lambda u: u / 6)
    (turn,) = transform_set("rot90", forces).each()
    kept = gate.kept(turn, torch.zeros(1, 1, 1, 1, 2), torch.tensor([3.0, 0.0]).view(1, 1, 1, 1, 2))
    assert float(kept) == pytest.approx(math.exp(-0.5))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"network.name": "gru"}, "a recurrent network cannot take"),
        ({"prior.compass": 1.0}, "leave one of the two out"),
        ({"prior.compass": 1.0, "prior.trust": "measured"}, "leave one of the two out"),
        ({"prior.compass": 1.0, "prior.weights": {"rot90": 0.5}}, "leave one of the two out"),
    ],
    ids=str,
)
def test_a_gate_that_does_not_fit_is_refused(settings, message: str) -> None:
    overrides = {"prior.trust": "gate", "task.wind": 0.5, "prior.transforms": "rot90", **settings}
    with pytest.raises(ValueError, match=message):
        build_learner(prepared(resolve_config("navigation", overrides=overrides)))


def test_a_replay_of_copied_episodes_is_refused_with_a_gate() -> None:
    overrides = {"prior.trust": "gate", "task.wind": 0.5, "prior.transforms": "rot90", "prior.replay": "stored"}
    with pytest.raises(ValueError, match=r"use prior\.replay=sampled"):
        build_learner(prepared(resolve_config("navigation", "qmix", overrides=overrides)))
