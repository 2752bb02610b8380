"""What agents of other roles do, and what chance does, decides no verdict: by hand, and with laws that are broken."""

import math

import pytest
import torch

from esp_cli.checking import check_symmetry
from esp_cli.checking.comparison import by_distances
from esp_cli.checking.stepping import outcomes, visit
from esp_cli.checking.verdicts import LATE, ElementVerdict, verdicts_of
from esp_cli.symmetry import build_transform, parse_elements
from esp_envs import BatchedTask, Field, Kind, generators_for, layout, make, register
from esp_envs.base import Step
from esp_envs.spec import TaskSpec
from esp_envs.views import OthersAtRandom, RoleView, worlds_of_role
from tests.checking.faults import Fault, with_fault
from tests.envs.chase import STEPS, Chase
from tests.envs.mpe_roles import WorldComm


class Lame(Chase):
    """The prey's steps up are longer than those down."""

    def _advance(self, world, action):
        world["prey"] = world["prey"] + 0.1 * (action[:, :, 2:] == 2).unsqueeze(-1)
        return super()._advance(world, action)


class Fenced(Chase):
    """The prey is thrown back from places that it rarely reaches."""

    def _advance(self, world, action):
        given = super()._advance(world, action)
        world["prey"] = world["prey"] - 1.0 * (world["prey"] > 4.5)
        return given


def of_role(cls, role: str, transforms: str):
    task = register(cls)
    report = check_symmetry(worlds_of_role(lambda num_envs, seeds: make(task, num_envs, seeds), role), transforms)
    return report.elements[0]


@pytest.mark.parametrize("role", ["hunter", "prey"])
def test_others_act_in_images_as_in_the_scene(role: str) -> None:
    found = of_role(Chase, role, "flip-x")
    assert (found.outcome, found.p_value) == ("holds", 0.0)
    assert {(field.gap, field.share) for field in found.fields} == {(0.0, 0.0)}


@pytest.mark.parametrize(("cls", "least", "most"), [(Lame, 0.5, 0.8), (Fenced, 0.001, 0.2)])
def test_what_breaks_the_law_of_others_is_found_in_the_states_where_it_does(cls, least: float, most: float) -> None:
    found = of_role(cls, "hunter", "flip-x")
    shares = {field.field: field.share for field in found.fields if field.outcome == "broken"}
    assert least < shares["obs.prey"] < most


def test_all_roles_actions_are_turned() -> None:
    env = RoleView(OthersAtRandom(Chase(Chase.Settings(), 2, generators_for([0]))), "hunter")
    transform = build_transform(parse_elements("flip-x", 2), env.spec)
    outcomes(env, [(torch.zeros(1, 2, 3), torch.zeros(1, 2, 2, dtype=torch.int64))], transform, 1, float("inf"))
    drawn = torch.tensor([[[0, 1, 0], [0, 0, 1]]])  # those of the one step are used up
    assert env.turns.image(drawn).tolist() == [[[1, 0, 2], [1, 1, 1]]]


def test_landmarks_have_the_name_by_which_a_role_sees_them() -> None:
    pytest.importorskip("mpe2")
    env = make(register(WorldComm), 1, [0], {"workers": 0})
    assert env.settable()
    assert {role.state.fields[-2].name for role in env.spec.roles} == {"things"}


class Noisy(BatchedTask):
    def _describe(self):
        place = layout(Field("place", Kind.PSEUDOSCALAR))
        return TaskSpec(
            name="noisy", version=1, convention="", num_agents=1, horizon=8, observation=place, action=STEPS,
            state=place, symmetry="flip-x", shared_reward=True,
        )  # fmt: skip

    def _start(self, generator):
        return {"place": self.draw(1, 1, generator=generator)}

    def _advance(self, world, action):
        world["place"] = world["place"] + 0.1 * (2.0 * action - 1).unsqueeze(-1)
        x = world["place"].squeeze(-1)
        drawn = torch.stack([torch.randn(x.shape[1:], generator=g) for g in self.generators])
        return x.abs() + self.noise(x, drawn), {}

    def noise(self, x, drawn):
        return drawn

    def _observe(self, world):
        return world["place"]


