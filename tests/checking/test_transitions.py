"""Symmetry from transitions alone, for tasks that cannot be set to a state and for data of others."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from esp_cli.checking import Transitions, candidates, check_recorded, check_transitions, collect, named
from esp_cli.checking.candidates import is_declared, refused, turns_freely
from esp_cli.symmetry import parse_elements
from esp_envs import make
from esp_envs.mpe.task import FORCE
from esp_envs.spec import Continuous, Discrete, Field, Items, Kind, Spaces, discrete_moves, layout
from tests.benchmarks.synthetic import Recipe
from tests.checking.faults import Fault, as_scalars, declared, first_counts_more, wind, with_fault

CONTINUOUS = {"actions": "continuous"}


def outcomes(make_worlds, text: str = "rot90,flip-x,flip-y") -> dict[str, str]:
    env = make_worlds(128, [0])
    elements = parse_elements(text, env.spec.num_agents)
    return {v.element: v.outcome for v in check_transitions(env.spec, collect(env, episodes=3072), elements)}


@pytest.mark.parametrize(("task", "settings"), [("navigation", {}), ("predator-prey", CONTINUOUS)])
def test_a_clean_task_is_not_accused(task, settings) -> None:
    found = outcomes(lambda n, seeds: make(task, n, seeds, settings), "rot90,flip-x,agents-1-0-2")
    assert "broken" not in found.values()
    assert found["agents-1-0-2"] == "holds"
    assert task == "predator-prey" or set(found.values()) == {"holds"}, "captures are rare: turns are not covered"


def test_wind_breaks_what_turns_it() -> None:
    found = outcomes(with_fault("navigation", CONTINUOUS, wind(0.1)))
    assert found == {"rot90": "broken", "flip-x": "holds", "flip-y": "broken"}


def test_a_vector_declared_as_scalars_is_found() -> None:
    fault = declared(as_scalars, "landmarks")
    assert outcomes(with_fault("navigation", {}, fault), "rot90")["rot90"] == "broken"


def test_an_agent_that_is_paid_otherwise_is_found() -> None:
    found = outcomes(with_fault("navigation", {}, Fault(paid=first_counts_more)), "rot90,agents-1-0-2")
    assert found == {"rot90": "holds", "agents-1-0-2": "broken"}


def test_starts_that_are_not_symmetric_are_not_covered() -> None:
    env = make("formation", 64, [0], {"horizon": 20, "num_agents": 4})
    (verdict,) = check_transitions(env.spec, collect(env, episodes=256), parse_elements("rot90", 4))
    assert verdict.outcome == "not covered"
    assert "the starts differ from their image by" in verdict.reason


def anybodys(drift: float) -> tuple[Spaces, Transitions]:
    """Two points that somebody simulated elsewhere."""
    g = torch.Generator().manual_seed(0)
    row = layout(Field("position", Kind.VECTOR), Field("other", Kind.VECTOR, items=Items.OTHERS))
    state = layout(Field("position", Kind.VECTOR, 2, items=Items.AGENTS))
    spaces = Spaces(num_agents=2, observation=row, state=state, action=FORCE, symmetry="o2*agents")
    position, action = torch.randn(2, 1500, 4, 2, 2, generator=g).unbind()
    after = position + 0.1 * action + 0.05 * torch.randn(position.shape, generator=g) + torch.tensor([drift, 0.0])

    def seen(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([x, x.flip(2) - x], -1)

    return spaces, Transitions(seen(position), action, -after.norm(dim=-1), seen(after))


@pytest.mark.parametrize(
    ("drift", "tried", "found"), [(0.0, None, "o2*agents"), (0.02, "d4,agents-1-0", "flip-x*agents")]
)
def test_anybodys_transitions_are_judged(drift: float, tried: str | None, found: str) -> None:
    spaces, data = anybodys(drift)
    assert check_recorded("theirs", spaces, data, tried).found == found


def test_a_gap_is_in_standard_deviations_of_the_field() -> None:
    """A half turn turns a drift of 0.02 round: one of two numbers is off by 0.04, and each has the variance 0.0125."""
    spaces, data = anybodys(0.02)
    (verdict,) = check_transitions(spaces, data, parse_elements("rot180", 2))
    gaps = {field.field: field.gap for field in verdict.fields}
    assert gaps["obs.position"] == pytest.approx((0.04**2 / 2 / 0.0125) ** 0.5, rel=0.15)
    assert verdict.worst is not None
    assert (verdict.outcome, verdict.worst.field) == ("broken", "obs.position")


def paid(reward: Callable[[torch.Tensor], torch.Tensor], turn: float = 0.0) -> dict[str, str]:
    """Return what is said of elements where a point in a disc moves by its force, turned, and is paid there."""
    g = torch.Generator().manual_seed(0)
    row = layout(Field("position", Kind.VECTOR))
    spaces = Spaces(num_agents=1, observation=row, state=row, action=FORCE, symmetry="c1")
    angle, area = torch.rand(2, 2, 2048, 4, 1, generator=g)
    disc = area.sqrt().unsqueeze(-1) * torch.stack([(2 * math.pi * angle).cos(), (2 * math.pi * angle).sin()], -1)
    position, action = disc
    cos, sin = math.cos(turn), math.sin(turn)
    after = position + 0.1 * action @ torch.tensor([[cos, sin], [-sin, cos]])
    data = Transitions(position, action, reward(after), after)
    elements = parse_elements("rot45,rot90,rot180,rot120,flip-x,flip-y", 1)
    return {verdict.element: verdict.outcome for verdict in check_transitions(spaces, data, elements)}


def test_places_that_nobody_sees_are_no_symmetry() -> None:
    places = 0.7 * torch.tensor([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    found = paid(lambda x: ((x.unsqueeze(-2) - places).norm(dim=-1) < 0.25).any(-1).float())
    assert (found.pop("flip-x"), found.pop("rot120")) == ("holds", "holds")
    assert set(found.values()) == {"broken"}


def test_a_square_is_no_circle() -> None:
    found = paid(lambda x: -x.abs().amax(-1), turn=0.5)
    assert (found["rot90"], found["rot180"]) == ("holds", "holds")
    assert (found["rot45"], found["flip-x"]) == ("broken", "broken")


def test_starts_in_a_square_accuse_no_mirror_between_its_axes() -> None:
    """Means and spreads of a square are those of a disc, and its corners are not."""
    env = Recipe.drawn(2083).make(2048, [0])
    (verdict,) = check_transitions(env.spec, collect(env, 2048), parse_elements("flip22.5", env.spec.num_agents))
    assert (verdict.outcome, verdict.fields) == ("not covered", ())
    assert "differ from their image" in verdict.reason


@pytest.mark.parametrize(("drift", "found"), [(0.1, "broken"), (0.0, "holds")])
def test_what_always_moves_alike_is_turned_too(drift: float, found: str) -> None:
    spaces, data = gusts()
    row = layout(Field("velocity", Kind.VECTOR), Field("buoy", Kind.VECTOR))
    spaces = replace(spaces, observation=row, state=row)
    place = torch.randn(data.obs.shape, generator=torch.Generator().manual_seed(1))
    after = 0.8 * data.obs, place + torch.tensor([drift, 0.0])
    data = replace(data, obs=torch.cat([data.obs, place], -1), next_obs=torch.cat(after, -1))
    verdicts = check_transitions(spaces, data, parse_elements("rot180,flip-x", 1))
    assert {v.element: v.outcome for v in verdicts} == {"rot180": found, "flip-x": "holds"}


def test_a_reward_that_never_comes_is_not_covered_and_one_that_is_noise_is() -> None:
    noise = torch.Generator().manual_seed(1)
    assert set(paid(lambda x: 0 * x[..., 0]).values()) == {"not covered"}
    assert set(paid(lambda x: torch.randn(x.shape[:-1], generator=noise)).values()) == {"holds"}


def test_few_steps_of_a_law_without_chance_cover_it_where_some_are_far_out() -> None:
    """If the rarest rewards of this draw count as the next, the reward is not covered: p is 0.3."""
    g = torch.Generator().manual_seed(63)
    start, pushed = torch.randn(400, 1, 1, 2, generator=g), torch.randint(4, (400, 1, 1), generator=g)
    after = 0.8 * start + 0.3 * torch.tensor(discrete_moves(4).points)[pushed]
    row = layout(Field("velocity", Kind.VECTOR))
    spaces = Spaces(num_agents=1, observation=row, state=row, action=discrete_moves(4), symmetry="d4")
    data = Transitions(start, pushed, -after.square().sum(-1), after)
    (verdict,) = check_transitions(spaces, data, parse_elements("rot90", 1))
    assert verdict.outcome == "holds"
    assert verdict.p_value < 1e-6


def test_one_exchange_is_not_all_orders() -> None:
    swap, around, last = parse_elements("agents-1-0-2,agents-1-2-0,agents-0-2-1", 3)
    assert named([swap], [swap, last])[0] == "c1 and agents-1-0-2"
    assert named([swap, around], [swap, around, last])[0] == "c1 and agents-1-0-2,agents-1-2-0", "one did not hold"
    assert [named(found, found)[0] for found in ([swap, last], [swap, around])] == ["c1*agents", "c1*agents"]


@pytest.mark.parametrize(
    ("tried", "found"),
    [
        ("rot90", "c4"),
        ("rot90,flip-x", "d4"),
        ("rot180", "c2"),
        ("flip-x", "flip-x"),
        ("rot45", "c8"),
        ("rot60", "c6"),
        ("c6", "c6"),
        ("d5", "d5"),
        ("rot120,flip-x", "d3"),
        ("o2", "o2"),
        ("so2", "so2"),
        ("c8,rot57", "so2"),
    ],
)
def test_what_the_tried_elements_generate_is_found(tried: str, found: str) -> None:
    elements = candidates(anybodys(0.0)[0], tried)
    assert named(elements, elements)[0] == found


def test_any_angle_needs_the_steps_too() -> None:
    tried = parse_elements("c8,rot57", 2)
    assert named(tried[1:], tried)[0] != "so2"


def test_an_order_that_is_declared_alone_is_declared() -> None:
    spaces, _ = anybodys(0.0)
    swap, turn, both = parse_elements("agents-1-0,rot90,rot90*agents-1-0", 2)
    spaces = replace(spaces, symmetry="rot90*agents-1-0")
    assert [is_declared(one, spaces) for one in (swap, turn, both)] == [False, False, True]


@pytest.mark.parametrize("name", ["obs", "action", "reward", "next_obs"])
def test_transitions_that_say_nothing_are_refused(name: str) -> None:
    spaces, data = anybodys(0.0)
    with pytest.raises(ValueError, match="there are 63 episodes of transitions; record at least 64"):
        check_transitions(spaces, data.episodes(slice(63)), candidates(spaces))
    getattr(data, name)[-1] = torch.nan
    with pytest.raises(ValueError, match=f"'{name}' of the transitions holds numbers that are not finite"):
        check_transitions(spaces, data, candidates(spaces))


def test_actions_that_are_no_indices_are_refused() -> None:
    env = make("navigation", 64, [0])
    data = collect(env, episodes=64)
    for wrong in (data.action + 1, data.action - 1, data.action.float()):
        with pytest.raises(ValueError, match="'action' of the transitions holds other than the indices 0 to 4"):
            check_transitions(env.spec, replace(data, action=wrong), candidates(env.spec))


def test_what_no_action_carries_is_not_tried() -> None:
    spec = make("navigation", 1, [0]).spec
    assert "rot45" not in {element.name for element in candidates(spec)}
    with pytest.raises(ValueError, match="no transform can be tried on navigation: action 'left' turned by 45"):
        candidates(spec, "rot45")
    told = "action 'left' turned by 45 degrees is no action"
    left_out = refused(spec, "c8")
    assert [one.element for one in left_out] == ["rot45", "rot135", "rot225", "rot315"]
    assert (left_out[0].reason, {one.declared for one in left_out}) == (told, {False})
    assert refused(spec) == ()
    declared = refused(replace(spec, symmetry="c8"))
    assert [(one.element, one.declared) for one in declared] == [(one.element, True) for one in left_out]


def test_a_declared_element_that_no_action_carries_is_not_covered() -> None:
    env = make("navigation", 64, [0])
    spec, data = replace(env.spec, symmetry="c8"), collect(env, 64)
    for asked, holds in (("rot90", True), ("rot90,rot45", False)):
        report = check_recorded("data", spec, data, asked)
        assert "rot45" not in report.broken
        assert ("rot45" in report.uncovered) is not holds


@pytest.mark.parametrize(("rays", "group"), [(0, "o2"), (120, "d120")])
def test_a_turn_by_some_rays_stands_for_no_other_angle(rays: int, group: str) -> None:
    force = layout(Field("force", Kind.VECTOR))
    seen = layout(Field("goal", Kind.VECTOR), *([Field("ring", Kind.RING, rays=rays)] if rays else []))
    spaces = Spaces(num_agents=1, observation=seen, state=seen, action=Continuous(force), symmetry="c1")
    tried = candidates(spaces)
    assert "rot57" in {element.name for element in tried}
    assert named(tried, tried, freely=turns_freely(spaces)) == (group, f"discovered:{group}")


def test_what_moves_no_number_is_not_tried() -> None:
    numbers = layout(Field("speed", Kind.SCALAR))
    push = Discrete(Kind.SCALAR, ((0.0,), (1.0,)), ("stay", "push"))
    spaces = Spaces(num_agents=1, observation=numbers, state=numbers, action=push, symmetry="o2")
    with pytest.raises(ValueError, match=r"no transform can be tried on the task: rot45 moves no number of it"):
        candidates(spaces)
    leaning = replace(spaces, observation=layout(Field("speed", Kind.SCALAR), Field("lean", Kind.PSEUDOSCALAR)))
    flips = ["flip-x", "flip-diagonal", "flip-y", "flip-antidiagonal"]
    assert [element.name for element in candidates(leaning, "d4")] == flips, "turns move nothing of it"
    assert [element.name for element in candidates(leaning)] == ["flip-x"], "all mirrors are one"


def gusts(kind: torch.dtype = torch.float32) -> tuple[Spaces, Transitions]:
    """One point, moved by gusts along one diagonal."""
    g = torch.Generator().manual_seed(0)
    row = layout(Field("velocity", Kind.VECTOR))
    spaces = Spaces(num_agents=1, observation=row, state=row, action=discrete_moves(4), symmetry="d4")
    start, gust = torch.randn(4000, 1, 1, 2, generator=g), torch.randn(4000, 1, 1, 1, generator=g)
    action = torch.randint(4, (4000, 1, 1), generator=g)
    after = 0.8 * start + 0.3 * torch.tensor(discrete_moves(4).points)[action] + 0.5 * gust
    return spaces, Transitions(start, action.to(torch.int32), (start.square().sum(-1) < 1).to(kind), after)


def test_gusts_along_one_diagonal_break_what_turns_it() -> None:
    spaces, data = gusts()
    found = check_transitions(spaces, data, parse_elements("rot90,rot180,flip-x", 1))
    assert {v.element: v.outcome for v in found} == {"rot90": "broken", "rot180": "holds", "flip-x": "broken"}


@pytest.mark.parametrize(("skewed", "found"), [(True, "broken"), (False, "holds")])
def test_chance_that_leans_to_one_side_breaks_what_turns_it_round(skewed: bool, found: str) -> None:
    """Four exponential numbers less 4 have mean 0; so have two less two others, which lean to no side."""
    spaces, data = gusts()
    drawn = torch.empty(4, 4000, 1, 1).exponential_(generator=torch.Generator().manual_seed(1))
    gust = drawn.sum(0) - 4 if skewed else drawn[:2].sum(0) - drawn[2:].sum(0)
    moved = replace(data, next_obs=0.8 * data.obs + 0.2 * torch.stack([gust, torch.zeros_like(gust)], -1))
    verdicts = check_transitions(spaces, moved, parse_elements("rot180,flip-x,flip-y", 1))
    assert {v.element: v.outcome for v in verdicts} == {"rot180": found, "flip-y": found, "flip-x": "holds"}


def test_numbers_of_any_type_are_taken() -> None:
    (_, of_flags), (spaces, of_numbers) = gusts(torch.bool), gusts()
    found = [check_transitions(spaces, data, parse_elements("rot180", 1)) for data in (of_flags, of_numbers)]
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("field", "flag", "told"),
    [("action_mask", "masks", "action mask"), ("terminated", "terminates", "end"), ("alive", "agents_end", "alive")],
)
def test_a_log_may_spell_out_that_a_task_without_masks_and_ends_has_none(field: str, flag: str, told: str) -> None:
    env = make("navigation", 128, [0])
    data = collect(env, 128)
    nothing = torch.full(data.reward.shape, field != "terminated")
    if field == "action_mask":
        nothing = nothing.unsqueeze(-1).expand(-1, -1, -1, env.spec.action.count)
    data = replace(data, **{field: nothing})
    for spec, left in ((env.spec, []), (replace(env.spec, **{flag: True}), [told])):
        (found,) = check_transitions(spec, data, parse_elements("rot90", spec))
        assert [one.field for one in found.fields if one.error == 0 and one.outcome == "not covered"] == left
