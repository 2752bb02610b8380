"""The gradient of MADDPG's actor worked out by hand, against that of the same loss under autograd."""

from __future__ import annotations

import pytest
import torch

from esp_cli.algorithms.closed_actor import draw
from esp_cli.algorithms.closed_form import carries
from tests.algorithms.off_policy import learner


def prepared(**choice):
    """Return a learner with networks far from their first weights, and the arguments of both gradients."""
    trained = learner("maddpg", **choice)
    for _ in range(3):
        trained.iterate(0.0)
    list(trained.policy.actor.parameters())[-2].data.mul_(30)
    batch = trained.replay.sample(3, trained.generators["learner"])
    batch.valid[:, 0, 20:] = False
    copies = trained.prior.copies(batch, trained.generators["prior"])
    noise = torch.rand(2, 3, 25, 3, 5, generator=torch.Generator().manual_seed(0))
    trained.critic.requires_grad_(False)
    return trained, (copies, trained._critic_rows(copies.rows)[:, :, :-1], noise)


def gap(ours, theirs):
    """Return the largest difference in units of the largest number."""
    return ((ours - theirs).abs().max() / theirs.abs().max()).item()


CHOICES = [
    {"prior__kind": "none"},
    {"prior__kind": "esp", "algo__output_penalty": 0.1},
    {"prior__kind": "esp", "prior__copies": "all", "prior__transforms": "c4", "prior__consistency_coef": 3.0},
    {"prior__kind": "augment", "prior__transforms": "rot90"},
    {"prior__kind": "consistency", "prior__consistency_coef": 3.0},
    {"prior__kind": "esp", "prior__stop_gradient": "original", "prior__consistency_coef": 3.0},
    {"prior__kind": "esp", "prior__stop_gradient": "transformed", "prior__copies": "all"},
    {"prior__kind": "esp", "prior__terms": "value", "network__activation": "relu"},
    {"prior__kind": "esp", "task__convention": "pettingzoo", "algo__critic_input": "state"},
]


@pytest.mark.parametrize("choice", CHOICES)
def test_the_closed_form_is_the_reference_to_rounding(choice):
    trained, arguments = prepared(**choice)
    assert trained._closed_form
    assert carries(arguments[0].transforms)
    (ours, metrics), (theirs, expected) = trained.closed_gradient(*arguments), trained.reference_gradient(*arguments)
    assert gap(ours, theirs) < 1e-4
    assert metrics.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(metrics[name], value.detach())


@pytest.mark.parametrize("name", ["output_penalty", "gap", "share", "value"])
def test_each_term_moves_the_gradient(name, monkeypatch):
    """The negative control of the comparison above."""
    trained, arguments = prepared(algo__output_penalty=0.1, prior__consistency_coef=3.0)
    theirs, _ = trained.reference_gradient(*arguments)
    if name == "share":
        arguments[0].originals.valid[:, 0, 20:] = True
    elif name == "value":
        trained._value_scale = 0.0
    else:
        made = "esp_cli.algorithms.maddpg.ActorWeights"
        where = ("output_penalty", "gap", "stop_gradient").index(name)
        original = trained.closed_gradient.__globals__["ActorWeights"]
        monkeypatch.setattr(made, lambda *w: original(*(0.0 if k == where else x for k, x in enumerate(w))))
    ours, _ = trained.closed_gradient(*arguments)
    assert gap(ours, theirs) > 3e-3


@pytest.mark.parametrize(
    "choice",
    [
        {"network__name": "gru"},
        {"algo__actor_gradient": "expected"},
        {"algo__actor_actions": "own"},
        {"task__actions": "continuous"},
    ],
)
def test_what_it_does_not_cover_takes_the_reference(choice):
    assert not learner("maddpg", **choice)._closed_form


def test_agents_that_move_take_the_reference():
    trained = learner("maddpg", prior__transforms="agents")
    trained.iterate(0.0)
    copies = trained.prior.copies(trained.replay.sample(3, trained.generators["learner"]), trained.generators["prior"])
    assert not carries(copies.transforms)


def test_a_draw_is_the_heads_own_and_equal_numbers_share_it():
    trained = learner("maddpg")
    outputs = torch.randn(2, 4, 6, 3, 5)
    noise = torch.rand(2, 4, 6, 3, 5)
    expected = trained.head.relaxed(trained.head.normalise(outputs), noise)
    drawn = draw(outputs.permute(0, 4, 3, 1, 2).flatten(3).unsqueeze(3), 1, noise)
    torch.testing.assert_close(drawn.hard.view(2, 4, 6, 3, 5), expected)
    assert not torch.equal(drawn.soft.flatten(3).permute(0, 3, 2, 1), drawn.hard), "negative control"
    even = draw(torch.tensor([1.0, 1.0, 0.0]).view(1, 3, 1, 1, 1), 1, torch.full((1, 1, 1, 1, 3), 0.5))
    torch.testing.assert_close(even.hard.flatten(), torch.tensor([0.5, 0.5, 0.0]))
