"""The facade by hand-worked numbers: copies, losses, and what it refuses, each with a control that must differ."""

import math
import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal

from esp_cli import Continuous, Field, Items, Kind, Symmetry, Transitions, discrete_moves, layout
from esp_cli.networks.heads import Categorical
from esp_cli.prior import SeedBatch, SymmetryPrior
from esp_cli.prior.config import PriorConfig
from esp_envs import make

SEEN = layout(Field("velocity", Kind.VECTOR), Field("load", Kind.SCALAR))
MOVES = discrete_moves(4)  # right, up, left, down
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
OTHERS = layout(Field("own", Kind.VECTOR), Field("others", Kind.VECTOR, 2, items=Items.OTHERS))


def random(*shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def quarter(num_agents: int = 1, **choice: object) -> Symmetry:
    return Symmetry(observation=SEEN, action=MOVES, group="rot90", num_agents=num_agents, **choice)  # type: ignore[arg-type]


def test_a_copy_turns_what_is_seen_and_done_and_keeps_the_numbers() -> None:
    obs, action, (log_prob,) = quarter().augment(
        torch.tensor([[1.0, 2.0, 5.0]]), torch.tensor([0]), per_agent=(torch.tensor([-0.7]),)
    )
    assert obs.tolist() == [[1.0, 2.0, 5.0], [-2.0, 1.0, 5.0]]
    assert action.tolist() == [0, 1], "right becomes up"
    assert log_prob.tolist() == pytest.approx([-0.7, -0.7])


def test_all_copies_of_a_group_follow_their_originals() -> None:
    symmetry = Symmetry(observation=SEEN, action=MOVES, group="c4", copies="all")
    obs, action, () = symmetry.augment(torch.tensor([[1.0, 0.0, 5.0]]), torch.tensor([3]))
    assert obs[:, :2].tolist() == [[1, 0], [0, 1], [-1, 0], [0, -1]]
    assert action.tolist() == [3, 0, 1, 2]


def test_a_state_is_all_observations_end_to_end_unless_it_says_otherwise() -> None:
    obs, action = random(4, 2, 3), torch.zeros(4, 2, dtype=torch.int64)
    moved, _, state, _ = quarter(2).augment(obs, action, state=obs.flatten(1))
    assert torch.equal(state, moved.flatten(1))
    other = quarter(2, state=layout(Field("goal", Kind.VECTOR)))
    assert other.augment(obs, action, state=torch.tensor([[1.0, 0.0]] * 4))[2][4:].tolist() == [[0, 1]] * 4


def test_copies_come_in_turn_and_by_name() -> None:
    obs, action = random(4, 2, 3), torch.zeros(4, 2, dtype=torch.int64)
    plain, full = quarter(2).augment(obs, action), quarter(2).augment(obs, action, state=obs.flatten(1))
    assert type(plain) is type(full)
    assert (len(plain), plain.state, plain.per_agent) == (3, None, ())
    assert [full.obs is full[0], full.action is full[1], full.state is full[2], full.per_agent is full[3]] == [True] * 4


def test_it_is_a_module_that_holds_its_draws_alone() -> None:
    class Loop(nn.Module):
        def __init__(self, seed: int) -> None:
            super().__init__()
            self.actor, self.symmetry = nn.Linear(3, 4), Symmetry(observation=SEEN, action=MOVES, group="d4", seed=seed)

    def drawn(loop: Loop) -> list[str]:
        return [loop.symmetry.transforms(random(1, 3))[0].elements[0].name for _ in range(9)]

    one, other, older = Loop(1), Loop(2), Loop(2)
    assert list(one.state_dict()) == ["actor.weight", "actor.bias", "symmetry._extra_state"]
    before = {name: value for name, value in one.state_dict().items() if "symmetry" not in name}
    other.load_state_dict(one.state_dict())
    older.load_state_dict(before)
    assert drawn(one) == drawn(other) != drawn(older) == drawn(Loop(2))
    with pytest.raises(RuntimeError, match=r"Missing key\(s\) in state_dict: \"actor.bias\""):
        older.load_state_dict({"actor.weight": before["actor.weight"]})
    assert one.to(torch.float64).symmetry.augment(random(2, 3), torch.zeros(2, dtype=torch.int64)).obs.shape == (4, 3)
    shown = "group: d4; agents: 1; copies: draw; observation: velocity 2, load 1; action: 4 choices"
    assert repr(one.symmetry) == f"Symmetry({shown})"
    assert "action: force 2" in repr(Symmetry(observation=SEEN, action=FORCE))


def test_like_items_change_places_in_observation_and_state() -> None:
    marks = layout(Field("marks", Kind.SCALAR, 2))
    row, action = torch.tensor([[3.0, 4.0]]), torch.tensor([0])
    for state in (None, layout(Field("goal", Kind.SCALAR), *marks.fields)):
        symmetry = Symmetry(observation=marks, action=MOVES, group="marks-2", state=state)
        seen = row if state is None else torch.tensor([[9.0, 3.0, 4.0]])
        obs, _, moved, () = symmetry.augment(row, action, state=seen)
        assert obs.tolist() == [[3.0, 4.0], [4.0, 3.0]]
        assert moved[1].tolist() == ([4.0, 3.0] if state is None else [9.0, 4.0, 3.0])
    with pytest.raises(ValueError, match="the task has no field 'islands', but marks"):
        Symmetry(observation=marks, action=MOVES, group="islands-2")


@pytest.mark.parametrize("lead", [(5,), (2, 5), (0,), (3, 2, 1)])
@pytest.mark.parametrize("agents", [1, 3])
def test_any_leading_axes_give_what_rows_give(lead: tuple[int, ...], agents: int) -> None:
    axes = (*lead, *((agents,) if agents > 1 else ()))
    obs, action = random(*axes, 3), torch.randint(4, axes)
    got = quarter(agents).augment(obs, action, per_agent=(random(*axes, 1), random(*lead)), dim=len(lead) - 1)
    want = quarter().augment(obs.reshape(-1, 3), action.reshape(-1))
    count = math.prod(lead[-1:])
    assert torch.equal(got[0].narrow(len(lead) - 1, count, count).reshape(-1, 3), want[0][obs[..., 0].numel() :])
    assert torch.equal(got[1].narrow(len(lead) - 1, count, count).reshape(-1), want[1][action.numel() :])


@pytest.mark.gpu
def test_data_on_a_gpu_stay_there_and_give_the_same_numbers() -> None:
    obs, action = random(4, 2, 3), zeros(4, 2)
    here = quarter(2).augment(obs, action, per_agent=(obs[..., 0],))
    there = quarter(2).augment(obs.cuda(), action.cuda(), per_agent=(obs[..., 0].cuda(),))
    assert all(x.is_cuda for x in (*there[:2], *there[2]))
    assert all(torch.equal(x.cpu(), y) for x, y in zip((*there[:2], *there[2]), (*here[:2], *here[2]), strict=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_every_floating_type_is_turned_to_its_own_precision(dtype: torch.dtype) -> None:
    symmetry = Symmetry(observation=SEEN, action=FORCE, group="rot30")
    obs, action, _ = symmetry.augment(torch.tensor([[1, 0, 0]], dtype=dtype), torch.tensor([[0, 1]], dtype=dtype))
    error = (obs[1] - torch.tensor([math.sqrt(3) / 2, 0.5, 0], dtype=torch.float64)).abs().max().item()
    assert obs.dtype == action.dtype == dtype
    assert error <= torch.finfo(dtype).eps


@pytest.mark.parametrize("copies", ["draw", "all"])
def test_gradients_flow_after_a_first_call_in_inference_mode(copies: Any) -> None:
    obs, action = random(4, 3).double(), torch.zeros(4, dtype=torch.int64)
    with torch.inference_mode():
        symmetry = Symmetry(observation=SEEN, action=MOVES, group="c2", copies=copies)
        symmetry.augment(obs, action)
    symmetry.augment(obs.requires_grad_(), action).obs.sum().backward()
    assert obs.grad is not None
    assert obs.grad.tolist() == [[0, 0, 2]] * 4, "the copy's velocity is the other way"


def test_agents_that_change_places_take_their_numbers_along() -> None:
    symmetry = Symmetry(observation=OTHERS, action=MOVES, group="agents-1-2-0", num_agents=3)
    obs, action = random(2, 3, 6), torch.tensor([[0, 1, 2]] * 2)
    numbers = torch.tensor([[10.0, 11.0, 12.0]] * 2)
    moved, done, (per_agent, column, team) = symmetry.augment(
        obs, action, per_agent=(numbers, numbers.unsqueeze(-1), numbers[:, :1])
    )
    assert per_agent[2].tolist() == column[2].flatten().tolist() == [12.0, 10.0, 11.0]
    assert done[2].tolist() == [2, 0, 1]
    assert team[2].tolist() == [10.0]
    assert torch.equal(moved[2, 1, :2], obs[0, 0, :2])


def test_elements_of_a_replay_take_the_shapes_of_copies_and_no_others() -> None:
    """As many rows as agents, so that nothing but the leading axes tells a number of a row from that of an agent."""
    symmetry = Symmetry(observation=OTHERS, action=MOVES, group="rot90*agents-1-2-0", num_agents=3)
    (g,) = symmetry.transforms(random(3, 3, 6))
    numbers, action, team = (
        torch.tensor([[10.0, 11, 12]] * 3),
        torch.tensor([[0, 1, 2]] * 3),
        torch.arange(3.0)[:, None],
    )
    for column in (numbers, numbers.unsqueeze(-1)):
        assert g.per_agent(column).flatten(1).tolist() == [[12, 10, 11]] * 3
        assert g.values(column).flatten(1).tolist() == [[11, 12, 10]] * 3
    assert g.per_agent(team).tolist() == g.values(team).tolist() == team.tolist()
    for given in (action, action.unsqueeze(-1), action.to(torch.uint16)):
        assert g.action(given).flatten(1).tolist() == [[3, 1, 2]] * 3
    assert g.action(nn.functional.one_hot(action, 4)).argmax(-1).tolist() == [[3, 1, 2]] * 3
    for move, wrong in ((g.action, action[:2]), (g.per_agent, random(3, 3, 5)), (g.values, numbers[:2])):
        with pytest.raises(ValueError, match=r"but \[3, 3\]"):
            move(wrong)


def test_actions_may_come_as_a_column_or_one_hot() -> None:
    symmetry, obs, action = quarter(), random(4, 3), torch.arange(4)
    plain = symmetry.augment(obs, action)[1]
    assert torch.equal(symmetry.augment(obs, action.unsqueeze(-1))[1].squeeze(-1), plain)
    one_hot = nn.functional.one_hot(action, 4)
    assert torch.equal(symmetry.augment(obs, one_hot)[1].argmax(-1), plain)


def test_a_policy_that_turns_with_the_scene_has_no_loss() -> None:
    def heading(obs: Tensor) -> Tensor:
        x, y = obs[..., 0], obs[..., 1]
        return torch.stack([x, y, -x, -y], -1)

    symmetry, obs = Symmetry(observation=SEEN, action=MOVES, copies="all"), random(6, 3)
    assert symmetry.policy_loss(heading, obs).item() == pytest.approx(0, abs=1e-6)
    stubborn = symmetry.policy_loss(lambda x: heading(x) + torch.tensor([1.0, 0, 0, 0]), obs)
    assert stubborn.item() > 0.1, "a policy that prefers the right does not turn"


def test_the_value_loss_is_the_squared_gap_and_zero_for_what_is_invariant() -> None:
    state = torch.tensor([[1.0, 2.0, 5.0]])
    symmetry = quarter()
    assert symmetry.value_loss(lambda s: s[..., :2].square().sum(-1), state).item() == 0
    assert symmetry.value_loss(lambda s: s[..., 0], state).item() == (1 - -2) ** 2
    assert symmetry.value_loss(lambda o: o[..., :1], obs=state).item() == 9


def test_values_of_agents_that_change_places_are_compared_with_their_own() -> None:
    symmetry = Symmetry(observation=OTHERS, action=MOVES, group="agents", num_agents=3)
    obs = random(4, 3, 6)
    assert symmetry.value_loss(lambda o: o[..., 0], obs=obs).item() == 0
    assert symmetry.value_loss(lambda o: o[..., 0] * torch.tensor([1.0, 2, 3]), obs=obs).item() > 0.1


def test_action_values_are_pulled_back_before_they_are_compared() -> None:
    obs, q = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[1.0, 2.0, 3.0, 4.0]])
    # at L_g s the value of up stands for right: (2-1)^2, (3-2)^2, (4-3)^2, (1-4)^2
    assert quarter().action_value_loss(lambda _: q, obs).item() == 12 / 4
    assert quarter().action_value_loss(lambda o: q * 0 + o[..., 2:], obs).item() == 0
    with pytest.raises(ValueError, match="action_value_loss needs discrete actions"):
        Symmetry(observation=SEEN, action=FORCE).action_value_loss(lambda _: q, obs)
    team, three = Symmetry(observation=SEEN, action=MOVES, group="d4*agents", num_agents=3), random(3, 3, 3)
    with pytest.raises(ValueError, match=r"value has shape \[3, 4\], but \[3, 3, 4\] is needed"):
        team.action_value_loss(lambda o: o[:, 0, [0, 0, 1, 1]], three)


def test_a_masked_row_does_not_count_and_a_known_answer_is_not_asked_again() -> None:
    state, asked = torch.tensor([[1.0, 2.0, 5.0], [7.0, 7.0, 7.0]]), []

    def value(s: Tensor) -> Tensor:
        asked.append(s)
        return s[..., 0]

    assert quarter().value_loss(value, state, mask=torch.tensor([True, False])).item() == 9
    assert quarter().value_loss(value, state, here=state[:, 0]).item() == (9 + 14**2) / 2
    assert len(asked) == 3
    for kind in (torch.int64, torch.uint8, torch.float32):
        assert quarter().value_loss(value, state, mask=torch.tensor([1, 0], dtype=kind)).item() == 9
    for wrong, told in ((torch.ones(3), r"mask has shape \[3\], .* \[2\]"), (torch.tensor([0.5, 1.0]), "weighs none")):
        with pytest.raises(ValueError, match=told):
            quarter().value_loss(value, state, mask=wrong)


@pytest.mark.parametrize(
    "call",
    [
        lambda s, obs, none: s.value_loss(lambda o: o[..., 0], obs=obs, mask=none),
        lambda s, obs, none: s.action_value_loss(lambda o: o[..., [0, 0, 0, 0]], obs, mask=none),
        lambda s, obs, none: s.policy_loss(lambda o: o[..., [0, 0, 1, 1]], obs, mask=none),
    ],
)
def test_where_no_row_counts_the_loss_and_its_gradient_are_zero(call) -> None:
    obs = random(6, 3).requires_grad_()
    loss = call(quarter(), obs, torch.zeros(6, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0
    assert obs.grad is not None
    assert obs.grad.abs().max().item() == 0
    assert call(quarter(), obs, torch.ones(6, dtype=torch.bool)).item() > 0.1


def test_known_answers_in_another_shape_are_refused_instead_of_broadcast() -> None:
    """|v|^2 is invariant: 0 in one shape, but [B, 1] beside [B] would compare each row with all the others."""
    obs, symmetry = random(6, 3), quarter()

    def value(o: Tensor) -> Tensor:
        return o[..., :2].square().sum(-1, keepdim=True)

    assert symmetry.value_loss(value, obs=obs, here=value(obs)).item() == pytest.approx(0, abs=1e-6)
    message = r"value has shape \[6, 1\] for the moved data, but \[6\] for the originals \(here\); give both"
    with pytest.raises(ValueError, match=message):
        symmetry.value_loss(value, obs=obs, here=value(obs).squeeze(-1))
    with pytest.raises(ValueError, match=r"value has shape \[6, 4\] for the moved data, but \[6, 1\]"):
        symmetry.action_value_loss(lambda o: o[..., [0, 0, 1, 1]], obs, here=value(obs))


def test_a_recurrent_policy_is_compared_over_its_whole_history() -> None:
    """A running sum of the velocities turns with them: the loss is 0 on histories, and not for one that forgets."""
    obs = random(6, 4, 3)  # [T, B, D]

    def heading(history: Tensor, weight: float) -> Tensor:
        total = history[..., :2].cumsum(0) + weight * history[..., :1]
        return torch.cat([total, -total], -1)

    symmetry = quarter()
    assert symmetry.policy_loss(lambda h: heading(h, 0.0), obs).item() == pytest.approx(0, abs=1e-6)
    assert symmetry.policy_loss(lambda h: heading(h, 1.0), obs).item() > 0.1
    assert symmetry.augment(obs, torch.zeros(6, 4, dtype=torch.int64), dim=1)[0].shape == (6, 8, 3)


def zeros(*shape: int) -> Tensor:
    return torch.zeros(*shape, dtype=torch.int64)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (
            lambda s: s.augment(random(5, 2, 4), zeros(5, 2)),
            "obs has rows of 4 numbers, but its layout has 3: velocity",
        ),
        (lambda s: s.augment(random(5, 3, 3), zeros(5, 3)), r"\[5, 3, 3\], but axis -2 must hold 2 agents"),
        (lambda s: s.augment(random(3), zeros(2)), "axis -2 must hold 2 agents"),
        (lambda s: s.augment(random(2, 3), zeros(2)), "has 0 leading axes; copies cannot go along 0"),
        (lambda s: s.augment(random(5, 2, 3), zeros(5, 2) + 4), "the action 4 is outside of the 4 actions, 0 to 3"),
        (lambda s: s.augment(random(5, 2, 3), zeros(5, 2) - 1), "the action -1 is outside of the 4 actions"),
        (lambda s: s.augment(random(5, 2, 3), random(5, 2)), "torch.float32, but indices of 4 actions are integers"),
        (lambda s: s.augment(random(5, 2, 3), zeros(5, 3)), r"the action has shape \[5, 3\], but \[5, 2\] is needed"),
        (lambda s: s.augment(zeros(5, 2, 3), zeros(5, 2)), "obs is torch.int64; give floating-point numbers"),
        (
            lambda s: s.augment(random(5, 2, 3), zeros(5, 2), state=random(5, 7)),
            "state has rows of 7 numbers, but its layout has 6",
        ),
        (
            lambda s: s.augment(random(5, 2, 3), zeros(5, 2), state=random(4, 6)),
            r"state has leading axes \[4\], but those of obs are \[5\]",
        ),
        (
            lambda s: s.augment(random(5, 2, 3), zeros(5, 2), per_agent=(random(5, 2), random(5, 4))),
            r"per_agent\[1\] has shape \[5, 4\], but \[5, 2\] or \[5\] is needed$",
        ),
        (
            lambda s: s.augment(random(5, 2, 3), zeros(5, 2), per_agent=(torch.ones(5, 2, 4, dtype=torch.int8),)),
            r"per_agent\[0\] is torch.int8, but an action mask is torch.bool; give mask.bool\(\)",
        ),
        (
            lambda s: s.augment(random(5, 2, 3), zeros(5, 2), per_agent=(random(5, 2, 64),)),
            "a stored hidden state cannot be transformed; give whole histories",
        ),
        (lambda s: s.augment(random(5, 2, 3).numpy(), zeros(5, 2)), "obs is of type ndarray; give a tensor"),
        (lambda s: s.augment(random(5, 2, 3), [0] * 5), "^action is of type list; give a tensor$"),
        (lambda s: s.augment(random(5, 2, 3), zeros(5, 2), per_agent=random(5, 2)), "per_agent is one tensor; give a"),
        (
            lambda s: s.policy_loss(lambda o: o, random(5, 2, 3), action_mask=torch.ones(5, 2, 3, dtype=torch.bool)),
            r"the action mask is torch.bool \[5, 2, 3\], but torch.bool \[5, 2, 4\] is needed",
        ),
        (
            lambda s: s.policy_loss(lambda o: torch.distributions.Categorical(logits=o), random(5, 2, 3), random(5, 2)),
            r"the policy's outputs have shape \[5, 2, 3\], but there are 4 actions",
        ),
        (lambda s: s.value_loss(lambda x: x), "takes either state or obs"),
        (lambda s: s.value_loss(lambda x: x, random(5, 6)), r"value has shape \[5, 6\], but \[5, 2\] or \[5\]"),
        (lambda s: s.policy_loss(lambda o: o, random(5, 2, 3)), r"shape \[5, 2, 3\], but there are 4 actions"),
        (
            lambda s: s.policy_loss(lambda o: torch.zeros(5, 4), random(5, 2, 3)),
            r"the policy's outputs have the leading axes \[5\], but \[5, 2\] is needed",
        ),
        (lambda s: s.policy_loss(lambda o: (o, o), random(5, 2, 3)), "a stored hidden state cannot be transformed"),
    ],
)
def test_what_does_not_fit_is_told_in_one_sentence(call, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence) as caught:
        call(quarter(2))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda s: s.augment(random(5, 3), zeros(5, 2)), r"the action is torch\.int64; give floating-point numbers"),
        (lambda s: s.augment(random(5, 3), random(5, 3)), r"the action has shape \[5, 3\], but \[5, 2\] is needed"),
        (
            lambda s: s.policy_loss(lambda o: Normal(o[..., :2], 1.0), random(5, 3), here=random(5, 2)),
            r"Normal of the moved data, but of the originals \(here\) there is Tensor",
        ),
    ],
)
def test_what_does_not_fit_forces_is_told(call, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        call(Symmetry(observation=SEEN, action=FORCE, group="rot45"))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"observation": SEEN.fields}, r"observation is \(Field.*; give layout\(Field"),
        ({"action": 4}, "action is 4; give discrete_moves"),
        ({"group": None}, "group is None; give a text"),
        ({"num_agents": "3"}, "num_agents is '3'; give a number of agents"),
        ({"seed": 2**64}, "seed is 18446744073709551616; give a number from 0 to 2"),
        ({"state": SEEN.fields[0]}, r"state is Field.*; give layout\(Field"),
        ({"seed": "a"}, "seed is 'a'; give a number"),
    ],
)
def test_arguments_of_other_kinds_are_told(changed: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        Symmetry(**{"observation": SEEN, "action": MOVES, **changed})  # type: ignore[arg-type]


def test_an_action_mask_turns_with_the_actions() -> None:
    """A quarter turn takes right to up: who may only go right may only go up in the copy."""
    allowed = torch.tensor([[True, False, False, False]])
    _, action, (mask,) = quarter().augment(torch.tensor([[1.0, 2.0, 5.0]]), torch.tensor([0]), per_agent=(allowed,))
    assert mask.tolist() == [[True, False, False, False], [False, True, False, False]]
    assert mask.gather(1, action[:, None]).all()

    ended = torch.tensor([True, False, False, True])  # as many rows as there are actions: flags, and no mask
    assert quarter().augment(random(4, 3), zeros(4), per_agent=(ended,))[2][0].tolist() == ended.tolist() * 2

    def policy(o: Tensor, allowed: Tensor) -> Tensor:
        vx, vy = o[..., 0], o[..., 1]
        return torch.stack([vx, vy, -vx, -vy], -1).masked_fill(~allowed, -torch.inf)  # turns with the velocity

    rows = random(6, 3)
    some = torch.tensor([[True, True, False, False], [True, False, False, True]] * 3)
    assert quarter().policy_loss(policy, rows, action_mask=some).item() == pytest.approx(0, abs=1e-6)
    still = quarter().policy_loss(lambda o, a: policy(o.flip(-1), a), rows, action_mask=some)
    assert math.isfinite(still.item())
    assert still.item() > 0.01


def test_a_check_says_which_shape_is_needed_and_takes_other_precisions() -> None:
    symmetry, (m, t) = quarter(2), (64, 3)
    data = Transitions(random(m, t, 2, 3), torch.randint(4, (m, t, 2)), random(m, t, 2), random(m, t, 2, 3))
    double = Transitions(data.obs.double(), data.action, data.reward.double(), data.next_obs.double())
    assert len({tuple(v.outcome for v in symmetry.check(given, "rot90")) for given in (double, data)}) == 1
    team = Transitions(data.obs, data.action, data.reward[..., 0], data.next_obs)
    with pytest.raises(
        ValueError, match=r"'reward' of the transitions has shape \[64, 3\]; give \[episodes, steps, agen"
    ):
        symmetry.check(team)
    with pytest.raises(ValueError, match=r"nothing to check in Tensor; give a task, or Transitions\(obs, "):
        symmetry.check(data.obs)
    parts = (data.obs, data.action, data.reward, data.next_obs)
    for one, given in ((quarter(), [part[:, 0, 0] for part in parts]), (symmetry, [part[:, 0] for part in parts])):
        with pytest.raises(ValueError, match=r"'obs' of the transitions has shape .*; give \[episodes, steps, agents"):
            one.check(Transitions(*given))
        with pytest.raises(ValueError, match="obs is of type ndarray; give a tensor"):
            one.check(Transitions(*(part.numpy() for part in given)))  # type: ignore[arg-type]


IMPORTED = """
import sys, torch, numpy
before = {name.split(".")[0] for name in sys.modules}
from esp_cli import Symmetry, Field, Kind, layout, discrete_moves
print(sorted({name.split(".")[0] for name in sys.modules} - before - set(sys.stdlib_module_names)))
"""


def test_importing_it_imports_torch_and_numpy_alone() -> None:
    done = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, text=True, check=True)
    assert done.stdout == "['esp_cli', 'esp_envs']\n"
    everything = IMPORTED.replace("import Symmetry", "import load_policy, Symmetry")
    done = subprocess.run([sys.executable, "-c", everything], capture_output=True, text=True, check=True)
    assert "pydantic" in done.stdout, "the check sees what is imported"


