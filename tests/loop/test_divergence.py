"""Divergences of turned distributions against densities, by hand and by sampling."""

import math

import pytest
import torch
from torch import Tensor
from torch import distributions as td

from esp_cli import Continuous, Field, Kind, discrete_moves, layout
from esp_cli.loop.divergence import policy_divergence
from esp_cli.symmetry import PlaneElement, Transform, transform_set
from esp_envs.spec import ActionSpace, Items, Spaces

SEEN = layout(Field("velocity", Kind.VECTOR))
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
MOVES = discrete_moves(4)


def element(name: str, action: ActionSpace, num_agents: int = 1) -> Transform:
    state = layout(Field("agents", Kind.VECTOR, num_agents, items=Items.AGENTS))
    spaces = Spaces(num_agents=num_agents, observation=SEEN, state=state, action=action, symmetry="o2*agents")
    return transform_set(name, spaces).each()[0]


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def normal(mean: Tensor, scale: Tensor) -> td.Normal:
    return td.Normal(mean, scale)


def squashed(mean: Tensor, scale: Tensor) -> td.TransformedDistribution:
    return td.TransformedDistribution(td.Independent(td.Normal(mean, scale), 1), [td.TanhTransform()])


def test_a_categorical_is_compared_action_by_turned_action() -> None:
    there, here = torch.tensor([0.1, 0.2, 0.3, 0.4]), torch.tensor([0.4, 0.3, 0.2, 0.1])
    pulled = [0.2, 0.3, 0.4, 0.1]  # the chance of up stands for right
    want = sum(p * math.log(p / q) for p, q in zip(pulled, here.tolist(), strict=True))
    g = element("rot90", MOVES)
    for kind in (td.Categorical, td.OneHotCategorical):
        got = policy_divergence(g, kind(probs=there[None]), kind(probs=here[None]))
        assert got.tolist() == pytest.approx([want], rel=1e-5)
    assert policy_divergence(g, there[None].log(), here[None].log()).item() == pytest.approx(want, rel=1e-5)
    wrong = td.kl_divergence(td.Categorical(there), td.Categorical(here)).item()
    assert wrong != pytest.approx(want, rel=0.1), "without the turn it is another number"


def test_an_action_that_is_masked_out_leaves_gradients_finite() -> None:
    free = torch.tensor([[0.3, 0.1, 0.0, 0.2]], requires_grad=True)
    masked = free.masked_fill(torch.tensor([False, False, True, False]), -torch.inf)
    turned = free.masked_fill(torch.tensor([False, False, False, True]), -torch.inf)
    gap = policy_divergence(element("rot90", MOVES), td.Categorical(logits=turned), td.Categorical(logits=masked))
    gap.sum().backward()
    assert gap.isfinite().all()
    assert free.grad is not None
    assert free.grad.isfinite().all()


