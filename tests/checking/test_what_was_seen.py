"""What no single step from a state shows is found in later steps; what data could not have refused does not hold."""

from dataclasses import replace
from typing import ClassVar

import pytest
import torch

from esp_cli.checking import check_symmetry, check_transitions, collect, paired
from esp_cli.checking.verdicts import LATE, Late
from esp_cli.symmetry import parse_elements
from esp_envs import BatchedTask, Field, Kind, generators_for, layout
from esp_envs.settings import TaskSettings
from esp_envs.spec import Continuous, Items, TaskSpec, discrete_moves


class Settings(TaskSettings):
    horizon: int = 25


class Point(BatchedTask):
    """One agent in the plane; it is paid for being near the middle. All turns and mirrors hold."""

    Settings = Settings
    size, speed, more, ends, hides = 1.0, 0.1, (), False, ()
    states: ClassVar[bool] = True

    def _describe(self):
        place = Field("position", Kind.VECTOR, 1, "length")
        return TaskSpec(
            name="point",
            version=1,
            convention="own",
            num_agents=1,
            horizon=self.settings.horizon,
            observation=layout(place, *self.more),
            state=layout(Field("position", Kind.VECTOR, 1, "length", Items.AGENTS)),
            action=Continuous(layout(Field("force", Kind.VECTOR))),
            symmetry="d4",
            settings={},
            terminates=self.ends,
            hidden=self.hides,
        )

    def _start(self, generator):
        place = self.size * self.draw(1, 2, generator=generator)
        return {"position": place, "before": torch.zeros_like(place)}

    def _advance(self, world, action):
        world["position"] = world["position"] + self.moved(world, action)
        world["before"] = action
        return self.paid(world["position"][:, :, 0]), {}

    def _observe(self, world):
        return world["position"]

    def moved(self, world, action):
        return self.speed * action

    def paid(self, place):
        return -place.norm(dim=-1)

    def settable(self):
        return self.states


class LateWind(Point):  # a wind that nobody sees, of the second half of an episode
    def _start(self, generator):
        world = super()._start(generator)
        return world | {"time": torch.zeros_like(world["position"][..., :1])}

    def moved(self, world, action):
        world["time"] = world["time"] + 1
        return 0.1 * action + 0.1 * (world["time"] > 50) * torch.tensor([1.0, 0.0])


def test_what_begins_late_in_an_episode_is_followed_there():
    make = lambda count, seeds: LateWind(Settings(horizon=100), count, generators_for(seeds))  # noqa: E731
    found = {element.element: element.outcome for element in check_symmetry(make, "rot90,flip-x").elements}
    assert found == {"rot90": "broken", "flip-x": "holds"}


class Delayed(Point):  # the action before this one moves, along x more
    hides = ("previous action",)

    def moved(self, world, action):
        return 0.1 * world["before"] * torch.tensor([2.0, 0.5])


class Paid(Point):  # in the last step for the place along x
    def paid(self, place):
        return super().paid(place) + 10 * place[..., 0] * (self._time == self.settings.horizon - 1)


class Slow(Point):  # steps of millimetres in a field of 100 m, with a wind
    size, speed = 50.0, 0.005

    def moved(self, world, action):
        return self.speed * (action + torch.tensor([0.5, 0.0]))


class Beside(Point):  # a flag beside a number that is a thousand times as large
    more = (Field("numbers", Kind.SCALAR, 2),)

    def _observe(self, world):
        place = world["position"]
        numbers = [1000 * place.norm(dim=-1, keepdim=True), 0.2 * (place[..., :1] > 0)]
        return torch.cat([place, *numbers], -1)


class Cost(Point):  # a goal that play never reaches, and a cost in each step
    def paid(self, place):
        return torch.where(place[..., 0] > 30, 100.0, -1.0)


class NoEnd(Point):  # an end where play never goes
    ends = True

    def _ended(self, world):
        return world["position"][:, :, 0, 0] > 30


class End(NoEnd):
    def _ended(self, world):
        return world["position"][:, :, 0, 0] > 0.9


