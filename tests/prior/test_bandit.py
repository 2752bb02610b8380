"""The bandit that chooses an element by the returns that follow it."""

import math

import pytest
import torch

from esp_cli.prior import SymmetryPrior
from esp_cli.prior.bandit import WINDOW, Bandit
from esp_cli.prior.config import PriorConfig
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs import make
from esp_envs.errors import UserError
from tests.prior.test_copies import SPACES


def test_bounds_are_those_worked_out_by_hand() -> None:
    """Returns 1, 3, 5 after arms 0, 1, 0: mean 3, standard deviation sqrt(8 / 3)."""
    bandit = Bandit(1, 3)
    bandit.arms[0, -3:], bandit.returns[0, -3:] = torch.tensor([0, 1, 0]), torch.tensor([1.0, 3.0, 5.0])
    spread = math.sqrt(2 * math.log(3))
    assert bandit.bounds()[0].tolist() == pytest.approx([spread / math.sqrt(2), spread, math.inf])
    bandit.returns[0, -1] = 9.0  # mean 13 / 3, variance (100 + 16 + 196) / 27
    better = ((1 - 13 / 3) + (9 - 13 / 3)) / 2 / math.sqrt(312 / 27)
    assert bandit.bounds()[0, 0].item() == pytest.approx(better + spread / math.sqrt(2))


def test_a_return_counts_for_the_arm_of_the_iteration_before() -> None:
    bandit = Bandit(2, 2)
    bandit.step(torch.tensor([7.0, 7.0]))  # brought by no arm
    assert (bandit.arms >= 0).sum() == 0
    assert bandit.before.tolist() == [0, 0]
    bandit.step(torch.tensor([1.0, math.nan]))
    assert (bandit.arms[:, -1].tolist(), bandit.returns[:, -1].tolist()) == ([0, -1], [1.0, 0.0])
    assert bandit.arm.tolist() == [1, 0], "what was not tried comes first"


def test_it_finds_the_arm_that_pays_and_follows_where_another_one_does() -> None:
    bandit, generator = Bandit(1, 4), torch.Generator().manual_seed(0)

    def share(best: int, rounds: int) -> float:
        hits = 0
        for _ in range(rounds):
            pays = 1.0 if int(bandit.before) == best else 0.0
            bandit.step(torch.tensor([pays]) + 0.3 * torch.randn(1, generator=generator))
            hits += int(bandit.arm) == best
        return hits / rounds

    assert share(2, 200) > 0.6
    share(1, WINDOW)
    assert share(1, 200) > 0.6


def test_copies_are_made_with_the_arm_and_with_none() -> None:
    prior = SymmetryPrior(PriorConfig(kind="augment", transforms="rot90,rot180", copies="bandit"), SPACES)
    generators = [torch.Generator() for _ in range(2)]
    assert [g.elements[0].name for g in prior._draw(generators)] == ["rot90"]
    prior.learned(torch.tensor([0.0, 0.0]))
    prior._bandit.arm = torch.tensor([1, 2])
    (drawn,) = prior._draw(generators)
    assert [element.is_identity for element in drawn.elements] == [False, True]
    assert drawn.elements[0].name == "rot180"
    assert prior.augmented_share(2).tolist() == [0.5, 0.0]


@pytest.mark.parametrize(
    "choice", [{"trust": "measured", "weights": {"rot90": 1}}, {"fade": 0.5}, {"transforms": "so2"}]
)
def test_what_does_not_go_with_it_is_refused(choice: dict[str, object]) -> None:
    spaces = make("navigation", 1, [0], {"actions": "continuous"}).spec
    with pytest.raises(UserError, match=r"prior\.copies=bandit"):
        SymmetryPrior(PriorConfig(**{"transforms": "rot90", "copies": "bandit", **choice}), spaces)


@pytest.mark.parametrize("algorithm", ["mappo", "qmix"])
def test_a_resumed_run_goes_on_with_what_it_knew(algorithm: str) -> None:
    small = {"mappo": {"mappo.num_envs": 2, "mappo.num_epochs": 1}}.get(algorithm, {"qmix.num_envs": 2})
    own = {**small, "network.name": "mlp", "prior.copies": "bandit", "task.wind": 0.5}  # nothing is declared there
    config = resolve_config("navigation", algorithm, steps=10_000, seeds=(0, 1), overrides=own)
    learner, other = build_learner(config), build_learner(config)
    for _ in range(4):
        learner.begin(0.0)
        learner.iterate(0.0)
    state = learner.state_dict()
    assert {"prior.arm", "prior.before", "prior.arms", "prior.returns"} <= state.keys()
    other.load_state_dict({name: value.clone() for name, value in state.items()})
    for one in (learner, other):
        one.iterate(0.0)
    assert all(torch.equal(value, other.state_dict()[name]) for name, value in learner.state_dict().items())
