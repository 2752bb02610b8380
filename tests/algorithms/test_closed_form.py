"""Gradients worked out by hand against those of the same losses in the terms of the paper, under autograd."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from esp_cli.algorithms import closed_form
from esp_cli.algorithms.closed_form import Weights, carries, critic_gradient, policy_gradient
from esp_cli.symmetry import transform_set
from esp_envs import Field, Kind, Spaces, layout
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Discrete
from tests.algorithms.test_mappo import learner
from tests.networks.kernels.compiler import needs_compiler

WEIGHTS = Weights(
    clip_epsilon=0.2,
    entropy_coef=0.0,
    huber_delta=10.0,
    value_coef=1.0,
    policy_gap=0.0,
    value_gap=0.0,
    augments=True,
    stop_gradient="none",
)
SPACES = Spaces(
    num_agents=2,
    observation=layout(Field("velocity", Kind.VECTOR)),
    state=layout(Field("velocity", Kind.VECTOR)),
    action=Discrete(Kind.VECTOR, (RIGHT, UP, LEFT, DOWN), ("right", "up", "left", "down")),
    symmetry="d4*agents",
)


def weights(**changes):
    return dataclasses.replace(WEIGHTS, **changes)


def gradients(trained, reference):
    """Return the gradients of head (if it learns), actor and critic on a minibatch, by closed form or reference.

    The networks are far from their first weights, where the policy is uniform and the entropy has no gradient.
    """
    trained.iterate(0.0)
    trained.optimiser.parameters.buffer.mul_(1.5)
    last = list(trained.policy.actor.parameters())[-2]
    last.data.mul_(50)
    batch, _ = trained.prepare(trained.collector.collect(25))
    copies = trained.prior.copies(trained._minibatches(batch)[0], trained.generators["prior"])
    return parts_of_gradient(trained, copies, reference)


def parts_of_gradient(trained, copies, reference):
    """Return the gradients of head (if it learns), actor and critic, by closed form or reference."""
    assert carries(copies.transforms)
    if reference:
        gradient = trained.optimiser.gradient(trained.reference_loss(copies, 0.01, 1.0, None))
    else:
        gradient = trained._closed_form_gradient(copies, 0.01, 1.0, None)
    head, actor, critic = (
        sum(p[0].numel() for p in part.parameters())
        for part in (trained.policy.head, trained.policy.actor, trained.critic)
    )
    return [part for part in gradient[:, : head + actor + critic].split((head, actor, critic), 1) if part.numel()]


def gap(ours, theirs):
    """Return the largest difference in units of the largest number."""
    return ((ours - theirs).abs().max() / theirs.abs().max()).item()


CONTINUOUS = {"task__actions": "continuous"}
CHOICES = [
    {"prior__kind": "none"},
    {"prior__kind": "esp"},
    {"prior__kind": "esp", "prior__copies": "all", "prior__transforms": "c4"},
    {"prior__kind": "augment", "prior__transforms": "rot90"},
    {"prior__kind": "consistency", "prior__consistency_coef": 3.0},
    {"prior__kind": "esp", "prior__stop_gradient": "original", "prior__consistency_coef": 3.0},
    {"prior__kind": "esp", "prior__stop_gradient": "transformed", "prior__copies": "all"},
    {"prior__kind": "consistency", "prior__terms": "policy"},
    {"prior__kind": "consistency", "prior__terms": "value"},
    {"prior__kind": "esp", "network__name": "gru", "mappo__critic_input": "own"},
    {"prior__kind": "esp", "task__convention": "pettingzoo", "mappo__critic_input": "state"},
    {"prior__kind": "none", **CONTINUOUS},
    {"prior__kind": "esp", **CONTINUOUS},
    {"prior__kind": "esp", "prior__transforms": "o2", "prior__consistency_coef": 3.0, **CONTINUOUS},
    {"prior__kind": "esp", "prior__copies": "all", "prior__stop_gradient": "original", **CONTINUOUS},
    {"prior__kind": "consistency", "prior__stop_gradient": "transformed", **CONTINUOUS},
    {"prior__kind": "augment", "network__name": "gru", **CONTINUOUS},
]


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("choice", CHOICES)
def test_the_closed_form_is_the_reference_to_rounding(choice, compiled):
    ours, theirs = (gradients(learner(network__compiled=compiled, **choice), by) for by in (False, True))
    assert max(map(gap, ours, theirs)) < 1e-4


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("change", ["entropy_coef", "policy_gap", "value_gap", "value_coef", "augments"])
def test_each_term_of_the_closed_form_moves_the_gradient(change, actions, monkeypatch):
    """The negative control of the comparison above."""
    theirs = gradients(learner(task__actions=actions), reference=True)
    monkeypatch.setattr("esp_cli.algorithms.closed_form.Weights", lambda **k: Weights(**k | {change: k[change] * 0}))
    ours = gradients(learner(task__actions=actions), reference=False)
    assert max(map(gap, ours, theirs)) > 3e-3


@pytest.mark.parametrize("reference", [False, True])
def test_the_weight_of_the_value_loss_multiplies_the_critics_gradient_alone(reference):
    found = []
    for coefficient in (1.0, 2.0):
        trained = learner(mappo__value_coef=coefficient, prior__kind="none")
        batch, _ = trained.prepare(trained.collector.collect(25))
        found.append(parts_of_gradient(trained, trained.prior.copies(batch, []), reference))
    (actor, critic), (same_actor, twice) = found
    torch.testing.assert_close(same_actor, actor)
    torch.testing.assert_close(twice, 2 * critic)
    assert critic.abs().max() > 1e-3


@pytest.mark.parametrize(
    ("advantage", "old", "slope"),
    # pi(a) = 1/2; the ratio is 1/2 / old, and the objective's slope by log pi is rho A, or 0 where it is clipped
    [(1.0, 0.5, 1.0), (1.0, 0.25, 0.0), (1.0, 1.0, 0.5), (-1.0, 0.25, -2.0), (-1.0, 1.0, 0.0)],
)
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
def test_the_clipped_objective_by_hand(advantage, old, slope, compiled):
    old, advantage = (torch.full((1, 1, 1, 1), number) for number in (old, advantage))
    action = torch.zeros(1, 1, 1, 1, dtype=torch.int64)
    gradient = policy_gradient(torch.zeros(1, 1, 1, 1, 2), [], action, old.log(), advantage, weights(), compiled)
    # d log pi_0 / d logits = (1 - 1/2, -1/2), and the loss is minus the objective
    torch.testing.assert_close(gradient.flatten(), torch.tensor([-slope / 2, slope / 2]))


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
def test_the_copies_of_a_policy_that_turns_with_the_world_are_left_alone_and_others_are_drawn_to_it(compiled):
    (turn,) = transform_set("rot90", SPACES).each()
    here = torch.tensor([0.5, 0.25, 0.125, 0.125]).log()
    ahead = turn.push_outputs(here.view(1, 1, 1, 4)).view(4)
    none = torch.zeros(1, 1, 1, 1)
    for there in (ahead, here):
        logits = torch.stack([here, there]).view(1, 2, 1, 1, 4)
        made = (none.long(), none, none)
        ours = policy_gradient(logits, [turn], *made, weights(policy_gap=1.0), compiled).view(2, 4)
        original, copy = (x.clone().requires_grad_() for x in (here, there))
        p, q = turn.pull_back(copy.view(1, 1, 1, 4)).view(4).log_softmax(0), original.log_softmax(0)
        divergence = (p.exp() * (p - q)).sum()
        expected = torch.autograd.grad(divergence, (original, copy))
        torch.testing.assert_close(ours, torch.stack(expected), atol=1e-6, rtol=1e-5)
        # pulled back, the copy that does not turn says 1/4, 1/8, 1/8, 1/2
        assert divergence.item() == pytest.approx(0.0 if there is ahead else 0.625 * math.log(2), abs=1e-6)
        assert (ours.abs().max() > 0.1) == (there is here)


def test_the_critics_gradient_by_hand():
    values = torch.tensor([1.0, 2.0, 1.0, 4.0]).view(1, 4, 1, 1)
    target = torch.tensor([0.0, 2.0]).view(1, 2, 1, 1)
    # errors 1, 0 of the originals, 1, 2 of the copies, cut at 1, over four rows; gaps 0 and 2 over two rows
    gradient = critic_gradient(values, target, weights(huber_delta=1.0, value_gap=0.5))
    assert gradient.flatten().tolist() == [0.25, -1.0, 0.25, 0.25 + 1.0]


def test_copies_whose_agents_change_places_take_the_reference():
    assert carries(learner(prior__transforms="d4").prior.transforms.each())
    assert not carries(learner(prior__transforms="agents").prior.transforms.each())


def test_default_training_takes_the_closed_form_and_clipped_values_do_not(monkeypatch):
    calls = []
    monkeypatch.setattr(
        "esp_cli.algorithms.mappo.policy_gradient", lambda *a: calls.append(1) or closed_form.policy_gradient(*a)
    )
    learner(mappo__clip_value=True).iterate(0.0)
    assert not calls
    learner().iterate(0.0)
    assert calls