class Leaving(Point):  # an agent that ends where play never goes
    far = 30.0

    def _describe(self):
        return replace(super()._describe(), agents_end=True)

    def _living(self, world):
        return world["position"][..., 0] < self.far


class LeavingSoon(Leaving):
    far = 0.5


class Masked(Point):  # where a move is forbidden, as play never goes there
    def _describe(self):
        return replace(super()._describe(), action=discrete_moves(4), masks=True)

    def _allow(self, world):
        return (world["position"][..., :1] < 30).expand(-1, -1, -1, 4)

    def moved(self, world, action):
        return self.speed * torch.tensor(self.spec.action.points)[action]


class Walled(Point):  # in the east, further out than play goes; the place is a part of a record
    def _describe(self):
        thing = Field("position", Kind.RECORD, parts=(Field("place", Kind.VECTOR),))
        return replace(super()._describe(), observation=layout(thing), state=layout(thing))

    def _advance(self, world, action):
        paid = super()._advance(world, action)
        world["position"] = torch.minimum(world["position"], torch.tensor([4.0, torch.inf]))
        return paid


class Seldom(Point):  # nearly all reward is in one step of five hundred
    def paid(self, place):
        near = (place - torch.tensor([0.7, 0.0])).norm(dim=-1) < 0.05
        return torch.where(near, 100.0, 0.1 * super().paid(place))


class Windy(Point):  # a wind that nobody sees from the tenth step on, along x
    def moved(self, world, action):
        return self.speed * action + 0.3 * (self._time > 10) * torch.tensor([1.0, 0.0])


class WindyToAnEnd(Windy):
    ends = True

    def _ended(self, world):
        return world["position"][:, :, 0].norm(dim=-1) < 0.1


class WindyByChance(Windy):
    def moved(self, world, action):
        return super().moved(world, action) + 0.1 * self.draw(1, 2)


class Street(Point):  # where gusts blow along one diagonal
    def moved(self, world, action):
        gust = self.draw(1, 1)
        return 0.1 * action + 0.1 * torch.cat([gust, gust], -1)


class PaidByGust(Point):  # for the gust that it was moved by, up; each number by itself may have either sign
    def moved(self, world, action):
        self.gust = self.draw(1, 2)
        return 0.1 * action + 0.1 * self.gust

    def paid(self, place):
        return self.gust[:, :, 0, 1]


class Skewed(Point):  # gusts of mean 0 along y, seldom and strong up, often and weak down
    def moved(self, world, action):
        up = -((self.draw(1, 1) + 1) / 2).clamp_min(1e-7).log() - 1
        return 0.1 * action + 0.3 * torch.cat([self.draw(1, 1), up], -1)


class Coins(Point):  # one for x and one for y
    def moved(self, world, action):
        return 0.1 * action + 0.3 * self.draw(1, 2).sign()


class Meadow(Point):  # in a field of 100 m, with small gusts
    size = 50.0

    def moved(self, world, action):
        return 0.1 * action + 0.01 * torch.stack(
            [torch.randn(self.num_envs, 1, 2, generator=g) for g in self.generators]
        )


def verdict(task, element, from_transitions=False):
    report = check_symmetry(lambda n, seeds: task(Settings(), n, generators_for(seeds)), element, from_transitions)
    (found,) = report.elements
    return found.outcome, {field.field for field in found.fields if field.outcome == found.outcome}


@pytest.mark.parametrize(
    ("task", "field"), [(Delayed, "reward"), (Paid, "reward"), (Slow, "obs.position"), (Beside, "obs.numbers")]
)
def test_a_breaking_is_found_that_builds_up_later_or_is_small_beside_other_numbers(task, field):
    outcome, fields = verdict(task, "rot90")
    assert (outcome, field in fields) == ("broken", True)


