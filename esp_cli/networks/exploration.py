"""Heads of learners that explore by a schedule: epsilon-greedy values, exploring choices, noisy bounded actions.

Each has one number `epsilon` per seed, which the learner moves and which is kept with the policy, so that a policy file
still knows how its last behaviour explored.
Shapes: outputs [S, ..., N, outputs], action [S, ..., N] (discrete) or [S, ..., N, width].
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.autograd import Function
from torch.nn.functional import mse_loss

from esp_cli.networks.heads import MASKED, Bounded, Categorical, Choice, Head, best, drawn, squash
from esp_envs.base import random_choice
from esp_envs.spec import ActionSpace


class ExploringHead(Head):
    """A head with a measure of exploration per seed, `epsilon` [S] in [0, 1]."""

    def __init__(self, space: ActionSpace, num_seeds: int) -> None:
        super().__init__(space, num_seeds)  # of the head beside this one
        self.epsilon: Tensor
        self.register_buffer("epsilon", torch.ones(num_seeds))

    def explore(self, epsilon: float) -> None:
        self.epsilon.fill_(epsilon)

    def _epsilon(self, like: Tensor) -> Tensor:
        return self.epsilon.view(-1, *[1] * (like.dim() - 1))


class EpsilonGreedy(ExploringHead, Choice):
    """Outputs are action values; the best action, or with probability epsilon a uniformly random one."""

    def noise(self, shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
        """Draw, per seed, whether to explore and where to: uniform [S, *shape, 2]."""
        return drawn(torch.rand, (*shape, 2), generators)

    def sample(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Explore where the first number is below epsilon; the second then names the action."""
        whether, where = noise.unbind(-1)
        if self.masks:
            anything = random_choice(outputs > MASKED / 2, where)
        else:
            anything = (where * self.num_outputs).long().clamp_(max=self.num_outputs - 1)
        return torch.where(whether < self._epsilon(whether), anything, self.mode(outputs))

    def mode(self, outputs: Tensor) -> Tensor:
        return best(outputs)


class ExploringCategorical(ExploringHead, Categorical):
    """One of A allowed actions with probabilities (1 - epsilon) softmax(outputs) + epsilon / A."""

    def sample(self, log_probs: Tensor, noise: Tensor) -> Tensor:
        """Draw an action from the mixture by inverting its cumulative distribution at `noise`."""
        share = self._epsilon(log_probs)
        uniform = share / self.num_outputs
        if self.masks:
            allowed = log_probs > MASKED / 2
            uniform = share * allowed / allowed.sum(-1, keepdim=True)
        return Categorical.sample(self, ((1 - share) * log_probs.exp() + uniform).log(), noise)

    @property
    def choices(self) -> Tensor:
        """All actions, encoded: [A, A]."""
        return torch.eye(self.num_outputs, device=self.epsilon.device)

    def relaxed(self, log_probs: Tensor, noise: Tensor) -> Tensor:
        """Draw one-hot actions [..., A] through which gradients flow, by noise uniform in [0, 1).

        Straight-through Gumbel-softmax (Jang et al., 2017, at temperature 1). Forward: the one-hot of argmax(log p +
        Gumbel), which is a draw from p. Backward: the gradient of softmax(log p + Gumbel).
        """
        gumbel = noise.clamp(1e-7, 1 - 1e-7).log_().neg_().log_().neg_()
        return _StraightThrough.apply(log_probs + gumbel)  # type: ignore[no-untyped-call]

    def penalty(self, log_probs: Tensor) -> Tensor:
        """Return the mean square of the centred logits, which keeps a policy from getting too sure: [S, B, N]."""
        if not self.masks:
            columns = log_probs.movedim(-1, 1)  # as they lie in memory, so that their gradient lies alike
            middle = columns.detach().mean(1, keepdim=True)  # the gradient by which is 0
            return mse_loss(columns, middle.expand_as(columns), reduction="none").mean(1)
        allowed = log_probs > MASKED / 2
        count = allowed.sum(-1, keepdim=True)
        known = torch.where(allowed, log_probs, 0.0)
        centred = torch.where(allowed, known - known.sum(-1, keepdim=True) / count, 0.0)
        return centred.square().sum(-1) / count.squeeze(-1)

    def statistics(self, log_probs: Tensor) -> dict[str, Tensor]:
        """Return what is worth logging of the outputs: the entropy without epsilon, [S, B, N]."""
        return {"entropy": self.entropy(log_probs)}


class _StraightThrough(Function):
    """One-hot rows of the largest of logits [..., A], with the gradient of their softmax; equal ones share the one."""

    @staticmethod
    def forward(ctx, logits):  # type: ignore[no-untyped-def]
        columns = logits.movedim(-1, 1).contiguous()
        soft = torch.softmax(columns, 1)
        ctx.save_for_backward(soft)
        largest = (soft - soft.amax(1, keepdim=True)).sign_().add_(1)
        return largest.div_(largest.sum(1, keepdim=True)).movedim(1, -1)

    @staticmethod
    def backward(ctx, grad):  # type: ignore[no-untyped-def]
        (soft,) = ctx.saved_tensors
        inner = soft * grad.movedim(-1, 1)
        return inner.addcmul_(soft, inner.sum(1, keepdim=True), value=-1).movedim(1, -1)


class BoundedPoint(ExploringHead, Bounded):
    """A deterministic action: outputs squashed to the bounds. Behaviour adds Gaussian noise of deviation epsilon to it.

    The noisy action goes back to the bounds: planar vectors to the unit disc, other numbers to [-1, 1]. Squash, noise
    and bounds commute with every rotation and reflection of the action.
    """

    def sample(self, outputs: Tensor, noise: Tensor) -> Tensor:
        """Return the action plus noise, back within the bounds."""
        noisy = self.mode(outputs) + self._epsilon(outputs) * noise
        return noisy / (noisy.square() @ self.disc).sqrt().clamp_min(1.0)

    def mode(self, outputs: Tensor) -> Tensor:
        return squash(outputs, self.disc)

    def divergence(self, p: Tensor, q: Tensor) -> Tensor:
        """Return half the squared distance of the actions, the KL of two Gaussians of deviation 1: [S, B, N]."""
        return 0.5 * (self.mode(p) - self.mode(q)).square().sum(-1)

    def relaxed(self, outputs: Tensor, noise: Tensor) -> Tensor:
        return self.mode(outputs)

    def penalty(self, outputs: Tensor) -> Tensor:
        """Return the mean square of the outputs, which pulls also where the squash is flat: [S, B, N]."""
        return outputs.square().mean(-1)

    def statistics(self, outputs: Tensor) -> dict[str, Tensor]:
        """Return what is worth logging of the outputs: the share of actions at their bounds, [S, B, N]."""
        length = (self.mode(outputs).square() @ self.disc).sqrt()
        return {"saturation": (length > SATURATED).float().mean(-1)}


SATURATED = 0.99  # length from which a bounded action counts as one at its bounds

ActorHead = ExploringCategorical | BoundedPoint