@pytest.mark.parametrize("name", ["rot90", "flip-x", "rot30", "flip22.5"])
def test_a_turned_normal_has_the_divergence_of_its_full_covariance(name: str) -> None:
    g = element(name, FORCE)
    there, here = normal(random(5, 2), torch.tensor([0.5, 2.0])), normal(random(5, 2, seed=1), torch.tensor([1.0, 0.7]))
    planar = torch.as_tensor(PlaneElement.of(g.elements[0]).matrix, dtype=torch.float32)  # type: ignore[attr-defined]
    mean, covariance = there.mean @ planar, planar.T @ torch.diag(torch.tensor([0.25, 4.0])) @ planar
    want = td.kl_divergence(
        td.MultivariateNormal(mean, covariance), td.MultivariateNormal(here.mean, here.variance[0].diag())
    )
    torch.testing.assert_close(policy_divergence(g, there, here), want, rtol=1e-4, atol=1e-5)
    wrapped = policy_divergence(g, td.Independent(there, 1), td.Independent(here, 1))
    torch.testing.assert_close(wrapped, want, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(td.kl_divergence(there, here).sum(-1), want, rtol=0.1)


@pytest.mark.parametrize("size", [1.0, 1e-3])  # near 0 a tanh is a line, which commutes with every turn
def test_a_squash_that_commutes_leaves_the_divergence_exact(size: float) -> None:
    mean, scale = size * random(4, 2), torch.tensor([0.3, 0.6])
    other = size * random(4, 2, seed=1)
    for name, exact in (("rot90", True), ("flip-x", True), ("rot30", False)):
        g = element(name, FORCE)
        latent = policy_divergence(g, normal(mean, scale), normal(other, scale))
        got = policy_divergence(g, squashed(mean, scale), squashed(other, scale))
        assert torch.allclose(got, latent, rtol=1e-5) is exact
        assert got.isfinite().all(), "a turned action outside of the box is clipped to it"


def test_a_squash_that_depends_on_the_state_counts() -> None:
    g, unit, uneven = element("rot90", FORCE), normal(torch.zeros(64, 2), torch.ones(64, 2)), torch.tensor([0.5, 1.0])
    for others in ([], [td.TanhTransform()]):

        def scaled(by: Tensor, others: list[td.Transform] = others) -> td.TransformedDistribution:
            return td.TransformedDistribution(unit, [*others, td.AffineTransform(0.0, by.expand(64, -1))])

        assert policy_divergence(g, scaled(uneven.flip(-1)), scaled(uneven)).abs().max() < 1e-5, "it turns"
        for there, here in ((0.5, 1.0), (40.0, 1.0)):
            one, other = torch.tensor([there]), torch.tensor([here])
            gap = policy_divergence(g, scaled(one), scaled(other), samples=99)
            assert gap.isfinite().all(), "what is outside of a box is clipped to it"
            assert gap.mean() > 0.3
            if not others:
                exact = policy_divergence(g, normal(unit.loc, one.expand(64, 2)), normal(unit.loc, other.expand(64, 2)))
                torch.testing.assert_close(gap.mean(), exact.mean(), rtol=0.1, atol=0)


@pytest.mark.slow
def test_samples_agree_with_the_closed_form_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    g, scale = element("rot90", FORCE), torch.tensor([0.3, 0.6])
    policies = squashed(0.3 * random(4, 2), scale), squashed(0.3 * random(4, 2, seed=1), scale)
    exact = policy_divergence(g, *policies)
    monkeypatch.setattr("esp_cli.loop.divergence._commutes", lambda *_: False)
    drawn = policy_divergence(g, *policies, samples=20_000)
    torch.testing.assert_close(drawn, exact, rtol=0.05, atol=0.02)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_samples_at_the_edge_of_a_squash_leave_all_finite(dtype: torch.dtype) -> None:
    mean = (6 * random(64, 2)).to(dtype).requires_grad_()
    g = element("rot45", FORCE)
    gap = policy_divergence(g, squashed(mean, torch.ones_like(mean)), squashed(mean.detach(), torch.ones_like(mean)))
    gap.sum().backward()
    assert gap.isfinite().all()
    assert mean.grad is not None
    assert mean.grad.isfinite().all()


@pytest.mark.parametrize("action", [MOVES, FORCE])
def test_agents_that_change_places_are_compared_with_themselves(action: ActionSpace) -> None:
    g = element("agents-1-2-0", action, num_agents=3)
    width = 4 if action is MOVES else 2
    outputs = random(5, 3, width)
    moved = outputs[:, [2, 0, 1]]  # agent 0 is at place 1 now
    scale = torch.rand(5, 3, width) + 0.5
    if action is MOVES:
        pairs = [(td.Categorical(logits=moved), td.Categorical(logits=outputs))]
    else:
        pairs = [
            (normal(moved, scale[:, [2, 0, 1]]), normal(outputs, scale)),
            (squashed(moved, scale[:, [2, 0, 1]]), squashed(outputs, scale)),
        ]
    for there, here in pairs:
        torch.testing.assert_close(policy_divergence(g, there, here), torch.zeros(5, 3), atol=1e-5, rtol=0)
        assert policy_divergence(g, here, here).mean() > 0.1


@pytest.mark.parametrize(
    ("action", "policy", "sentence"),
    [
        (FORCE, td.Beta(torch.ones(3, 2), torch.ones(3, 2)), "Beta is not known for continuous actions; give Cat"),
        (FORCE, td.Categorical(logits=torch.zeros(3, 4)), "Categorical is not known for continuous actions"),
        (MOVES, normal(torch.zeros(3, 4), torch.ones(4)), "Normal is not known for discrete actions"),
        (MOVES, td.Categorical(logits=torch.zeros(3, 5)), r"shape \[3, 5\], but there are 4 actions"),
        (FORCE, normal(torch.zeros(3, 3), torch.ones(3)), r"shape \[3, 3\], but there are 2 numbers in an action"),
        (FORCE, squashed(torch.zeros(3, 3), torch.ones(3)), r"shape \[3, 3\], but there are 2 numbers in an action"),
    ],
)
def test_what_is_not_known_is_refused(action: ActionSpace, policy: object, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        policy_divergence(element("rot90", action), policy, policy)


@pytest.mark.parametrize(
    ("action", "policy"),
    [
        (MOVES, lambda logits: td.Categorical(logits=logits)),
        (MOVES, lambda logits: logits),
        (FORCE, lambda mean: mean[..., :2]),
        (FORCE, lambda mean: normal(mean[..., :2], torch.ones(2))),
        (FORCE, lambda mean: squashed(mean[..., :2], torch.ones(2))),
    ],
)
def test_policies_of_different_shapes_are_refused_instead_of_broadcast(action: ActionSpace, policy) -> None:
    g, outputs = element("rot90", action), random(3, 4)
    assert policy_divergence(g, policy(outputs), policy(outputs)).shape == (3,)
    with pytest.raises(ValueError, match=r"policy has shape \[3, .\] for the moved data, but \[1, 3, .\] for"):
        policy_divergence(g, policy(outputs), policy(outputs[None]))
