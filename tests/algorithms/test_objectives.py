"""Each loss against autograd through the same loss in the terms of the paper, and against numbers by hand."""

import math
import re
from pathlib import Path

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from esp_cli.algorithms import maddpg, mappo, qmix
from esp_cli.algorithms.adam import SeedParameters
from esp_cli.algorithms.objectives import (
    clipped_surrogate,
    ppo_loss,
    surrogate_slope,
    value_error,
    value_loss,
    value_slope,
)
from esp_cli.networks.contract import WithVJP
from esp_cli.networks.heads import Categorical
from esp_cli.networks.plain import MlpConfig
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.prior import Loss, SeedBatch, SymmetryPrior, copies, mean_per_seed
from esp_cli.prior.config import PriorConfig
from esp_cli.prior.losses import value_consistency_loss
from esp_cli.symmetry import transform_set
from esp_envs import Field, Kind, Spaces, layout
from esp_envs.errors import UserError
from esp_envs.spec import DOWN, LEFT, RIGHT, UP, Continuous, Discrete, Layout
from tests.algorithms import off_policy as learners
from tests.algorithms.test_mappo import learner
from tests.networks.kernels.compiler import needs_compiler

SPACES = Spaces(
    num_agents=2,
    observation=layout(Field("velocity", Kind.VECTOR)),
    state=layout(Field("velocity", Kind.VECTOR)),
    action=Discrete(Kind.VECTOR, (RIGHT, UP, LEFT, DOWN), ("right", "up", "left", "down")),
    symmetry="d4*agents",
)


def divergence(head, p, q):
    """Return KL[p || q] of normalised outputs."""
    if isinstance(head, Categorical):
        return (p.exp() * (p - q)).sum(-1)
    deviation = head.log_deviation(p).exp()
    return kl_divergence(Normal(p, deviation), Normal(q, deviation)).sum(-1)


def reference_loss(trained, made, entropy_coef):
    """Return the negative of J_ESP (Eq. 10) of MAPPO under autograd, copy by copy in its own frame."""
    config, head, rows, batch = trained.config, trained.policy.head, made.rows, made.loss_rows
    prior, (here, *transformed) = trained.prior.config, made.rows.obs.split(made.originals.count, 1)
    outputs = trained.policy.unroll(rows.obs, config.truncation, rows.action_mask)
    values = trained.critic.unroll(rows.obs, rows.state, config.truncation)
    learned, value = made.for_loss(outputs), made.for_loss(values)
    ratio = (head.log_prob(learned, batch.action) - batch.log_prob).exp()
    clipped = ratio.clamp(1 - config.clip_epsilon, 1 + config.clip_epsilon)
    objective = torch.minimum(ratio * batch.advantage, clipped * batch.advantage) + entropy_coef * head.entropy(learned)
    error = torch.nn.functional.huber_loss(value, batch.target, reduction="none", delta=config.huber_delta)
    if config.clip_value:
        moved = batch.value + (value - batch.value).clamp(-config.clip_epsilon, config.clip_epsilon)
        other = torch.nn.functional.huber_loss(moved, batch.target, reduction="none", delta=config.huber_delta)
        error = torch.maximum(error, other)
    loss = config.value_coef * mean_per_seed(error, batch.valued(trained.num_values))
    loss = loss - mean_per_seed(objective, batch.mask)
    if not transformed or not prior.coefficient:
        return loss
    gaps = []
    (here, *there), (value, *moved) = (x.split(made.originals.count, 1) for x in (outputs, values))
    for g, copy, of_copy in zip(made.transforms, there, moved, strict=True):
        gap = divergence(head, g.pull_back(copy), here)
        gaps.append(mean_per_seed(gap, made.originals.mask))
        gap = value_consistency_loss(g.values(of_copy), value)
        gaps.append(mean_per_seed(gap, made.originals.valued(trained.num_values)))
    return loss + prior.coefficient * sum(gaps) / len(made.transforms)


def prepared(trained):
    """Return a minibatch with copies for networks far from their first weights, where the policy is uniform."""
    trained.iterate(0.0)
    trained.optimiser.parameters.buffer.mul_(1.5)
    list(trained.policy.actor.parameters())[-2].data.mul_(50)
    batch, _ = trained.prepare(trained.collector.collect(trained.config.num_steps))
    trained._remember_old_networks()
    trained.optimiser.parameters.buffer.mul_(1.02)
    adapt = None if trained._old is None else trained.reevaluated
    return trained.prior.copies(trained._minibatches(batch)[0], trained.generators["prior"], adapt)