@pytest.mark.parametrize(
    ("task", "element", "mirror", "field"),
    [
        (WindyToAnEnd, "rot90", "flip-x", "obs.position"),
        (WindyByChance, "rot90", "flip-x", "obs.position"),
        (Street, "flip-x", "flip-diagonal", "obs.position"),
        (PaidByGust, "flip-x", "flip-y", "fields together"),
        (Skewed, "flip-x", "flip-y", "obs.position"),
    ],
)
def test_breakings_by_chance_or_before_an_end_are_found(task, element, mirror, field):
    outcome, fields = verdict(task, element)
    assert (outcome, field in fields) == ("broken", True)
    assert verdict(task, mirror)[0] == "holds"


@pytest.mark.parametrize(("task", "outcome"), [(Coins, "holds"), (Street, "broken")])
def test_an_episode_of_one_step_is_played_so_often_that_chance_is_judged(task, outcome):
    make = lambda count, seeds: task(Settings(horizon=1), count, generators_for(seeds))  # noqa: E731
    (found,) = check_symmetry(make, "flip-x").elements
    assert found.outcome == outcome


@pytest.mark.parametrize("task", [Point, Paid, Slow, Beside, Delayed, End, Meadow])
def test_mirrors_that_are_left_hold(task):
    mirror = {Point: "rot90"}.get(task, "flip-x")
    assert verdict(task, mirror)[0] == "holds"


class Raising(Point):  # that stands still on the right, and raises where the second step finds it on the left
    def _start(self, generator):
        return {name: value.abs() for name, value in super()._start(generator).items()}

    def moved(self, world, action):
        if self._time and float(world["position"][..., 0].min()) < 0:
            raise ValueError("too far to the left")
        return 0 * action


class Lost(Raising):
    hides = ("what was done",)


def test_what_the_state_leaves_out_is_not_covered_where_no_later_step_tells():
    assert verdict(Lost, "flip-y") == ("not covered", set())


def test_a_task_that_raises_in_steps_that_follow_images_is_judged_by_the_others():
    assert verdict(Raising, "flip-y")[0] == "holds"


class Calm(Point):  # where nothing but a height moves, and a wind would blow along x alone if there were one
    size = 0.0

    def _describe(self):
        return replace(super()._describe(), action=Continuous(layout(Field("lift", Kind.SCALAR))))

    def _advance(self, world, action):
        world["position"] = world["position"] * torch.tensor([2.0, 0.0])
        return -action[:, :, 0, 0].abs(), {}


def test_an_element_that_moved_nothing_is_not_covered():
    make = lambda count, seeds: Calm(Settings(), count, generators_for(seeds))  # noqa: E731
    (found,) = check_symmetry(make, "rot90").elements
    assert (found.outcome, found.reason) == ("not covered", "it moves nothing in the states that play visits")


@pytest.mark.parametrize(
    ("task", "field"), [(Cost, "reward"), (NoEnd, "end"), (Leaving, "alive"), (Masked, "action mask")]
)
@pytest.mark.parametrize("from_transitions", [False, True])
def test_rewards_and_ends_that_never_came_are_not_covered(task, field, from_transitions):
    assert verdict(task, "rot90", from_transitions) == ("not covered", {field})


@pytest.mark.parametrize(("task", "field"), [(End, "end"), (LeavingSoon, "alive")])
@pytest.mark.parametrize("from_transitions", [False, True])
def test_ends_of_episodes_and_agents_are_seen_and_not_covered_where_transitions_leave_them_out(
    task, field, from_transitions
):
    assert verdict(task, "rot180", from_transitions) == ("broken", {field})
    assert verdict(task, "flip-x", from_transitions)[0] == "holds"
    env = task(Settings(), 128, generators_for([0]))
    data = replace(collect(env, 128), terminated=None, alive=None)
    (found,) = check_transitions(env.spec, data, parse_elements("flip-x", 1))
    assert [one.field for one in found.fields if one.outcome == "not covered"] == [field]


def test_what_breaks_further_out_is_not_covered_in_records_either():
    assert verdict(Walled, "flip-y") == ("not covered", {"obs.position", "state.position"})
    assert verdict(Walled, "flip-x")[0] == "holds"


