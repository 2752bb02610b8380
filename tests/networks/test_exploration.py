"""How policies with a schedule explore, what they remember, and how they turn with the world."""

import pytest
import torch

from esp_cli.networks.build import NETWORKS
from esp_cli.networks.exploration import BoundedPoint, EpsilonGreedy, ExploringCategorical
from esp_cli.networks.policy import HistoryPolicy
from esp_cli.symmetry import transform_set
from esp_cli.training.build import generators
from esp_envs.registry import make
from esp_envs.spec import Continuous, Field, Kind, layout

SEEDS = (0, 1)
DISCRETE = make("navigation", 1, SEEDS).spec
PLANAR = make("navigation", 1, SEEDS, {"actions": "continuous"}).spec
WHEELS = Continuous(layout(Field("wheels", Kind.WHEELS), Field("push", Kind.VECTOR), Field("lift", Kind.SCALAR)))


def frequencies(head, outputs, draws=4000):
    noise = head.noise((draws, 1), generators(SEEDS, "noise"))
    action = head.sample(outputs.view(2, 1, 1, -1).expand(2, draws, 1, -1), noise)
    return torch.stack([torch.bincount(row.flatten(), minlength=5) for row in action]) / draws


def test_epsilon_greedy_takes_the_best_action_but_for_its_share_of_random_ones():
    head = EpsilonGreedy(DISCRETE.action, 2)
    outputs = torch.tensor([[0.0, 0.0, 3.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0]])
    head.epsilon.copy_(torch.tensor([0.5, 0.0]))
    shares = frequencies(head, outputs)
    torch.testing.assert_close(shares[0], torch.tensor([0.1, 0.1, 0.6, 0.1, 0.1]), atol=0.03, rtol=0)
    assert shares[1].tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]
    head.explore(1.0)
    torch.testing.assert_close(frequencies(head, outputs), torch.full((2, 5), 0.2), atol=0.03, rtol=0)


def test_an_exploring_choice_mixes_its_probabilities_with_uniform_ones():
    head = ExploringCategorical(DISCRETE.action, 2)
    log_probs = torch.tensor([0.7, 0.3, 1e-9, 1e-9, 1e-9]).log().expand(2, 5)
    head.epsilon.copy_(torch.tensor([0.5, 0.0]))
    shares = frequencies(head, log_probs)
    torch.testing.assert_close(shares[0], torch.tensor([0.45, 0.25, 0.1, 0.1, 0.1]), atol=0.03, rtol=0)
    torch.testing.assert_close(shares[1], torch.tensor([0.7, 0.3, 0.0, 0.0, 0.0]), atol=0.03, rtol=0)


def test_straight_through_draws_follow_the_probabilities_and_pass_the_soft_gradient():
    head = ExploringCategorical(DISCRETE.action, 1)
    logits = torch.tensor([0.5, 0.1, 0.2, 0.1, 0.1]).log().expand(1, 20_000, 5).clone().requires_grad_()
    noise = torch.rand(1, 20_000, 5, generator=torch.Generator().manual_seed(0))
    drawn = head.relaxed(logits, noise)
    assert torch.equal(drawn.detach().round(), drawn.detach().round().clamp(0, 1))
    torch.testing.assert_close(drawn.sum(-1), torch.ones(1, 20_000))
    torch.testing.assert_close(
        drawn.mean(1), torch.tensor([[0.5, 0.1, 0.2, 0.1, 0.1]]), atol=0.015, rtol=0, check_stride=False
    )
    weight = torch.arange(5.0)
    (ours,) = torch.autograd.grad((drawn * weight).sum(), logits)
    gumbel = -(-noise.clamp(1e-7, 1 - 1e-7).log()).log()
    soft = torch.softmax(logits + gumbel, -1)
    (theirs,) = torch.autograd.grad((soft * weight).sum(), logits)
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("space", [PLANAR.action, WHEELS], ids=["planar", "wheels"])
def test_a_bounded_action_and_its_noise_stay_within_the_bounds(space):
    head = BoundedPoint(space, 2)
    outputs = 10 * torch.randn(2, 500, 3, space.width)
    greedy = head.mode(outputs)
    head.explore(0.7)
    noisy = head.sample(outputs, head.noise((500, 3), generators(SEEDS, "noise")))
    for action in (greedy, noisy):
        for field, span in zip(space.layout.fields, space.layout.slices().values(), strict=True):
            part = action[..., span]
            size = part.norm(dim=-1) if field.kind == Kind.VECTOR else part.abs()
            assert size.max() <= 1 + 1e-6
    assert not torch.equal(greedy, noisy)
    head.explore(0.0)
    torch.testing.assert_close(head.sample(outputs, torch.ones_like(outputs)), greedy)