def parts(trained, gradient):
    """Return the gradients of head (if it learns), actor and critic."""
    sizes = [
        sum(p[0].numel() for p in x.parameters()) for x in (trained.policy.head, trained.policy.actor, trained.critic)
    ]
    return [part for part in gradient[:, : sum(sizes)].split(sizes, 1) if part.numel()]


def gap(ours, theirs):
    """Return the largest difference in units of the largest number."""
    return ((ours - theirs).abs().max() / theirs.abs().max()).item()


def gradients(trained, of=None):
    """Return the gradients of the loss, and of the reference with other settings where these are given."""
    made = prepared(trained)
    ours = trained.optimiser.gradient(trained.loss(made, 0.01, 1.0, None))
    if of is not None:
        of(trained, made)
    theirs = trained.optimiser.gradient(reference_loss(trained, made, 0.01))
    return parts(trained, ours), parts(trained, theirs)


CONTINUOUS = {"task__actions": "continuous"}
WILDLIFE = {"task": "wildlife", "network__name": "mlp", "mappo__num_steps": 16}
CHOICES = [
    {"prior__kind": "none"},
    {"prior__kind": "esp"},
    {"prior__kind": "esp", "prior__copies": "all", "prior__transforms": "c4"},
    {"prior__kind": "augment", "prior__transforms": "rot90"},
    {"prior__kind": "consistency", "prior__consistency_coef": 3.0},
    {"prior__kind": "esp", "prior__copies": "all", "prior__consistency_coef": 3.0},
    {"prior__kind": "esp", "network__name": "gru", "mappo__critic_input": "own"},
    {"prior__kind": "esp", "task__convention": "pettingzoo", "mappo__critic_input": "state"},
    {"prior__kind": "none", **CONTINUOUS},
    {"prior__kind": "esp", **CONTINUOUS},
    {"prior__kind": "esp", "prior__transforms": "o2", "prior__consistency_coef": 3.0, **CONTINUOUS},
    {"prior__kind": "esp", "prior__copies": "all", **CONTINUOUS},
    {"prior__kind": "consistency", **CONTINUOUS},
    {"prior__kind": "augment", "network__name": "gru", **CONTINUOUS},
    {"mappo__clip_value": True},
    {"mappo__clip_value": True, "prior__kind": "augment", "prior__old_log_prob": "recompute"},
    {"prior__transforms": "d4*agents", "prior__consistency_coef": 3.0},
    {"prior__transforms": "agents", "task__convention": "pettingzoo", "prior__old_log_prob": "recompute"},
    {"prior__transforms": "o2*agents", "task__convention": "pettingzoo", **CONTINUOUS},
    {"network__layer_norm": True},
    {**WILDLIFE},
    {**WILDLIFE, "mappo__critic_input": "state", "prior__copies": "all"},
]


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("choice", CHOICES, ids=str)
def test_the_gradient_is_that_of_autograd_to_rounding(choice, compiled):
    ours, theirs = gradients(learner(network__compiled=compiled, **choice))
    assert max(map(gap, ours, theirs)) < 1e-4


def other(**changes):
    def change(trained, made):
        for name, value in changes.items():
            if name == "augments":
                made.augments = value
            else:
                owner = "config" if hasattr(trained.config, name) else "prior"
                config = trained.config if owner == "config" else trained.prior.config
                config = config.model_copy(update={name: value})
                made.config = trained.prior.config = config if owner == "prior" else trained.prior.config
                trained.config = config if owner == "config" else trained.config

    return change


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
@pytest.mark.parametrize("change", [{"consistency_coef": 0.0}, {"value_coef": 2.0}, {"augments": False}], ids=str)
def test_each_term_moves_the_gradient(change, actions):
    """The negative control of the comparison above."""
    ours, theirs = gradients(learner(task__actions=actions), other(**change))
    assert max(map(gap, ours, theirs)) > 3e-3


class Alone(WithVJP):
    """What a network returned, of which nothing is learned further."""

    def __init__(self, tensor):
        super().__init__(tensor, self._take, [])
        self.slope = None

    def _take(self, slope):
        self.slope = slope
        return []


def slopes(loss, *returned):
    loss.gradients([])
    return [x.slope for x in returned]


