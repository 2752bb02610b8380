"""The check of symmetry finds fifty seeded faults and accuses none of fifty clean tasks."""

import pytest
import torch
from torch import Tensor

from esp_cli.checking import check_symmetry, paired
from esp_envs import Observation, make
from esp_envs.spec import discrete_moves
from tests.benchmarks.synthetic import Recipe
from tests.checking import faults
from tests.checking.faults import Fault, declared, field_of, turned_by_first, wind, with_fault


@pytest.fixture(autouse=True)
def fewer_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare in half as many worlds as `esp check` does, which makes faults harder to find."""
    monkeypatch.setattr(paired, "_MOST_WORLDS", 128)


NAVIGATION = ("navigation", {"actions": "continuous"})
MOVES = ("navigation", {})
CHASE = ("predator-prey", {"actions": "continuous"})
STILL = ("predator-prey", {"prey": "still", "actions": "continuous"})
HUNTED = ("predator-prey", {"control": "prey", "actions": "continuous"})
ROBOTS = ("formation", {"horizon": 20, "num_agents": 4, "num_obstacles": 2})
NOISY = ("formation", {"horizon": 20, "num_agents": 4, "num_obstacles": 2, "sensor_noise_m": 0.01})
DRONES = ("wildlife", {"width": 5, "height": 5, "horizon": 30})

OBSERVED = [
    (task, f"{field}-{change.__name__}", field_of(field, change))
    for task, field, change in [
        (NAVIGATION, "velocity", faults.negated_x),
        (NAVIGATION, "position", faults.negated_y),
        (NAVIGATION, "landmarks", faults.swapped_axes),
        (NAVIGATION, "others", faults.stretched),
        (NAVIGATION, "others", faults.nearest_first),
        (NAVIGATION, "position", faults.shifted),
        (MOVES, "velocity", faults.swapped_axes),
        (MOVES, "landmarks", faults.negated_x),
        (MOVES, "others", faults.nearest_first),
        (MOVES, "position", faults.skewed),
        (CHASE, "prey", faults.negated_x),
        (CHASE, "prey_velocity", faults.swapped_axes),
        (CHASE, "predators", faults.nearest_first),
        (CHASE, "velocity", faults.stretched),
        (CHASE, "obstacles", faults.shifted),
        (STILL, "prey", faults.skewed),
        (HUNTED, "predators", faults.negated_y),
        (ROBOTS, "heading", faults.negated_y),
        (ROBOTS, "goal", faults.swapped_axes),
        (ROBOTS, "obstacle", faults.stretched),
        (ROBOTS, "robots", faults.shifted),
        (NOISY, "goal", faults.skewed),
        (NOISY, "robots", faults.negated_x),
        (NOISY, "obstacle", faults.shifted),
        (DRONES, "others", faults.negated_x),
        (DRONES, "others", faults.nearest_first),
        (DRONES, "others", faults.swapped_axes),
    ]
]
OTHERS = [
    (NAVIGATION, "goal-in-the-frame-of-the-velocity", turned_by_first("landmarks")),
    (ROBOTS, "goal-in-the-body-frame", turned_by_first("goal")),
    (NOISY, "robots-in-the-body-frame", turned_by_first("robots")),
    (CHASE, "prey-in-the-frame-of-the-velocity", turned_by_first("prey")),
    (NAVIGATION, "position-as-scalars", declared(faults.as_scalars, "position")),
    (MOVES, "landmarks-as-scalars", declared(faults.as_scalars, "landmarks")),
    (CHASE, "prey-as-scalars", declared(faults.as_scalars, "prey")),
    (ROBOTS, "goal-as-scalars", declared(faults.as_scalars, "goal")),
    (NAVIGATION, "others-that-do-not-follow", declared(faults.as_fixed, "others")),
    (CHASE, "predators-that-do-not-follow", declared(faults.as_fixed, "predators")),
    (ROBOTS, "wheels-as-scalars", Fault(told=faults.wheels_as_scalars)),
    (NAVIGATION, "wind-0.5", wind(0.5)),
    (NAVIGATION, "wind-0.1", wind(0.1)),
    (CHASE, "wind-0.1", wind(0.1)),
    (HUNTED, "wind-0.2", wind(0.2)),
    (ROBOTS, "uneven-motors", Fault(done=faults.uneven_motors)),
    (NOISY, "uneven-motors", Fault(done=faults.uneven_motors)),
    (NAVIGATION, "a-lazy-agent", Fault(done=faults.lazy_agent)),
    (MOVES, "never-right", Fault(done=faults.never_right)),
    (DRONES, "never-right", Fault(done=faults.never_right)),
    (NAVIGATION, "a-slope-of-the-reward", Fault(paid=faults.slope)),
    (CHASE, "a-slope-of-the-reward", Fault(paid=faults.slope)),
    (ROBOTS, "the-first-counts-more", Fault(paid=faults.first_counts_more)),
]
FAULTS = OBSERVED + OTHERS


def elements_of(task: str, settings: dict[str, object]) -> str:
    """A quarter turn, a mirror, and an exchange of agents where there are several."""
    count = make(task, 1, [0], settings).spec.num_agents
    swap = "" if count == 1 else ",agents-" + "-".join(map(str, [1, 0, *range(2, count)]))
    return f"rot90,flip-x{swap}"


def test_there_are_fifty_faults() -> None:
    assert len(FAULTS) == 50


@pytest.mark.slow
@pytest.mark.parametrize(("task", "fault"), [(t, f) for t, _, f in FAULTS], ids=[f"{t[0]}-{n}" for t, n, _ in FAULTS])
def test_a_fault_is_found(task, fault: Fault) -> None:
    report = check_symmetry(with_fault(*task, fault), elements_of(*task))
    assert not report.holds
    assert report.found != report.declared


def test_square_bounds_are_found_under_45_degrees() -> None:
    report = check_symmetry(lambda n, seeds: make(HUNTED[0], n, seeds, HUNTED[1]), "rot45,rot90")
    assert [element.outcome for element in report.elements] == ["broken", "holds"]
    assert report.holds, "the task declares d4 alone"
    clipped = check_symmetry(with_fault(*NAVIGATION, field_of("position", faults.clipped)), "rot45,rot90")
    assert [element.outcome for element in clipped.elements] == ["broken", "holds"]
    assert not clipped.holds


CLEAN = (
    [("navigation", {"num_agents": n, "actions": a, "convention": c})
     for n in (1, 2, 3, 4) for a in ("discrete", "continuous") for c in ("esp", "pettingzoo")]
    + [("predator-prey", {"prey": p, "actions": a, "num_predators": n})
       for p in ("random", "fleeing", "still") for a in ("discrete", "continuous") for n in (1, 3)]
    + [("predator-prey", {"control": "prey", "actions": a}) for a in ("discrete", "continuous")]
    + [("predator-prey", {"convention": "pettingzoo", "num_obstacles": n}) for n in (0, 3)]
    + [("formation", {"horizon": 20, "num_agents": 4, "num_obstacles": 2, **more}) for more in (
        {}, {"physics": "pymunk"}, {"actions": "discrete"}, {"convention": "tight"}, {"sensor_noise_m": 0.01},
        {"heading_noise_rad": 0.1}, {"sensor_noise_m": 0.05, "heading_noise_rad": 0.05}, {"wheel_mismatch": 0.1},
        {"neighbours": 2}, {"mass_spread": 0.3, "friction_spread": 0.3})]
    + [("wildlife", {"horizon": 30, "width": w, "height": h, "convention": c, "poacher_moves": m})
       for w, h in ((5, 5), (7, 5)) for c in ("esp", "corrected") for m in (0.8, 0.0)]
)  # fmt: skip


def test_there_are_fifty_clean_cases() -> None:
    assert len(CLEAN) == 50


@pytest.mark.slow
@pytest.mark.parametrize(("task", "settings"), CLEAN, ids=str)
def test_a_clean_task_is_not_accused(task: str, settings, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()  # with fewer worlds a picture of chance is not covered
    elements = elements_of(task, settings).replace("rot90", "rot180" if settings.get("width") == 7 else "rot90")
    report = check_symmetry(lambda n, seeds: make(task, n, seeds, settings), elements)
    assert report.holds
    assert all(element.outcome == "holds" for element in report.elements)


def test_one_state_in_a_hundred_is_a_proof_where_there_is_no_chance() -> None:
    def corner(reward, seen):
        return reward - ((seen.obs[..., 2:4] > 0.8).all(-1)).float()

    report = check_symmetry(with_fault(*MOVES, Fault(paid=corner)), "rot90,flip-diagonal")
    assert [element.outcome for element in report.elements] == ["broken", "holds"]
    worst = report.elements[0].worst
    assert worst is not None
    assert worst.field == "reward"
    assert 0 < worst.share < 0.2


@pytest.mark.parametrize(("sides", "broken"), [(1, ["reward"]), (2, [])])
def test_numbers_on_one_side_alone_break_a_mirror(sides: int, broken: list[str]) -> None:
    """Where agents are to the right there is no reward; the control has none to the left either."""

    def right(reward: Tensor, seen: Observation) -> Tensor:
        place = seen.obs[..., 2]
        return reward.masked_fill((place if sides == 1 else place.abs()) > 0.3, torch.nan)

    (flip,) = check_symmetry(with_fault(*MOVES, Fault(paid=right)), "flip-y").elements
    assert [field.field for field in flip.fields if field.outcome != "holds"] == broken


def test_a_reward_that_never_comes_is_not_covered() -> None:
    report = check_symmetry(with_fault(*MOVES, Fault(paid=lambda reward, seen: 0 * reward)), "rot90")
    assert (report.uncovered, report.broken, report.holds) == (("rot90",), (), False)


@pytest.mark.parametrize("moves", [3, 5, 6])
def test_the_polygon_of_the_moves_is_found(moves: int) -> None:
    mark = Recipe(
        seed=0,
        reward="distance to the first mark",
        force="none",
        noise="none",
        agents=1,
        marks=1,
        start="disc",
        listed="as they are",
        tails="normal",
        action=discrete_moves(moves),
    )
    assert check_symmetry(mark.make).found == f"d{moves}"
