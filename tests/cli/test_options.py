"""The parsers behind the shared options."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from esp_cli.commands.counts import MAX_SEEDS, chosen_seeds, parse_count, parse_seed_list, parse_seeds
from esp_cli.commands.options import parse_assignments, parse_task_settings
from esp_cli.console import format_count


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("20000", 20_000),
        ("20_000", 20_000),
        ("500k", 500_000),
        ("3M", 3_000_000),
        ("1.5m", 1_500_000),
        ("2e6", 2_000_000),
        (" 10 K ", 10_000),
        ("1.001k", 1001),
        ("4.35M", 4_350_000),  # in binary fractions 4.35 * 1e6 is 4349999.99...
        (7, 7),
    ],
)
def test_counts_are_read(text: str | int, count: int) -> None:
    assert parse_count(text) == count


@pytest.mark.parametrize(
    "text", ["", "many", "-5", "0", "0.5", "1.0005k", "1e400", "k", "5 km", "1.2.3", "inf", "nan", "0k"]
)
def test_what_is_no_count_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="500k"):
        parse_count(text)


@given(st.integers(1, 999), st.sampled_from([1, 1_000, 1_000_000, 1_000_000_000]))
def test_a_count_survives_being_written_and_read(number: int, scale: int) -> None:
    assert parse_count(format_count(number * scale)) == number * scale


@pytest.mark.parametrize(("text", "seeds"), [("1", (0,)), ("3", (0, 1, 2)), (2, (0, 1))])
def test_a_number_of_seeds_is_read(text: str | int, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    ("text", "seeds"), [("3,7", (3, 7)), ("7", (7,)), ("7,", (7,)), ("5, 0", (5, 0)), ((4,), (4,))]
)
def test_seeds_are_named(text: str | tuple[int, ...], seeds: tuple[int, ...]) -> None:
    assert parse_seed_list(text) == seeds


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("0", "cannot be trained at once"),
        (str(MAX_SEEDS + 1), "cannot be trained at once"),
        ("3,7", "as --seed-list 3,7"),
        ("a", "does not say how many seeds"),
        ("-1", "does not say how many seeds"),
        (",", "does not say how many seeds"),
        ("1.5", "does not say how many seeds"),
    ],
)
def test_what_names_no_seeds_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_seeds(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (",".join(map(str, range(MAX_SEEDS + 1))), "name at most"),
        ("1,1", "twice"),
        ("a", "is not a list of seeds"),
        ("-1", "is not a list of seeds"),
        (",", "is not a list of seeds"),
        ("9223372036854775807", "names a seed beyond 999999999; write numbers from 0 to 999999999"),
        ("3," + "9" * 5000, "names a seed beyond 999999999"),
    ],
)
def test_what_is_no_list_of_seeds_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_seed_list(text)


def test_a_count_and_a_list_of_seeds_exclude_each_other() -> None:
    assert chosen_seeds(None, (3, 7), default=(0,)) == (3, 7)
    assert chosen_seeds(None, None, default=(0,)) == (0,)
    assert chosen_seeds((0, 1), None, default=(0,)) == (0, 1)
    with pytest.raises(ValueError, match="leave one of them out"):
        chosen_seeds((0,), (3, 7), default=(0,))


def test_assignments_are_json_where_they_can_be() -> None:
    assert parse_assignments(
        ["mappo.learning_rate=5e-4", "prey=random", "a.b=[1, 2]", "on=true", "text=a=b", "none="]
    ) == {"mappo.learning_rate": 5e-4, "prey": "random", "a.b": [1, 2], "on": True, "text": "a=b", "none": ""}


@pytest.mark.parametrize(
    ("items", "reason"), [(["x"], "not a setting"), (["=3"], "not a setting"), (["x=1", "x=2"], "twice")]
)
def test_what_is_no_assignment_is_refused(items: list[str], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_assignments(items)


def test_settings_of_a_task_have_the_last_word_over_its_shorthand() -> None:
    assert parse_task_settings(["task.wind=0.5"], "pymunk") == {"physics": "pymunk", "wind": 0.5}
    assert parse_task_settings(["task.physics=mujoco-3d"], "pymunk") == {"physics": "mujoco-3d"}
    with pytest.raises(ValueError, match=r"mappo\.gamma is not a setting of the task"):
        parse_task_settings(["mappo.gamma=0.9"])