def prior(**choice):
    return SymmetryPrior(PriorConfig(**{"transforms": "rot90", "kind": "none", **choice}), SPACES)


@pytest.mark.parametrize(
    ("advantage", "old", "slope"),
    # pi(a) = 1/2; the ratio is 1/2 / old, and the objective's slope by log pi is rho A, or 0 where it is clipped
    [(1.0, 0.5, 1.0), (1.0, 0.25, 0.0), (1.0, 1.0, 0.5), (-1.0, 0.25, -2.0), (-1.0, 1.0, 0.0)],
)
def test_the_clipped_objective_by_hand(advantage, old, slope):
    old, advantage = (torch.full((1, 1, 1, 1), number) for number in (old, advantage))
    batch = SeedBatch(torch.zeros(1, 1, 1, 1, 2), torch.zeros(1, 1, 1, 2), torch.zeros(1, 1, 1, 1, dtype=torch.int64))
    batch.log_prob, batch.advantage, outputs = old.log(), advantage, Alone(torch.zeros(1, 1, 1, 1, 2))
    head = Categorical(Discrete(Kind.VECTOR, (RIGHT, LEFT), ("right", "left")))
    (found,) = slopes(ppo_loss(head, outputs, prior().copies(batch, []), 0.2, 0.0), outputs)
    # d log pi_0 / d logits = (1 - 1/2, -1/2), and the loss is minus the objective
    torch.testing.assert_close(found.flatten(), torch.tensor([-slope / 2, slope / 2]))


def test_the_copies_of_a_policy_that_turns_with_the_world_are_left_alone_and_others_are_drawn_to_it():
    (turn,) = transform_set("rot90", SPACES).each()
    here = torch.tensor([0.5, 0.25, 0.125, 0.125]).log()
    ahead = turn.push_outputs(here.view(1, 1, 1, 4)).view(4)
    batch = SeedBatch(torch.zeros(1, 1, 1, 1, 2), torch.zeros(1, 1, 1, 2), torch.zeros(1, 1, 1, 1, dtype=torch.int64))
    for there in (ahead, here):
        outputs = Alone(torch.stack([here, there]).view(1, 2, 1, 1, 4))
        made = prior(kind="consistency", consistency_coef=1.0).copies(batch, [])
        penalty = made.penalty(policy=(Categorical(SPACES.action), outputs))
        (ours,) = slopes(penalty, outputs)
        original, copy = (x.clone().requires_grad_() for x in (here, there))
        p, q = turn.pull_back(copy.view(1, 1, 1, 4)).view(4).log_softmax(0), original.log_softmax(0)
        divergence = (p.exp() * (p - q)).sum()
        expected = torch.autograd.grad(divergence, (original, copy))
        torch.testing.assert_close(ours.view(2, 4), torch.stack(expected), atol=1e-6, rtol=1e-5)
        # pulled back, the copy that does not turn says 1/4, 1/8, 1/8, 1/2
        assert divergence.item() == pytest.approx(0.0 if there is ahead else 0.625 * math.log(2), abs=1e-6)
        assert penalty.value.item() == pytest.approx(divergence.item(), abs=1e-6)
        assert (ours.abs().max() > 0.1) == (there is here)


LEGS = Layout((Field("hips", Kind.PSEUDOSCALAR, 2), Field("tail", Kind.SCALAR)))