def transitions(wind: float, names: tuple[str, ...] = ("right", "up", "left", "down")) -> Transitions:
    """Return 600 episodes of a point that is pushed in one of four directions, and by a wind to the right."""
    generator = torch.Generator().manual_seed(0)
    points = torch.tensor(discrete_moves(names).points)
    velocity, rows = torch.randn(600, 2, generator=generator), []
    for _ in range(4):
        action = torch.randint(4, (600,), generator=generator)
        after = 0.8 * velocity + 0.3 * points[action] + torch.tensor([wind, 0.0])
        rows.append((velocity, action, -after.square().sum(-1), after))
        velocity = after
    return Transitions(*(torch.stack(part, 1) for part in zip(*rows, strict=True)))


def outcomes(symmetry: Symmetry, source: Any, transforms: str | None = None) -> set[str]:
    return {verdict.outcome for verdict in symmetry.check(source, transforms)}


def test_transitions_say_whether_layout_actions_and_group_are_right() -> None:
    point = layout(Field("velocity", Kind.VECTOR))
    symmetry = Symmetry(observation=point, action=MOVES)
    assert outcomes(symmetry, transitions(0.0)) == {"holds"}
    assert "broken" in outcomes(symmetry, transitions(0.2), "rot90,flip-y")
    other = transitions(0.0, ("right", "left", "up", "down"))
    assert "broken" in outcomes(symmetry, other, "rot90"), "the order is another"
    scalars = Symmetry(observation=layout(Field("velocity", Kind.SCALAR, 2)), action=MOVES)
    assert "broken" in outcomes(scalars, transitions(0.0), "rot90"), "the kind is another"
    with pytest.raises(ValueError, match="obs has rows of 2 numbers, but its layout has 3"):
        quarter().check(transitions(0.0))


