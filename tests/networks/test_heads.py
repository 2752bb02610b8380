"""Policy heads: probabilities by hand, sampling in proportion, bounds, and what a symmetry does to them."""

import math
from types import SimpleNamespace

import pytest
import torch

from esp_cli.networks.heads import BoundedGaussian, Categorical
from esp_cli.networks.policies import GaussianPolicies, WithVJP
from esp_cli.symmetry import transform_set
from esp_envs import Continuous, Field, Kind, TaskSpec, layout, make

SPEC = make("navigation", 1, [0]).spec
FORCE = layout(Field("force", Kind.VECTOR))
WHEELS = layout(Field("wheels", Kind.WHEELS), Field("force", Kind.VECTOR))


def test_categorical_log_probability_and_entropy_by_hand():
    head = Categorical(SPEC.action)
    p = head.normalise(torch.tensor([8.0, 4.0, 2.0, 1.0, 1.0]).log().view(1, 1, 1, 5))  # 1/2 1/4 1/8 1/16 1/16
    assert head.log_prob(p, torch.tensor([[[1]]])).item() == pytest.approx(math.log(0.25))
    assert head.entropy(p).item() == pytest.approx(1.875 * math.log(2))
    assert head.mode(p).item() == 0


def test_categorical_samples_by_inverting_the_cumulative_distribution():
    head = Categorical(SPEC.action)
    p = head.normalise(torch.tensor([8.0, 4.0, 2.0, 1.0, 1.0]).log().expand(1, 6, 1, 5))
    noise = torch.tensor([0.0, 0.49, 0.51, 0.76, 0.9, 0.999999]).view(1, 6, 1)
    assert head.sample(p, noise).flatten().tolist() == [0, 0, 1, 2, 3, 4]


def test_gaussian_log_probability_and_entropy_equal_torch():
    head = BoundedGaussian(Continuous(WHEELS), 2)
    with torch.no_grad():
        head.log_std.copy_(torch.tensor([[0.1, -0.5], [0.3, 0.2]]))
    mean, action = (torch.randn(2, 5, 3, 4) for _ in range(2))
    deviation = head.log_std.exp()[:, [0, 0, 1, 1]].view(2, 1, 1, 4).expand(2, 5, 3, 4)
    theirs = torch.distributions.Independent(torch.distributions.Normal(mean, deviation), 1)
    torch.testing.assert_close(head.log_prob(mean, action), theirs.log_prob(action))
    torch.testing.assert_close(head.entropy(mean), theirs.entropy())


def test_squash_keeps_a_vector_in_the_disc_and_a_wheel_in_its_interval():
    head = BoundedGaussian(Continuous(WHEELS), 1)
    action = head.to_environment(torch.tensor([[[[9.0, -0.5, 30.0, 40.0]]]]))[0, 0, 0]
    torch.testing.assert_close(action[:2], torch.tanh(torch.tensor([9.0, -0.5])))  # each wheel for itself
    torch.testing.assert_close(action[2:], torch.tensor([0.6, 0.8]))  # the vector along its own direction
    assert head.to_environment(torch.zeros(1, 1, 1, 4)).abs().max() == 0


def _continuous_spec() -> TaskSpec:
    return make("navigation", 1, [0], {"actions": "continuous"}).spec


def test_squash_commutes_with_every_rotation():
    head, g = BoundedGaussian(Continuous(FORCE), 1), transform_set("rot37", _continuous_spec(), "cpu").each()[0]
    latent = torch.randn(1, 50, 3, 2) * 2
    torch.testing.assert_close(head.to_environment(g.action(latent)), g.action(head.to_environment(latent)))
    assert not torch.allclose(torch.tanh(g.action(latent)), g.action(torch.tanh(latent))), "negative control"


def test_pulled_back_policy_gives_an_action_the_probability_of_its_image():
    head, g = Categorical(SPEC.action), transform_set("rot90", SPEC, "cpu").each()[0]
    log_probs = head.normalise(torch.randn(1, 20, 3, 5))
    action = torch.randint(5, (1, 20, 3))
    pulled = g.pull_back(log_probs)
    torch.testing.assert_close(head.log_prob(pulled, action), head.log_prob(log_probs, g.action(action)))

    spec = _continuous_spec()
    gaussian, turn = BoundedGaussian(Continuous(FORCE), 1), transform_set("rot37", spec, "cpu").each()[0]
    mean, latent = torch.randn(1, 20, 3, 2), torch.randn(1, 20, 3, 2)
    ours = gaussian.log_prob(turn.pull_back(mean), latent)
    torch.testing.assert_close(ours, gaussian.log_prob(mean, turn.action(latent)), rtol=1e-4, atol=1e-5)


def test_slopes_by_deviations_add_up_over_rows_where_copies_move_items():
    """In the second part the items are exchanged, so its slopes are by the other's deviation; rows may come singly."""
    means, log_std = torch.randn(2, 2, 3, 1, 2), torch.randn(2, 2)
    places = torch.tensor([[0, 1], [1, 0]]).view(1, 2, 1, 1, 2).expand(2, 2, 3, 1, 2)

    def slopes(rows):
        frame = SimpleNamespace(
            pull_outputs=lambda outputs: outputs, pull_items=lambda item, outputs: places[:, :, rows].contiguous()
        )
        outputs = WithVJP(means[:, :, rows], lambda slope: [slope], [means])
        policies = GaussianPolicies(outputs, frame, log_std, torch.arange(2).view(1, 1, 1, 2))
        return policies.add_divergence_slope(None, 1.0)[1]

    torch.testing.assert_close(sum(slopes(slice(k, k + 1)) for k in range(3)), slopes(slice(3)))