class Odd(Noisy):
    """The noise is turned with the scene, so the same chance gives another reward of the same distribution."""

    def noise(self, x, drawn):
        return drawn * x.sign()


class Louder(Noisy):
    """There is more noise on one side."""

    def noise(self, x, drawn):
        return drawn * (1 + 2 * (x > 0))


class Goal(Noisy):
    """Each episode draws which of two places pays, and shows its number; the places may change round."""

    def _describe(self):
        places = Field("places", Kind.SCALAR, 2)
        return TaskSpec(
            name="goal", version=1, convention="", num_agents=1, horizon=8, symmetry="c1", shared_reward=True,
            observation=layout(places, Field("goal", Kind.SCALAR)), action=STEPS, state=layout(places),
        )  # fmt: skip

    def _start(self, generator):
        self.goal = torch.randint(2, (1, self.num_envs, 1), generator=generator)
        return {"places": self.draw(2, 1, generator=generator)}

    def _advance(self, world, action):
        return self.paid(world["places"].squeeze(-1)), {}

    def paid(self, places):
        return places.gather(-1, self.goal)

    def _observe(self, world):
        return torch.cat([world["places"].squeeze(-1), self.goal.float()], -1).unsqueeze(2)


class AnyGoal(Goal):
    """The number says nothing of what pays."""

    def paid(self, places):
        return places.sum(-1, keepdim=True) * (1 + self.goal)


@pytest.mark.parametrize(("cls", "outcome"), [(Goal, "broken"), (AnyGoal, "holds")])
def test_a_reward_is_judged_beside_the_goal_that_an_episode_draws_and_shows(cls, outcome: str) -> None:
    register(cls)
    make_it = lambda num_envs, seeds: cls(cls.Settings(), num_envs, generators_for(seeds))  # noqa: E731
    (found,) = check_symmetry(make_it, "places-1-0").elements
    assert (found.outcome, found.worst.field) == (outcome, "reward" if cls is Goal else found.worst.field)


@pytest.mark.parametrize(("cls", "outcome"), [(Noisy, "holds"), (Odd, "holds"), (Louder, "broken")])
def test_the_same_chance_proves_what_holds_and_refuses_nothing(cls, outcome: str) -> None:
    register(cls)
    (found,) = check_symmetry(lambda num_envs, seeds: cls(cls.Settings(), num_envs, generators_for(seeds))).elements
    reward = next(field for field in found.fields if field.field == "reward")
    assert (found.outcome, reward.outcome) == (outcome, outcome)
    assert (reward.share == 0) == (cls is Noisy)


def test_what_nobody_declared_ends_first() -> None:
    elements = parse_elements("rot90,flip-x", 1)
    judge = lambda element: ElementVerdict(element.name, False, ())  # noqa: E731
    found = verdicts_of(elements, judge, lambda element: element.name == "flip-x", spare=0.0)
    assert [one.reason for one in found] == [LATE, ""]


def test_half_of_the_worlds_follows_the_heuristic(monkeypatch: pytest.MonkeyPatch) -> None:
    env = make("navigation", 4, [0, 1])
    steps, step = [], env.step

    def spied(action: torch.Tensor) -> Step:
        steps.append((env.heuristic(), action))
        return step(action)

    monkeypatch.setattr(env, "step", spied)
    (_, drawn), *_ = visit(env, lambda *_: None, math.inf)
    assert all(torch.equal(wise[:, :2], action[:, :2]) for wise, action in steps)
    assert torch.equal(steps[0][1][:, 2:], drawn[:, 2:])
    assert not torch.equal(steps[0][1], drawn), "the control"