@pytest.mark.parametrize("exchanged", [True, False])
def test_items_that_change_places_take_the_deviations_of_their_new_places(exchanged):
    """Eq. 7 and 8 in the words of the paper, pi(K_g a | L_g s), for a mirror that exchanges two hips."""
    torch.manual_seed(0)
    element = "flip-x*hips-1-0" if exchanged else "flip-x"
    spaces = Spaces(num_agents=1, observation=LEGS, state=LEGS, action=Continuous(LEGS), symmetry=element)
    policy = StochasticPolicy(spaces, MlpConfig(hidden=(8,)), [torch.Generator().manual_seed(0)])
    policy.head.log_std.data.copy_(torch.tensor([[-0.5, 0.5, 0.0]]))
    list(policy.actor.parameters())[-2].data.mul_(50)
    batch = SeedBatch(torch.randn(1, 4, 1, 1, 3), torch.randn(1, 4, 1, 3), torch.randn(1, 4, 1, 1, 3))
    batch.log_prob, batch.advantage = torch.randn(1, 4, 1, 1) - 3, torch.randn(1, 4, 1, 1)
    made = SymmetryPrior(PriorConfig(transforms=element, consistency_coef=0.5), spaces).copies(batch, [])
    outputs = policy.unroll_with_vjp(made.obs)
    ours = ppo_loss(policy.head, outputs, made, 0.2, 0.01) + made.penalty(policy=(policy.head, outputs))

    (g,) = made.transforms
    here, there = policy.unroll(batch.obs), policy.unroll(g.obs(batch.obs))
    actions, advantage = torch.stack([batch.action, g.action(batch.action)]), batch.advantage
    log_prob = policy.head.log_prob(torch.cat([here, there]), actions.flatten(0, 1))
    objective = clipped_surrogate(log_prob - batch.log_prob, advantage, 0.2)
    deviation = policy.head.log_deviation(here).exp().expand_as(here)
    p, q = (Normal(g.pull_back(there), g.pull_back_variance(deviation**2).sqrt()), Normal(here, deviation))
    loss = -objective.mean() - 0.01 * policy.head.entropy(here).mean() + 0.5 * kl_divergence(p, q).sum(-1).mean()
    torch.testing.assert_close(ours.value, loss.detach().view(1))
    parameters = [*policy.parameters()]
    found, expected = (
        SeedParameters(parameters).sum(x.gradients(parameters)) for x in (ours, Loss.of(loss.unsqueeze(0)))
    )
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-4)
    in_place = kl_divergence(Normal(g.pull_back(there), deviation), q).sum(-1).mean()
    assert (kl_divergence(p, q).sum(-1).mean() - in_place > 0.5) == exchanged, "the control"


def test_the_slopes_of_the_critics_losses_by_hand():
    batch = SeedBatch(torch.zeros(1, 2, 1, 1, 2), torch.zeros(1, 2, 1, 2), torch.zeros(1, 2, 1, 1, dtype=torch.int64))
    made = prior(kind="esp", consistency_coef=0.5).copies(batch, [])
    values = Alone(torch.tensor([1.0, 2.0, 1.0, 4.0]).view(1, 4, 1, 1))
    target = torch.tensor([0.0, 2.0]).view(1, 2, 1, 1)
    # errors 1, 0 of the originals, 1, 2 of the copies, cut at 1, over four rows; gaps 0 and 2 over two rows
    loss = value_loss(values, target, made, huber_delta=1.0) + made.penalty(value=values)
    assert slopes(loss, values)[0].flatten().tolist() == [0.25, -1.0, 0.25, 0.25 + 1.0]
    # Huber losses 1/2, 0, 1/2, 3/2 and a mean squared gap of 2
    assert loss.value.tolist() == [2.5 / 4 + 0.5 * 2]


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected", "slope"),
    [
        (1.1, 2.0, 2.2, 2.2),  # inside the clip range
        (1.5, 2.0, 2.4, 0.0),  # gain is capped at 1.2 A
        (0.5, 2.0, 1.0, 1.0),  # a loss of probability is not capped for a good action
        (0.5, -2.0, -1.6, 0.0),  # gain is capped at 0.8 A
        (1.5, -2.0, -3.0, -3.0),  # a bad action made likelier counts in full
    ],
)
def test_clipped_surrogate_by_hand(ratio, advantage, expected, slope):
    asked = (torch.tensor(math.log(ratio)), torch.tensor(advantage), 0.2)
    found = (clipped_surrogate(*asked).item(), surrogate_slope(*asked).item())
    assert found == pytest.approx((expected, slope), rel=1e-6)


def test_the_value_error_is_quadratic_inside_and_linear_outside():
    # delta = 10: 3^2 / 2 = 4.5; at 12: 10 * (12 - 5) = 70; both meet at 10: 50
    asked = (torch.tensor([3.0, -3.0, 10.0, 12.0, -12.0]), torch.zeros(5), 10.0)
    assert value_error(*asked).tolist() == [4.5, 4.5, 50.0, 70.0, 70.0]
    assert value_slope(*asked).tolist() == [3, -3, 10, 10, -10]