def test_a_task_is_checked_with_the_layout_that_is_given() -> None:
    env = make("navigation", 64, [0])
    spec = env.spec
    right = Symmetry(observation=spec.observation, action=spec.action, num_agents=3, group="rot90")
    assert outcomes(right, env) == {"holds"}
    other = discrete_moves(["stay", "left", "down", "right", "up"])
    wrong = Symmetry(observation=spec.observation, action=other, num_agents=3, group="rot90")
    assert outcomes(wrong, env) == {"broken"}


@pytest.mark.parametrize("group", ["rot90", "agents-1-0", "flip-x*agents-1-0"])
def test_the_loss_and_its_gradient_are_those_of_the_learners(group: str) -> None:
    """S_pi of a learner's minibatch [S, B, T, N, D] and of the same rows in a loop of one's own."""
    symmetry = Symmetry(observation=SEEN, action=MOVES, group=group, num_agents=2, copies="all")
    weight, obs = nn.Parameter(random(3, 4)), random(1, 6, 2, 2, 3)
    (by_loop,) = torch.autograd.grad(symmetry.policy_loss(lambda x: x @ weight, obs), [weight])
    spaces = replace(symmetry.spaces, symmetry="d4*agents")
    prior = SymmetryPrior(PriorConfig(transforms=group, consistency_coef=1.0), spaces)
    copies = prior.copies(SeedBatch(obs, random(1, 6, 2, 6), torch.zeros(1, 6, 2, 2, dtype=torch.int64)), [])
    head, outputs = Categorical(MOVES), copies.obs @ weight
    loss = copies.penalty(policy=(head, outputs))
    ((_, (by_learner,)),) = loss.gradients([weight])
    torch.testing.assert_close(by_learner.view(3, 4), by_loop)
    assert loss.value.item() == pytest.approx(symmetry.policy_loss(lambda x: x @ weight, obs).item(), rel=1e-5)
    assert (loss.value.item() > 0.1) == (group != "agents-1-0"), "the control: one network keeps the order"