class Told(BatchedTask):
    """The first of some agents sees which of two colours an episode draws; the last one's place pays accordingly."""

    agents = 2

    def _describe(self):
        place = layout(Field("place", Kind.SCALAR))
        return TaskSpec(
            name="told", version=1, convention="", num_agents=self.agents, horizon=8, symmetry="c1", shared_reward=True,
            observation=layout(*place.fields, Field("colour", Kind.SCALAR, 2)), action=STEPS,
            state=layout(Field("place", Kind.SCALAR, self.agents)),
        )  # fmt: skip

    def _start(self, generator):
        self.colour = torch.nn.functional.one_hot(torch.randint(2, (1, self.num_envs), generator=generator), 2).float()
        return {"place": self.draw(self.agents, 1, generator=generator)}

    def _advance(self, world, action):
        world["place"] = self.draw(self.agents, 1)
        return self.paid(world["place"][..., -1, 0]), {}

    def paid(self, place):
        return place * (self.colour[..., 0] - self.colour[..., 1])

    def _observe(self, world):
        seen = torch.zeros(*world["place"].shape[:3], 2)
        seen[..., 0, :] = self.colour
        return torch.cat([world["place"], seen], -1)


class Alone(Told):
    """One agent sees the colour, and both colours pay alike."""

    agents = 1

    def paid(self, place):
        return place


@pytest.mark.parametrize(("cls", "outcome"), [(Told, "not covered"), (Alone, "holds")])
def test_what_no_state_holds_is_judged_by_rows_only_where_nobody_else_is_there(cls, outcome: str) -> None:
    """Told's colours change round only together with the sign of another agent's place, which the first never sees."""
    register(cls)
    make_it = lambda num_envs, seeds: cls(cls.Settings(), num_envs, generators_for(seeds))  # noqa: E731
    (found,) = check_symmetry(make_it, "colour-1-0").elements
    assert (found.outcome, bool(found.reason)) == (outcome, outcome == "not covered")


def sides(*rows):
    return [{"wind": one} for one in rows]


def test_chance_of_another_spread_is_broken_by_the_difference_of_deviations():
    """Of +-1 the mean difference is 1, of +-2 it is 2; over the field's deviation, sqrt(5 / 2), times sqrt(pi) / 2."""
    g = torch.Generator().manual_seed(0)
    coins = [torch.randint(2, (4096, 1), generator=g) * 2.0 - 1 for _ in range(8)]
    found = by_distances("wind", sides(*coins[:4], *(2 * coin for coin in coins[4:])))
    assert found.outcome == "broken"
    assert found.gap == pytest.approx((math.pi / 4 / 2.5) ** 0.5, abs=0.03)
    normal = [torch.randn(4096, 1, generator=g) for _ in range(8)]
    assert by_distances("wind", sides(*normal)).outcome == "holds"
    assert by_distances("wind", sides(*normal[:4], *(1.3 * one for one in normal[4:]))).outcome == "broken"


def test_skewed_chance_is_broken_by_means_of_three_beside_their_medians():
    """Numbers are -1 with 3/4 and 3 with 1/4, their deviation sqrt(3).

    The mean of three is 4/3 above the median where one is 3 (27/64), and below where two are (9/64).
    """
    g = torch.Generator().manual_seed(0)
    rare = [3.0 - 4 * (torch.rand(4096, 1, generator=g) < 0.75) for _ in range(8)]
    found = by_distances("wind", sides(*rare[:4], *(-one for one in rare[4:])))
    assert (found.outcome, found.gap) == ("broken", pytest.approx(2 * 18 / 64 * 4 / 3 / 3**0.5, abs=0.03))
    assert by_distances("wind", sides(*rare)).outcome == "holds"


@pytest.mark.slow
def test_gusts_that_are_skewed_along_one_axis_break_its_mirror_alone():
    """Four exponential numbers less 4 have mean 0, and a sum that is told from its mirror image by skewness alone."""
    g = torch.Generator().manual_seed(0)

    def pushed(action):
        gust = torch.empty(4, *action.shape[:-1]).exponential_(generator=g).sum(0) - 4.0
        return 0.5 * action + torch.stack([0.1 * gust, torch.zeros_like(gust)], -1)

    report = check_symmetry(with_fault("navigation", {"actions": "continuous"}, Fault(done=pushed)), "flip-y,flip-x")
    assert {element.element: element.outcome for element in report.elements} == {"flip-y": "broken", "flip-x": "holds"}
