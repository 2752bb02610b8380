"""A symmetry for the training loop that you have: transformed copies of its data, and consistency losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from esp_cli.loop import shapes
from esp_cli.loop.divergence import Policy, policy_divergence
from esp_cli.loop.shapes import Augmented, CheckedTransform, Draws, check_alike, check_state, lead_of, mean_counted
from esp_cli.loop.tensordicts import Role, with_copies
from esp_cli.prior.losses import value_consistency_loss
from esp_cli.symmetry import TransformSet
from esp_cli.symmetry.admission import admitted_elements, unrestricted
from esp_envs.errors import UserError
from esp_envs.spec import ActionSpace, Discrete, Layout, Spaces, joint_layout

if TYPE_CHECKING:
    from esp_cli.checking import ElementVerdict, Transitions
    from esp_envs.base import Environment


class Symmetry(Draws):
    """A known symmetry of a task, as copies of data (Eq. 7) and as losses (Eq. 8, 9) in any training loop.

    symmetry = Symmetry(observation=layout(...), action=discrete_moves(4), group="d4", num_agents=3)
    obs, action, (log_prob, advantage) = symmetry.augment(obs, action, per_agent=(log_prob, advantage))
    loss += 0.1 * symmetry.policy_loss(policy, obs) + 0.1 * symmetry.value_loss(critic, state)

    Shapes: `...` stands for any leading axes, the same in all arguments of a call. Where `num_agents` is 1, the agent
    axis N is left out. Tensors may live on any device and have any floating-point type. Results are new tensors, and
    gradients flow through them. What is invariant under the whole group needs no copy: rewards, dones, returns.

    Whole histories of a recurrent policy are data like any other, with time among the leading axes. A stored hidden
    state is refused: no layout says how its numbers transform.

    Args:
        observation: layout of one agent's D numbers.
        action: of one agent.
        group: the transforms under which dynamics and reward stay the same, as `esp train --transforms` reads them:
            "d4", "o2", "d4*agents", "rot90,flip-x", "flip-x*hips-3-2-1-0", or elements of your own kind. The caller
            vouches for it.
        num_agents: N; 1 also for rows of single agents.
        state: layout of the Ds numbers of the global state; by default all observations end to end.
        copies: "draw" draws one element for each call, "all" takes each element of a finite group.
        seed: of the draws.

    Attributes:
        spaces: what the transforms act on.
        copies: as given.
        generator: draws the elements. Its state is all that `state_dict` holds; a file without it loads too.

    Raises:
        UserError: the actions or layouts cannot carry the group, all elements of an infinite group are asked for, or
            an argument is none of those above.
    """

    def __init__(
        self,
        *,
        observation: Layout,
        action: ActionSpace,
        group: str = "d4",
        num_agents: int = 1,
        state: Layout | None = None,
        copies: Literal["draw", "all"] = "draw",
        seed: int = 0,
    ) -> None:
        shapes.check_arguments(observation, action, group, num_agents, state, copies, seed)
        super().__init__({"group": group, "agents": num_agents, "copies": copies}, observation, action, seed)
        state = state or joint_layout(observation, num_agents)
        spaces = Spaces(num_agents=num_agents, observation=observation, state=state, action=action, symmetry="c1")
        self.spaces = unrestricted(spaces)
        self.group, self.copies = group, copies
        self._sets: dict[tuple[torch.device, torch.dtype], TransformSet] = {}
        if not self._set(torch.device("cpu"), torch.float32).is_finite and copies == "all":
            raise UserError(f"copies='all' needs a finite group, but '{group}' is infinite or large; use copies='draw'")

    @torch.inference_mode(False)  # as what is kept serves training too
    def transforms(self, obs: Tensor, lead: torch.Size | None = None) -> list[CheckedTransform]:
        """Return the elements of one call, one drawn or all, for data [*lead, ...] with observations [*lead, N, D]."""
        lead = lead_of(self.spaces, obs) if lead is None else lead
        chosen = self._set(obs.device, torch.float64 if obs.dtype == torch.float64 else torch.float32)
        drawn = chosen.each() if self.copies == "all" else [chosen.draw([self.generator])]
        return [shapes.checked(g, lead) for g in drawn]

    def augment(
        self,
        obs: Tensor,
        action: Tensor,
        *,
        state: Tensor | None = None,
        per_agent: Sequence[Tensor] = (),
        dim: int = 0,
    ) -> Augmented:
        """Return the data with its copies (L_g s, K_g a) behind it; a copy keeps the numbers of its original (Eq. 7).

        Args:
            obs: [..., N, D].
            action: [..., N] indices of discrete actions, also [..., N, 1] or one-hot [..., N, A]; or [..., N, width].
            state: [..., Ds].
            per_agent: numbers [..., N] or [..., N, 1] that go with their agents (log-probability, advantage), or
                [...] or [..., 1] of the whole team; also flags [..., N, A] of the discrete actions (an action mask),
                which go with the actions.
            dim: the leading axis along which copies are added: 0, or that of the batch where time comes first.

        Returns:
            obs, action, (state where it is given,) and per_agent, in turn or by name, with 1 + copies times the rows.

        Raises:
            UserError: a shape that does not fit the layouts, or an action outside.
        """
        lead = lead_of(self.spaces, obs)
        if isinstance(per_agent, Tensor):
            raise UserError("per_agent is one tensor; give a tuple of them, as per_agent=(log_prob, advantage)")
        if not 0 <= dim < len(lead):
            raise UserError(
                f"obs of shape {list(obs.shape)} has {len(lead)} leading axes; copies cannot go along {dim}"
            )
        transforms = self.transforms(obs)

        def joined(x: Tensor, images: list[Tensor]) -> Tensor:
            return torch.cat([x, *images], dim)

        parts = [joined(obs, [g.obs(obs) for g in transforms]), joined(action, [g.action(action) for g in transforms])]
        if state is not None:
            check_state(self.spaces, state, lead)
            parts.append(joined(state, [g.state(state) for g in transforms]))
        numbers = (joined(x, [g.along(x, f"per_agent[{i}]") for g in transforms]) for i, x in enumerate(per_agent))
        return Augmented((*parts, tuple(numbers)))

    def augment_tensordict(self, data: Any, roles: Mapping[str, Role] | None = None) -> Any:
        """Return a TensorDict [B, ...] with its copies behind it, along the first axis that is not named "time".

        Where all axes are time, as of a collector of one environment, copies have a new first axis: [1 + copies, T]. So
        nothing that reads along time (advantages, returns of n steps) goes from one copy to the next.

        Keys are known by their last part: observation, state, action. Others hold numbers that go with their agents, or
        one for each row. What networks said (logits, loc, scale) and "info" are left out.

        Args:
            data: with agents in nested groups or not, also below "next".
            roles: of keys by their last part, where `esp_cli.loop.tensordicts.ROLES` says it otherwise.

        Raises:
            UserError: the numbers under a key do not fit, or have no role.
        """
        parts, _ = with_copies(data, self.transforms, roles)
        axes = [axis for axis, name in enumerate(data.names) if name != "time"]
        return torch.cat(parts, axes[0]) if axes else torch.stack(parts)

    def policy_loss(
        self,
        policy: Callable[..., Policy],
        obs: Tensor,
        here: Policy = None,
        mask: Tensor | None = None,
        action_mask: Tensor | None = None,
    ) -> Tensor:
        """Return S_pi = KL[pi(K_g . | L_g s) || pi(. | s)] (Eq. 8), averaged over rows, agents and elements.

        It is 0 if and only if the policy turns with the scene.

        Args:
            policy: obs [..., N, D] to a distribution of actions, or to a tensor, as `policy_divergence` knows them.
            obs: [..., N, D]; of a recurrent policy, whole histories.
            here: what the policy says of `obs`, where it is known already; detached, it stays fixed.
            mask: [...] which rows count, as flags or as 0 and 1; the loss is 0 where none does.
            action_mask: flags [..., N, A], which discrete actions are allowed; then the policy is asked for
                `policy(obs, action_mask)`, of moved data with the moved mask.

        Raises:
            UserError: a shape that does not fit, or a distribution that is not known.
        """
        lead = lead_of(self.spaces, obs)
        shapes.check_mask(self.spaces, action_mask, lead)
        masks = () if action_mask is None else (action_mask,)
        here = policy(obs, *masks) if here is None else here
        gaps = [
            policy_divergence(g, policy(g.obs(obs), *map(g.push_outputs, masks)), here) for g in self.transforms(obs)
        ]
        for gap in gaps:
            shapes.check_rows(self.spaces, gap, lead)
        return mean_counted(gaps, mask)

    def value_loss(
        self,
        value: Callable[[Tensor], Tensor],
        state: Tensor | None = None,
        *,
        obs: Tensor | None = None,
        here: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Return S_V = (V(s) - V(L_g s))^2 (Eq. 9), averaged over rows, agents and elements.

        Args:
            value: the state, or the observations, to values [...], [..., 1], [..., N] or [..., N, 1].
            state: [..., Ds], for a critic that takes the state.
            obs: [..., N, D], for one that takes the observations; give one of the two.
            here: the values of the originals, where they are known already, in the shape that `value` gives.
            mask: [...] which rows count; the loss is 0 where none does.

        Raises:
            UserError: a shape that does not fit.
        """
        if state is not None and obs is None:
            data, lead = state, check_state(self.spaces, state)
        elif obs is not None and state is None:
            data, lead = obs, lead_of(self.spaces, obs)
        else:
            raise UserError("value_loss takes either state or obs; give the one that the critic sees")
        here = value(data) if here is None else here
        transforms = self.transforms(data, lead)
        carried = [g.values(value(g.obs(data) if state is None else g.state(data)), "value") for g in transforms]
        check_alike("value", carried, here)
        return mean_counted([value_consistency_loss(x, here) for x in carried], mask)

    def action_value_loss(
        self, value: Callable[[Tensor], Tensor], obs: Tensor, here: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Return S_Q = (Q(s, a) - Q(L_g s, K_g a))^2 over all discrete actions (supplement eq. 19), averaged.

        Args:
            value: obs [..., N, D] to one value per action [..., N, A].
            obs: [..., N, D].
            here: the values of the originals, where they are known already, in the shape that `value` gives.
            mask: [...] which rows count; the loss is 0 where none does.

        Raises:
            UserError: a shape that does not fit, or continuous actions.
        """
        if not isinstance(self.spaces.action, Discrete):
            raise UserError("action_value_loss needs discrete actions; compare the values of continuous ones yourself")
        lead_of(self.spaces, obs)
        here = value(obs) if here is None else here
        pulled = [g.action_values(value(g.obs(obs))) for g in self.transforms(obs)]
        check_alike("value", pulled, here)
        return mean_counted([value_consistency_loss(x, here) for x in pulled], mask)

    def check(self, source: Environment | Transitions, transforms: str | None = None) -> list[ElementVerdict]:
        """Judge for each element and field whether a task is as symmetric as you say: holds, broken, or not covered.

        A wrong layout, action order or group shows as "broken". Without an agent axis where `num_agents` is 1.

        Args:
            source: a task of this application, or transitions [M, T, N, ...] of episodes from their starts, made by a
                policy that prefers no direction, such as the uniformly random one.
            transforms: which elements; by default those of the group.

        Raises:
            UserError: the transforms mean nothing, nothing of them can be carried, or the transitions are fewer than
                64 episodes, hold numbers that are not finite, or actions outside.
        """
        from esp_cli.checking import Transitions, candidates, check_transitions, collect  # noqa: PLC0415 - it trains too
        from esp_envs.base import Environment  # noqa: PLC0415

        if not isinstance(source, Environment | Transitions):
            raise UserError(
                f"there is nothing to check in {type(source).__name__}; give a task, or Transitions(obs, ...)"
            )
        data = source if isinstance(source, Transitions) else collect(source)
        for name, part in vars(data).items():
            if part is not None:
                shapes.check_tensor(name, part)
        if len(lead_of(self.spaces, data.obs)) == 2 and self.spaces.num_agents == 1:
            data = data.map(lambda x: x.unsqueeze(2))
        spaces = replace(self.spaces, symmetry=self.group)
        return check_transitions(spaces, data, candidates(spaces, transforms or self.group))

    def matrices(self) -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
        """Return (name, L_g, K_g) of each element for other libraries: `obs.reshape(-1, N * D) @ L_g.T`.

        L_g [N D, N D] and K_g [N A, N A] act on the rows of all agents end to end, K_g on one number per discrete
        action or on continuous actions. An infinite or large group is refused, and so are items that are sorted.
        """
        if field := next((field for field in self.spaces.observation.fields if field.sorted_by), None):
            raise UserError(f"'{field.name}' is sorted anew, which no matrix does; use obs and push_outputs")

        def matrix(move: Callable[[Tensor], Tensor], width: int) -> NDArray[np.float64]:
            count = self.spaces.num_agents
            return move(torch.eye(count * width).double().view(-1, count, width)).flatten(1).T.numpy()

        elements, width = self._set(torch.device("cpu"), torch.float64).each(), self.spaces.observation.width
        return [(g.elements[0].name, matrix(g.obs, width), matrix(g.push_outputs, g.num_outputs)) for g in elements]

    @torch.inference_mode(False)
    def _set(self, device: torch.device, dtype: torch.dtype) -> TransformSet:
        key = (device, dtype)
        if key not in self._sets:
            elements = admitted_elements(self.group, self.spaces, shapes.ANOTHER)
            self._sets[key] = TransformSet(elements, self.spaces, *key)
        return self._sets[key]