def test_matrices_do_what_the_copies_do() -> None:
    def moved(symmetry: Symmetry, obs: Tensor, outputs: Tensor) -> list[tuple[str, Tensor, Tensor]]:
        flat, done = obs.flatten(-2).double().numpy(), outputs.flatten(-2).double().numpy()
        return [(name, flat @ seen.T, done @ acted.T) for name, seen, acted in symmetry.matrices()]

    symmetry = Symmetry(observation=SEEN, action=MOVES, group="d4*agents", num_agents=2, copies="all")
    obs, one_hot = random(5, 2, 3), torch.eye(4)[torch.randint(4, (5, 2))]
    rows, actions, _ = symmetry.augment(obs, one_hot)
    found = moved(symmetry, obs, one_hot)
    assert [name for name, _, _ in found][:2] == ["rot90", "rot180"]
    assert len(found) == 15
    for k, (_, seen, acted) in enumerate(found, 1):
        assert torch.equal(rows[5 * k : 5 * k + 5].flatten(1), torch.as_tensor(seen, dtype=torch.float32))
        assert torch.equal(actions[5 * k : 5 * k + 5].flatten(1), torch.as_tensor(acted, dtype=torch.float32))
    name, seen, done = Symmetry(observation=SEEN, action=FORCE, group="flip-x").matrices()[0]
    assert (name, seen.tolist(), done.tolist()) == ("flip-x", [[1, 0, 0], [0, -1, 0], [0, 0, 1]], [[1, 0], [0, -1]])
    with pytest.raises(ValueError, match="so2 cannot be listed"):
        Symmetry(observation=SEEN, action=FORCE, group="so2").matrices()