def test_where_the_time_is_over_before_later_steps_an_element_is_not_covered(monkeypatch):
    def late(*_):
        raise Late

    monkeypatch.setattr(paired._Pairs, "broken_later", late)
    (found,) = check_symmetry(lambda n, seeds: Point(Settings(), n, generators_for(seeds)), "rot90").elements
    assert (found.outcome, found.reason) == ("not covered", LATE)


def test_rewards_that_nearly_all_lie_in_the_rarest_hundredth_are_not_covered():
    assert verdict(Seldom, "rot90", from_transitions=True) == ("not covered", {"reward"})


class Far(End):  # where few episodes end, each in a step of its own
    def _ended(self, world):
        return world["position"][:, :, 0, 0] > 1.15


def test_states_from_which_episodes_ended_are_visited():
    assert verdict(Far, "rot90") == ("broken", {"end"})


class Goal(NoEnd):  # where play comes by once in a thousand episodes
    speed = 0.0005

    def _ended(self, world):
        return world["position"][:, :, 0].norm(dim=-1) < 0.004


class Half(Goal):
    def _ended(self, world):
        return super()._ended(world) & (world["position"][:, :, 0, 0] > 0)


class Bonus(Goal):  # and is paid there, on one side
    def paid(self, place):
        return super().paid(place) + 5 * (place.norm(dim=-1) < 0.004) * (place[..., 0] > 0)


class Way(NoEnd):  # where the pay leads, and nothing that gathers
    def paid(self, place):
        return place[..., 0]

    def _ended(self, world):
        return world["position"][:, :, 0, 0] > 6


def test_ends_that_play_does_not_reach_are_sought_where_things_gather_and_where_the_pay_leads():
    assert verdict(Goal, "rot90")[0] == "holds"
    assert verdict(Half, "rot90") == ("not covered", {"end"})
    assert verdict(Way, "flip-x")[0] == "holds"
    assert verdict(Bonus, "flip-x")[0] == "holds"
    assert verdict(Bonus, "rot90") == ("not covered", {"reward"})


class Fenced(Way):  # where agents leave, in play
    beside = 0.95

    def _describe(self):
        return replace(super()._describe(), agents_end=True)

    def _living(self, world):
        return world["position"][..., 1].abs() < self.beside


class FencedFarOff(Fenced):
    beside = 1.4


class FencedHalf(FencedFarOff):
    def _ended(self, world):
        return super()._ended(world) & (world["position"][:, :, 0, 1] > 0)


def test_an_end_is_sought_beside_ends_of_agents():
    assert verdict(Fenced, "flip-x")[0] == "holds"
    assert verdict(FencedFarOff, "flip-x")[0] == "holds"
    assert verdict(FencedHalf, "flip-x") == ("not covered", {"end"})


class Gone(Masked):  # an agent that leaves where play seldom goes, and then may do nothing
    speed = 0.0005

    def _describe(self):
        return replace(super()._describe(), agents_end=True)

    def _living(self, world):
        return world["position"].norm(dim=-1) > 0.004

    def _allow(self, world):
        return self._living(world).unsqueeze(-1).expand(-1, -1, -1, 4)


class GoneUnmasked(Gone):  # and something is forbidden further out alone
    def _allow(self, world):
        return Masked._allow(self, world)


class GoneHalf(Gone):
    def _allow(self, world):
        return super()._allow(world) | (world["position"][..., :1] > 0)


def test_masks_that_follow_ends_of_agents_are_seen_at_a_sought_end():
    assert verdict(Gone, "rot90")[0] == "holds"
    assert verdict(GoneUnmasked, "rot90") == ("not covered", {"action mask"})
    assert verdict(GoneHalf, "rot90") == ("not covered", {"action mask"})


def test_a_gap_is_told_in_deviations_of_the_field_or_of_a_small_number_up_to_one():
    for task, most in ((Slow, 1.0), (Point, 0.0)):
        (found,) = check_symmetry(lambda n, seeds, t=task: t(Settings(), n, generators_for(seeds)), "rot90").elements
        assert (found.worst.gap > 0) == (task is Slow)
        assert found.worst.gap <= most