def test_a_clipped_value_error_is_the_larger_one():
    value, target, old = torch.tensor([2.0, 0.1]), torch.tensor([3.0, 3.0]), torch.tensor([0.0, 0.0])
    # clipped predictions are 0.2 and 0.1; errors 1 against 2.8, and 2.9 against 2.9
    asked = (value, target, 10.0, old, 0.2)
    torch.testing.assert_close(value_error(*asked), torch.tensor([0.5 * 2.8**2, 0.5 * 2.9**2]))
    torch.testing.assert_close(value_slope(*asked), torch.tensor([0.0, -2.9]))


def test_losses_add_up_with_each_other_and_with_tensors_and_take_weights():
    weight = torch.tensor([[3.0], [-1.0]], requires_grad=True)
    loss = 2 * Loss.of(weight.square().sum(1)) + weight.sum(1) + torch.ones(())
    assert loss.value.tolist() == [18 + 3 + 1, 2 - 1 + 1]
    ((parameters, (by,)),) = loss.gradients([weight])
    assert parameters[0] is weight
    assert by.tolist() == [[4 * 3 + 1], [-4 + 1]]


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
def test_two_clipped_objectives_of_the_same_outputs_add_up_or_are_refused_by_a_kernel(compiled):
    trained = learner(network__compiled=compiled, prior__kind="none")
    made, seen = prepared(trained), []

    def by(*clips):
        outputs = trained.policy.unroll_with_vjp(made.obs)
        seen.append(outputs)  # copies know outputs by their identity
        losses = [ppo_loss(trained.policy.head, outputs, made, clip, 0.01) for clip in clips]
        return trained.optimiser.gradient(sum(losses[1:], start=losses[0]))

    if compiled:
        with pytest.raises(UserError, match=r"one clipped objective of the same outputs; set network\.compiled=false"):
            by(0.2, 0.05)
    else:
        torch.testing.assert_close(by(0.2, 0.05), by(0.2) + by(0.05))


def test_every_gradient_of_a_default_run_goes_through_the_equations(monkeypatch):
    """Eq. 3, 4 and 7 to 10 once for each gradient, and supplement eq. 19 for MADDPG and QMIX."""
    counts = {}

    def counted(module, name):
        function = getattr(module, name)

        def call(*args, **kwargs):
            counts[name] = counts.get(name, 0) + 1
            return function(*args, **kwargs)

        monkeypatch.setattr(module, name, call)

    counted(mappo, "ppo_loss")
    for module in (mappo, maddpg, qmix):
        counted(module, "value_loss")
    gap = copies.Term

    def term(on, *rest):
        name = "S_V" if isinstance(on, copies.Values) else "S_pi"
        counts[name] = counts.get(name, 0) + 1
        return gap(on, *rest)

    monkeypatch.setattr(copies, "Term", term)
    counted(copies.Copies, "penalty")
    counted(mappo.SeedAdam, "gradient")
    trained = learner()
    trained.iterate(0.0)
    # two epochs of two minibatches; the symmetry errors are measured once
    steps = {"gradient": 4, "ppo_loss": 4, "penalty": 4, "value_loss": 4}
    assert counts == steps | {"S_pi": 4 + 1, "S_V": 4 + 1}
    for algorithm, actor in (("maddpg", 1), ("qmix", 0)):
        trained = learners.learner(algorithm)
        batch = [trained.iterate(0.0), trained.iterate(0.0)] and trained.replay.sample(3, trained.generators["learner"])
        counts.clear()
        trained.update(batch)
        once = {"S_pi": 1, "S_V": 1} if actor else {"S_V": 1}
        assert counts == {"gradient": 1 + actor, "penalty": 1 + actor, "value_loss": 1} | once


@pytest.mark.parametrize(
    ("equation", "functions"),
    [
        ("Eq. 3", {"ppo_loss"}),
        ("Eq. 4", {"value_loss"}),
        ("Eq. 8, S_pi", {"consistency_gap", "CategoricalPolicies.divergence"}),
        ("Eq. 9, S_V", {"consistency_gap", "value_consistency_loss"}),
        ("Eq. 10, c", {"Copies.penalty"}),
        ("supplement eq. 19, S_Q", {"consistency_gap", "value_consistency_loss"}),
    ],
)
def test_the_page_points_at_the_functions_that_are_counted_above(equation, functions):
    page = (Path(__file__).parents[2] / "docs" / "paper-to-code.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith(f"| {equation} |"))
    code = row.split("|")[3]
    assert functions <= set(re.findall(r"`(?:[\w.]+:)?([\w.]+)`", code))