def test_matrices_make_a_consistency_loss_in_jax() -> None:
    jax = pytest.importorskip("jax")
    matrices = Symmetry(observation=SEEN, action=FORCE, group="d4").matrices()

    @jax.jit
    def loss(weight: Any, obs: Any) -> Any:
        return sum(((obs @ L.T @ weight - obs @ weight @ K.T) ** 2).mean() for _, L, K in matrices)

    obs = random(5, 3).numpy()
    equivariant = torch.eye(3, 2).numpy()  # a push along the vector that is seen
    assert loss(equivariant, obs) < 1e-10
    assert abs(jax.grad(loss)(random(3, 2).numpy(), obs)).max() > 0.1


LIMBS = layout(Field("hips", Kind.PSEUDOSCALAR, 4), Field("knees", Kind.SCALAR, 4), Field("speed", Kind.VECTOR))


def test_a_mirror_that_exchanges_limbs_is_one_element_by_hand() -> None:
    symmetry = Symmetry(
        observation=LIMBS,
        action=Continuous(layout(Field("hips", Kind.PSEUDOSCALAR, 4), Field("knees", Kind.SCALAR, 4))),
        group="flip-x*hips-1-0-3-2*knees-1-0-3-2",
    )
    obs, torque = torch.tensor([[1.0, 2, 3, 4, 5, 6, 7, 8, 9, 10]]), torch.tensor([[1.0, 2, 3, 4, 5, 6, 7, 8]])
    rows, actions, _ = symmetry.augment(obs, torque)
    assert rows[1].tolist() == [-2, -1, -4, -3, 6, 5, 8, 7, 9, -10]
    assert actions[1].tolist() == [-2, -1, -4, -3, 6, 5, 8, 7]
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(6000, 1, 10, generator=generator)
    torque = torch.rand(6000, 1, 8, generator=generator) * 2 - 1
    pull = torch.tensor([0.0, 0, 0, 0, 0.3, 0.3, 0, 0, 0.3, 0])
    after = 0.8 * state + 0.3 * torch.cat([torque, torque.new_zeros(6000, 1, 2)], -1) - pull
    data = Transitions(state, torque, -after.square().sum(-1) - after[..., 0] * after[..., 1], after)
    for group, outcome in (
        ("flip-x*hips-1-0-3-2*knees-1-0-3-2", "holds"),
        ("flip-x*hips-2-3-0-1*knees-2-3-0-1", "broken"),
        ("flip-y*hips-1-0-3-2*knees-1-0-3-2", "broken"),
    ):
        told = Symmetry(observation=LIMBS, action=symmetry.spaces.action, group=group)
        assert outcomes(told, data) == {outcome}, group
    with pytest.raises(ValueError, match="field 'hips' has 4 items, not 3; use a group within o2"):
        Symmetry(observation=LIMBS, action=symmetry.spaces.action, group="flip-x*hips-1-0-2")
    strange = layout(Field("what", Kind("strange", 3)))
    with pytest.raises(ValueError, match=r"of kind strange turns; give another group, or fields that say"):
        Symmetry(observation=strange, action=FORCE)
