"""How far a policy at L_g s is from the same policy at s, given as torch distributions (Eq. 8)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch import distributions as td

from esp_cli.loop.shapes import check_alike
from esp_cli.symmetry import Transform
from esp_envs.errors import UserError

Policy = Any  # what a policy returns: a distribution, or a tensor (logits of discrete actions, continuous actions)

SAMPLES = 8  # actions drawn where a divergence has no closed form
# A latent action that a squash sends to the end of its box, and how near to the end, as a share, actions may come
_FAR, _MARGIN = 1e4, 1e-6
_GOLDEN = 0.6180339887498949  # multiples of it, without their whole parts, lie evenly in [0, 1)
_KNOWN = "Categorical, OneHotCategorical, Normal, Independent, or a squashed Normal such as TanhNormal"


def policy_divergence(transform: Transform, there: Policy, here: Policy, samples: int = SAMPLES) -> Tensor:
    """Return KL[pi(K_g . | L_g s) || pi(. | s)] for each agent (Eq. 8): [..., N], or [...] without an agent axis.

    Exact for Categorical and OneHotCategorical; for Normal, under every rotation; for Independent ones of these; and
    for squashed Normals where the squash commutes with K_g, as tanh does with quarter turns and mirrors. Other squashed
    Normals are compared by `samples` reparametrised actions; a turned action outside of the box is clipped to it, as
    environments do. Tensors are logits of discrete actions, or continuous actions; of these it returns half the squared
    distance, the divergence of two Normals of deviation 1. The policy is `there` at L_g s, and `here` at s.
    """
    there, here = _bare(there), _bare(here)
    if transform.action_index is not None:
        if all(isinstance(p, Tensor | td.Categorical | td.OneHotCategorical) for p in (there, here)):
            logits = (p if isinstance(p, Tensor) else p.logits for p in (there, here))
            return _choices_apart(*_both(transform, *logits))
    elif isinstance(there, Tensor) and isinstance(here, Tensor):
        pulled, own = _both(transform, there, here)
        return 0.5 * (pulled - own).square().sum(-1)
    elif isinstance(there, td.Normal) and isinstance(here, td.Normal):
        return _normals_apart(transform, there, here)
    elif _is_squashed(there) and _is_squashed(here):
        inner, own = _bare(there.base_dist), _bare(here.base_dist)
        check_alike("policy", [inner.loc], own.loc)
        if _commutes(transform, own.loc, there.transforms, here.transforms):
            return _normals_apart(transform, inner, own)
        return _samples_apart(transform, there, here, samples)
    if isinstance(there, Tensor) != isinstance(here, Tensor):
        raise UserError(
            f"the policy says {type(there).__name__} of the moved data, but of the originals (here) there is "
            f"{type(here).__name__}; give both in one form"
        )
    action = "discrete" if transform.action_index is not None else "continuous"
    raise UserError(f"the policy's {type(there).__name__} is not known for {action} actions; give {_KNOWN}")


def _bare(policy: Policy) -> Policy:
    """Return a distribution without `Independent` around it."""
    if isinstance(policy, tuple | list):
        raise UserError(
            f"the policy returned {len(policy)} things, but a stored hidden state cannot be transformed; give whole "
            "histories from their first step, and return the distribution alone"
        )
    while isinstance(policy, td.Independent):
        policy = policy.base_dist
    return policy


def _is_squashed(policy: Policy) -> bool:
    return isinstance(policy, td.TransformedDistribution) and isinstance(_bare(policy.base_dist), td.Normal)


def _pulled(transform: Transform, outputs: Tensor) -> Tensor:
    """Pull back outputs at L_g s, after checking their width."""
    width = transform.num_outputs
    if outputs.shape[-1:] != (width,):
        what = "actions" if transform.action_index is not None else "numbers in an action"
        raise UserError(f"the policy's outputs have shape {list(outputs.shape)}, but there are {width} {what}")
    return transform.pull_back(outputs)


def _both(transform: Transform, there: Tensor, here: Tensor) -> tuple[Tensor, Tensor]:
    """Return outputs at L_g s, pulled back, and those at s, after checking both shapes."""
    pulled = _pulled(transform, there)
    check_alike("policy", [pulled], here)
    return pulled, here


def _choices_apart(p: Tensor, q: Tensor) -> Tensor:
    """Return KL[softmax(p) || softmax(q)]; what p excludes by a logit of -inf adds nothing."""
    p, q = p.log_softmax(-1), q.log_softmax(-1)
    return (p.exp() * (p - q).masked_fill(p.isneginf(), 0.0)).sum(-1)


def _normals_apart(transform: Transform, there: td.Normal, here: td.Normal) -> Tensor:
    """Return KL[N(K^-1 m', K^-1 diag(v') K) || N(m, diag(v))]."""
    mean, own = _both(transform, there.loc, here.loc)
    variance, volume = transform.pull_back_variance(there.variance), transform.values(there.variance.log().sum(-1))
    ratio = (variance + (own - mean).square()) / here.variance
    return 0.5 * ((ratio - 1 + here.variance.log()).sum(-1) - volume)


@torch.no_grad()
def _commutes(transform: Transform, like: Tensor, there: list[td.Transform], here: list[td.Transform]) -> bool:
    """Whether turning before the squashes is turning after them, tried on latent actions spread over [-2, 2]."""
    spread = torch.arange(like.numel(), device=like.device, dtype=torch.float64).mul_(_GOLDEN).frac_().mul_(4).sub_(2)
    latent = spread.to(like.dtype).view_as(like)
    turned = _pulled(transform, latent)
    for step in there:
        latent = step(latent)
    for step in here:
        turned = step(turned)
    return torch.allclose(transform.pull_back(latent), turned, rtol=1e-4, atol=1e-6)


def _samples_apart(transform: Transform, there: Policy, here: Policy, samples: int) -> Tensor:
    """Return the mean of log pi(a' | L_g s) - log pi(K_g^-1 a' | s) over drawn a'."""

    def log_prob(policy: Policy, action: Tensor) -> Tensor:
        density = policy.log_prob(action)
        return density.sum(-1) if density.dim() == action.dim() else density

    box, own = _box(there), _box(here)
    gaps = []
    for action in (there.rsample().clamp(*box) for _ in range(samples)):
        home = transform.pull_back(action).clamp(*own)
        gaps.append(transform.values(log_prob(there, action)) - log_prob(here, home))
    return torch.stack(gaps).mean(0)


def _box(policy: td.TransformedDistribution) -> tuple[Tensor, Tensor]:
    """Return the least and the greatest actions of a squashed Normal, a little inside of the ends."""
    low, high = (torch.full_like(policy.base_dist.mean, end) for end in (-_FAR, _FAR))
    for step in policy.transforms:
        low, high = step(low), step(high)
    margin = (max(_MARGIN, 2 * torch.finfo(high.dtype).eps) * (high - low)).nan_to_num(posinf=0)  # a box without end
    return low + margin, high - margin
