"""Eq. 8 and 9 by hand, their direction and their stop-gradients."""

import math

import pytest
import torch

from esp_cli.networks.policies import CategoricalPolicies
from esp_cli.prior import SymmetryPrior
from esp_cli.prior.config import PriorConfig
from esp_cli.prior.losses import OfGraph
from esp_cli.symmetry import transform_set
from esp_cli.symmetry.frame import Frame
from esp_envs import make

SPEC = make("navigation", 1, [0]).spec


ROT90 = transform_set("rot90", SPEC, "cpu").each()[0]


def gap(there, here):
    """Return S_pi of probabilities [A] at rot90(s) and at s, for each of three agents."""
    outputs = torch.stack([torch.as_tensor(x).log().expand(1, 3, -1) for x in (here, there)]).unsqueeze(0)
    return CategoricalPolicies(OfGraph(outputs), Frame([ROT90])).divergence(slice(1, None), slice(0, 1)).view(3)


def test_policy_consistency_is_the_divergence_of_the_pulled_back_policy_from_the_original():
    pulled, original = torch.tensor([0.4, 0.4, 0.1, 0.05, 0.05]), torch.tensor([0.2, 0.6, 0.1, 0.05, 0.05])
    forward = 0.4 * math.log(0.4 / 0.2) + 0.4 * math.log(0.4 / 0.6)
    backward = 0.2 * math.log(0.2 / 0.4) + 0.6 * math.log(0.6 / 0.4)
    there = ROT90.push_outputs(pulled.expand(1, 3, -1))[0, 0]
    assert gap(there, original).tolist() == pytest.approx([forward] * 3, rel=1e-5)
    assert forward != pytest.approx(backward, rel=1e-3), "the direction matters"


def test_policy_consistency_vanishes_exactly_where_the_policy_turns_with_the_world():
    """A policy that goes up in s must go left in rot90(s)."""
    names = SPEC.action.names
    here, turned = torch.full((5,), 0.05), torch.full((5,), 0.05)
    here[names.index("up")] = turned[names.index("left")] = 0.8
    torch.testing.assert_close(gap(turned, here), torch.zeros(3), atol=1e-6, rtol=0)
    # negative control: 0.75 log 16 for the two swapped probabilities
    torch.testing.assert_close(gap(here, here), torch.full((3,), 0.75 * math.log(16)))


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