def test_the_penalty_pulls_at_outputs_whose_action_no_longer_moves():
    head = BoundedPoint(WHEELS, 1)
    outputs = torch.full((1, 1, 1, WHEELS.width), 30.0, requires_grad=True)
    (squashed,) = torch.autograd.grad(head.relaxed(outputs, outputs).sum(), outputs)
    assert squashed.abs().max() < 1e-8
    (pull,) = torch.autograd.grad(head.penalty(outputs).sum(), outputs)
    torch.testing.assert_close(pull, torch.full_like(pull, 2 * 30.0 / WHEELS.width))


def test_a_bounded_point_at_zero_has_a_finite_gradient():
    head = BoundedPoint(PLANAR.action, 1)
    latent = torch.zeros(1, 1, 1, 2, requires_grad=True)
    (gradient,) = torch.autograd.grad(head.mode(latent).sum(), latent)
    torch.testing.assert_close(gradient, torch.ones_like(latent))


def test_squash_noise_and_bounds_turn_with_the_world():
    head = BoundedPoint(PLANAR.action, 2)
    head.explore(0.5)
    latent, noise = 2 * torch.randn(2, 40, 3, 2), torch.randn(2, 40, 3, 2)
    g = transform_set("o2", PLANAR).draw(generators(SEEDS, "draws"))
    plain = head.sample(latent, noise)
    turned = head.sample(g.action(latent), g.action(noise))
    torch.testing.assert_close(turned, g.action(plain), atol=1e-5, rtol=1e-5)
    assert not torch.allclose(turned, plain, atol=1e-2)
    torch.testing.assert_close(g.pull_back(turned), plain, atol=1e-5, rtol=1e-5)


def policy(name, continuous):
    spec = PLANAR if continuous else DISCRETE
    head = BoundedPoint(spec.action, 2) if continuous else EpsilonGreedy(spec.action, 2)
    return spec, HistoryPolicy(spec, NETWORKS[name](hidden=(8,)), generators(SEEDS, "policy"), head, 1.0)


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("name", ["mlp", "gru"])
def test_unrolling_an_episode_equals_acting_through_it(name, continuous):
    spec, acts = policy(name, continuous)
    obs = torch.randn(2, 4, 6, 3, spec.observation.width)
    memory, actions, outputs = acts.initial_memory(4, obs), [], []
    for t in range(6):
        outputs.append(acts.step(obs[:, :, t], memory)[0])
        action, memory = acts.act(obs[:, :, t], memory)
        actions.append(action)
    done = torch.stack(actions[:5], 2)
    torch.testing.assert_close(acts.unroll(obs, done), torch.stack(outputs, 2), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(acts.unroll(obs[:, :, :5], done), torch.stack(outputs[:5], 2), atol=1e-5, rtol=1e-5)


def test_a_recurrent_policy_reads_its_previous_action_and_a_perceptron_does_not():
    for name, reads in (("gru", True), ("mlp", False)):
        spec, acts = policy(name, False)
        obs = torch.randn(2, 4, 6, 3, spec.observation.width)
        action = torch.zeros(2, 4, 5, 3, dtype=torch.int64)
        other = action.clone()
        other[:, :, 2] = 1
        one, two = acts.unroll(obs, action), acts.unroll(obs, other)
        assert torch.equal(one[:, :, :3], two[:, :, :3])
        assert torch.equal(one[:, :, 3:], two[:, :, 3:]) is not reads


def test_the_noise_of_a_continuous_action_has_the_deviation_epsilon_by_hand():
    """In the bounds as it is, and where it leads beyond them back onto them: (3, 4) / 5."""
    head = BoundedPoint(Continuous(layout(Field("force", Kind.VECTOR))), 1)
    still, noise = torch.zeros(1, 1, 1, 2), torch.tensor([1.0, 0.0])
    head.explore(0.1)
    torch.testing.assert_close(head.sample(still, noise).flatten(), torch.tensor([0.1, 0.0]))
    head.explore(1.0)
    torch.testing.assert_close(head.sample(still, torch.tensor([3.0, 4.0])).flatten(), torch.tensor([0.6, 0.8]))
