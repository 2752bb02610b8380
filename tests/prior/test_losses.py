"""Eq. 8 and 9 by hand, their direction and their stop-gradients."""

import math

import pytest
import torch

from esp_cli.prior import SymmetryPrior, policy_consistency_loss
from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import transform_set
from esp_envs import make

SPEC = make("navigation", 1, [0]).spec


def log_probs(*weights):
    return torch.tensor(weights).log().view(1, 1, 1, -1)


def divergence(p, q):
    return (p.exp() * (p - q)).sum(-1)


def test_policy_consistency_is_the_divergence_of_the_pulled_back_policy_from_the_original():
    pulled, original = log_probs(0.5, 0.5), log_probs(0.25, 0.75)
    forward = 0.5 * math.log(0.5 / 0.25) + 0.5 * math.log(0.5 / 0.75)
    backward = 0.25 * math.log(0.25 / 0.5) + 0.75 * math.log(0.75 / 0.5)
    assert policy_consistency_loss(divergence, pulled, original).item() == pytest.approx(forward, rel=1e-5)
    assert forward != pytest.approx(backward, rel=1e-3), "the direction matters"


def test_policy_consistency_vanishes_exactly_where_the_policy_turns_with_the_world():
    """A policy that goes up in s must go left in rot90(s)."""
    g = transform_set("rot90", SPEC, "cpu").each()[0]
    names = SPEC.action.names
    here, turned = torch.full((1, 1, 3, 5), 0.05), torch.full((1, 1, 3, 5), 0.05)
    here[..., names.index("up")] = turned[..., names.index("left")] = 0.8
    loss = policy_consistency_loss(divergence, g.pull_back(turned.log()), here.log())
    torch.testing.assert_close(loss, torch.zeros(1, 1, 3), atol=1e-6, rtol=0)
    stubborn = policy_consistency_loss(divergence, g.pull_back(here.log()), here.log())
    # negative control: 0.75 log 16 for the two swapped probabilities
    torch.testing.assert_close(stubborn, torch.full((1, 1, 3), 0.75 * math.log(16)))


@pytest.mark.parametrize(
    ("kind", "augments", "coefficient", "active"),
    [
        ("esp", True, 0.1, True),
        ("augment", True, 0, True),
        ("consistency", False, 0.1, True),
        ("none", False, 0, False),
    ],
)
def test_kinds_switch_both_parts(kind, augments, coefficient, active):
    config = PriorConfig(kind=kind)
    assert (config.augments, config.coefficient) == (augments, coefficient)
    assert (SymmetryPrior(config, SPEC).transforms is not None) is active


@pytest.mark.parametrize(
    ("choice", "effective"),
    [
        ({"kind": "none", "transforms": "c4", "consistency_coef": 0.5, "replay": "stored"}, {"kind": "none"}),
        ({"kind": "augment", "transforms": "c4", "consistency_coef": 0.5}, {"kind": "augment", "transforms": "c4"}),
        ({"kind": "consistency", "old_log_prob": "recompute"}, {"kind": "consistency"}),
        ({"kind": "consistency", "consistency_coef": 0, "transforms": "c4"}, {"kind": "none"}),
        ({"kind": "esp", "consistency_coef": 0, "copies": "all"}, {"kind": "augment", "copies": "all"}),
        ({"kind": "esp", "consistency_coef": 0.5, "old_log_prob": "recompute"}, None),
    ],
)
def test_settings_without_effect_go_back_to_their_defaults(choice, effective):
    assert PriorConfig(**choice).effective() == PriorConfig(**(choice if effective is None else effective))


def test_copies_and_their_share():
    def prior(**choice):
        return SymmetryPrior(PriorConfig(**choice), SPEC)

    assert prior(transforms="d4", copies="all").num_copies == 7
    assert float(prior(transforms="d4", copies="all").augmented_share(1)) == 7 / 8
    assert float(prior(transforms="d4").augmented_share(1)) == 1 / 2
    assert float(prior(transforms="d4", kind="consistency").augmented_share(1)) == 0
    assert prior(kind="none").num_copies == 0
