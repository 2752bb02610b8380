"""TorchRL: copies in a replay buffer or collector, and a loss with the prior around `ClipPPOLoss` and its like.

symmetry = Symmetry(observation=layout(...), action=discrete_moves(4), group="d4", num_agents=3)
loss = SymmetricLoss(ClipPPOLoss(actor, critic), symmetry, coefficient=0.1)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.transforms import Transform as TorchRLTransform
from torchrl.objectives import A2CLoss, KLPENPPOLoss, LossModule, PPOLoss
from torchrl.objectives.multiagent import QMixerLoss

from esp_cli.loop.divergence import Policy, policy_divergence
from esp_cli.loop.symmetry import Symmetry
from esp_cli.loop.tensordicts import Role, with_copies
from esp_cli.prior.losses import value_consistency_loss
from esp_envs.errors import UserError


class SymmetricCopies(TorchRLTransform):
    """Adds transformed copies to what a replay buffer samples, or a collector delivers (as its `postproc`).

    A collector of one environment delivers time alone, [T]; with copies it is [1 + copies, T], for `GAE` as it is, for
    a replay buffer as `data.reshape(-1)`. In a batch of your own, name the axis that is time: `names=["time"]`.
    `TensorDictReplayBuffer` refuses samples that grow; take `ReplayBuffer`, or extend with `augment_tensordict`.

    Args:
        symmetry: says what the numbers are.
        roles: of keys by their last part, where they differ from `esp_cli.loop.tensordicts.ROLES`.
    """

    def __init__(self, symmetry: Symmetry, roles: Mapping[str, Role] | None = None) -> None:
        super().__init__()
        self.symmetry, self.roles = symmetry, roles

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the data with its copies; see `Symmetry.augment_tensordict`."""
        return self.symmetry.augment_tensordict(tensordict, self.roles)


_TERMS = {"policy": "loss_objective", "value": "loss_critic"}  # which loss of PPO each term is added to


class SymmetricLoss(nn.Module):
    """A loss of TorchRL with both parts of the prior: copies of its data, and consistency (Eq. 10).

    Around `ClipPPOLoss`, `MAPPOLoss`, `IPPOLoss` and `A2CLoss`, S_pi (Eq. 8) is added to "loss_objective" and S_V
    (Eq. 9) to "loss_critic". Around `QMixerLoss`, S_Q of the mixed value (supplement eq. 19) is added to "loss". The
    networks are asked once: what they say of the originals and of the copies is taken from the loss's own pass.

    Args:
        loss: any of these, its keys set.
        symmetry: says what the numbers are.
        coefficient: c of Eq. 10.
        augment: whether the copies enter the loss itself too; without, they are compared alone. Without copies and with
            c = 0, the loss is the plain one, bit for bit.
        roles: of keys by their last part, where they differ from `esp_cli.loop.tensordicts.ROLES`.

    Raises:
        UserError: the loss is of another kind, or a sum over rows.
    """

    def __init__(
        self,
        loss: LossModule,
        symmetry: Symmetry,
        coefficient: float = 0.1,
        augment: bool = True,
        roles: Mapping[str, Role] | None = None,
    ) -> None:
        super().__init__()
        self.mixes = isinstance(loss, QMixerLoss)
        # the penalty on KL needs what the policy said before, which copies do not have
        if isinstance(loss, KLPENPPOLoss) or not isinstance(loss, PPOLoss | A2CLoss | QMixerLoss):
            known = "ClipPPOLoss, MAPPOLoss, IPPOLoss, A2CLoss or QMixerLoss"
            raise UserError(f"{type(loss).__name__} is not known; give {known}")
        if getattr(loss, "reduction", None) == "sum":
            raise UserError("the loss is a sum over rows, but consistency is a mean; give it reduction='mean'")
        self.loss, self.symmetry, self.coefficient = loss, symmetry, coefficient
        self.augment, self.roles = augment, roles

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses of data [B, ...], consistency inside, "policy_symmetry" and "value_symmetry" beside."""
        if not self.augment and not self.coefficient:
            return self.loss(tensordict)
        if not tensordict.batch_dims or not len(tensordict):
            raise UserError(f"the data have batch_size {list(tensordict.batch_size)}; give [B, ...] of one row or more")
        parts, transforms = with_copies(self._needed(tensordict), self.symmetry.transforms, self.roles)
        batches: list[Any] = [torch.cat(parts, 0)] if self.augment else parts
        size = len(tensordict)
        answers = [self._ask(batch, size) for batch in batches]
        losses = answers[0][0]
        if (priority := getattr(self.loss.tensor_keys, "priority", "td_error")) in batches[0].keys(True):
            tensordict.set(priority, batches[0].get(priority)[:size])
        gaps = {}
        if not self.mixes:
            here, *there = (policy for _, policies, _ in answers for policy in policies)
            gaps["policy"] = [policy_divergence(g, p, here) for g, p in zip(transforms, there, strict=True)]
        own, *moved = (value for _, _, values in answers for value in values)
        gaps["value"] = [
            value_consistency_loss(g.values(v, "the value"), own) for g, v in zip(transforms, moved, strict=True)
        ]
        for name, gap in gaps.items():
            mean = torch.stack(gap).mean()
            losses.set(f"{name}_symmetry", mean.detach())
            key = "loss" if self.mixes else _TERMS[name]
            losses.set(key, losses.get(key) + self.coefficient * mean)
        return losses

    def _needed(self, data: TensorDictBase) -> TensorDictBase:
        """Return what the loss reads: with advantages at hand, PPO needs nothing of the next step.

        Missing advantages are those of the originals (Prop. 1), estimated before there are copies along the batch.
        """
        keys = self.loss.tensor_keys
        if self.mixes:
            return data
        if keys.advantage not in data.keys(True):
            data, params = data.clone(False), self.loss.critic_network_params
            params = None if params is None else params.detach()
            self.loss.value_estimator(data, params=params, target_params=self.loss.target_critic_network_params)
        read = [*self.loss.actor_network.in_keys, *self.loss.critic_network.in_keys]
        read += [keys.action, keys.sample_log_prob, keys.advantage, keys.value_target, keys.value]
        return data.select(*read, strict=False)

    def _ask(self, data: TensorDictBase, size: int) -> tuple[TensorDictBase, list[Policy], list[Tensor]]:
        """Return the losses of data, and for each `size` rows of it the policies (none of QMIX) and the values."""
        policies: list[Policy] = []
        value: Tensor | None = None
        critic = self.loss.mixer_network if self.mixes else self.loss.critic_network
        key = self.loss.tensor_keys.global_value if self.mixes else self.loss.tensor_keys.value

        def hear_value(_: nn.Module, __: Any, output: TensorDictBase) -> None:
            nonlocal value
            if value is None or output.get(key).requires_grad:  # not what targets are made of
                value = output.get(key)

        def hear_policy(_: nn.Module, __: Any, output: TensorDictBase) -> None:
            policies[:] = map(actor.build_dist_from_params, output.split(size))

        actor: Any = getattr(self.loss, "actor_network", None)
        hooks = [critic.register_forward_hook(hear_value)]
        if hasattr(actor, "det_part"):
            hooks.append(actor.det_part.register_forward_hook(hear_policy))
        try:
            losses = self.loss(data)
        finally:
            for hook in hooks:
                hook.remove()
        if value is None:
            raise UserError(f"{type(self.loss).__name__} did not ask its critic; give it one")
        if not policies and not self.mixes:
            raise UserError(
                f"{type(actor).__name__} did not say its policy; give a ProbabilisticActor of one distribution"
            )
        return losses, policies, list(value.split(size))
