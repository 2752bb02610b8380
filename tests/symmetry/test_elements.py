"""The convention, by hand: which way things turn, which product comes first."""

from fractions import Fraction

import numpy as np
import pytest

from esp_cli.symmetry import Element, PlaneElement, mirror, rotation

RIGHT, UP = np.array([1.0, 0.0]), np.array([0.0, 1.0])


@pytest.mark.parametrize(
    ("element", "name", "image"),
    [
        (rotation(0), "identity", (2, 1)),
        (rotation(90), "rot90", (-1, 2)),
        (rotation(180), "rot180", (-2, -1)),
        (rotation(270), "rot270", (1, -2)),
        (mirror(0), "flip-x", (2, -1)),
        (mirror(90), "flip-y", (-2, 1)),
        (mirror(45), "flip-diagonal", (1, 2)),
        (mirror(135), "flip-antidiagonal", (-1, -2)),
    ],
)
def test_names_and_images_of_the_square(element: PlaneElement, name: str, image: tuple[int, int]) -> None:
    assert element.name == name
    np.testing.assert_array_equal(PlaneElement.of(element).matrix @ np.array([2.0, 1.0]), image)


def test_quarter_turns_are_exact_and_hold_no_negative_zero() -> None:
    for degrees in (0, 90, 180, 270):
        for element in (rotation(degrees), mirror(degrees / 2)):
            assert set(np.abs(PlaneElement.of(element).matrix).ravel()) == {0.0, 1.0}
            assert not np.any(np.signbit(PlaneElement.of(element).matrix) & (PlaneElement.of(element).matrix == 0))


def test_45_degrees_by_hand() -> None:
    root = 0.70710678118654752
    np.testing.assert_allclose(PlaneElement.of(rotation(45)).matrix, [[root, -root], [root, root]], rtol=1e-15)


def test_the_right_factor_of_a_product_acts_first() -> None:
    # Mirror in the x-axis: (2, 1) -> (2, -1); then a quarter turn: (1, 2), the mirror image in the diagonal.
    assert rotation(90) @ mirror(0) == mirror(45)
    assert mirror(0) @ rotation(90) == mirror(135)


def test_inverses() -> None:
    assert rotation(90).inverse() == rotation(270)
    assert mirror(30).inverse() == mirror(30)
    assert Element(permutation=(1, 2, 0)).inverse() == Element(permutation=(2, 0, 1))


def test_permutations_send_agent_i_to_sigma_of_i() -> None:
    swap, round_ = Element(permutation=(1, 0, 2)), Element(permutation=(1, 2, 0))
    # Agent 0 goes round to place 1, and the swap brings place 1 to place 0.
    assert (swap @ round_).permutation == (0, 2, 1)
    assert (round_ @ swap).permutation == (2, 1, 0)


def test_orders_of_items_compose_and_are_undone_field_by_field() -> None:
    swap = Element(items=(("marks", (1, 0, 2)), ("cars", (1, 0))))
    round_ = Element(items=(("marks", (1, 2, 0)),))
    assert (swap @ round_).items == (("cars", (1, 0)), ("marks", (0, 2, 1)))
    assert (round_ @ swap).items == (("cars", (1, 0)), ("marks", (2, 1, 0)))
    assert round_.inverse().items == (("marks", (2, 0, 1)),)
    assert (swap @ swap).is_identity
    assert swap.in_place.is_identity


def test_an_order_that_moves_nobody_is_the_identity() -> None:
    assert Element(items=(("marks", (0, 1, 2)),)) == Element()
    assert Element(permutation=(0, 1, 2)) == Element()
    assert Element(permutation=(0, 1)).is_identity


@pytest.mark.parametrize(
    ("element", "name"),
    [
        (rotation("22.5"), "rot22.5"),
        (Element.of(PlaneElement(Fraction(1, 7))), "rot360/7"),
        (mirror("22.5"), "flip22.5"),
        (Element(permutation=(1, 0, 2)), "agents-1-0-2"),
        (rotation(90) @ Element(permutation=(1, 0)), "rot90*agents-1-0"),
        (Element.of(PlaneElement(Fraction(0.123456789))), "rot44.444"),
        (
            Element(permutation=(1, 0), items=(("marks", (1, 0, 2)), ("cars", (1, 0)))),
            "agents-1-0*cars-1-0*marks-1-0-2",
        ),
    ],
)
def test_names_of_other_elements(element: PlaneElement, name: str) -> None:
    assert element.name == name


def test_refusals() -> None:
    with pytest.raises(ValueError, match="is not a permutation"):
        Element(permutation=(0, 0, 1))
    with pytest.raises(ValueError, match="orders of 2 and of 3 things cannot be composed"):
        Element(permutation=(1, 0)) @ Element(permutation=(1, 0, 2))
