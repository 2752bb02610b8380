"""The maps that commute with a group are found, all of them and no other."""

import numpy as np
import pytest

from esp_cli.symmetry import PlaneElement, cyclic, dihedral
from esp_cli.symmetry.maps import Block, action_blocks, intertwiners, layout_blocks, regular, trivial, with_pixels
from esp_envs.spec import Field, Kind, layout
from tests.symmetry.toy_actions import EVERYTHING, FOUR_DIRECTIONS


def block(kind: Kind, group, copies: int = 1) -> Block:
    return layout_blocks(layout(Field("field", kind, copies)), group)[0]


C4, D4 = cyclic(4), dihedral(4)


@pytest.mark.parametrize(
    ("inputs", "outputs", "count"),
    [
        (regular(C4, 3), regular(C4, 2), 4),  # a group convolution has as many free numbers as elements
        (regular(D4, 1), regular(D4, 1), 8),
        (block(Kind.VECTOR, C4), block(Kind.VECTOR, C4), 2),  # a turn and a stretch
        (block(Kind.VECTOR, D4), block(Kind.VECTOR, D4), 1),  # a stretch: a turn would not commute with mirrors
        (block(Kind.SCALAR, C4), block(Kind.VECTOR, C4), 0),  # no direction is distinguished
        (block(Kind.VECTOR, D4), regular(D4, 1), 2),
        (block(Kind.VECTOR, cyclic(8)), regular(cyclic(8), 1), 2),
        (block(Kind.PSEUDOSCALAR, D4), trivial(D4, 1), 0),
        (block(Kind.WHEELS, D4), trivial(D4, 1), 1),  # their sum
        (trivial(C4, 1), action_blocks(FOUR_DIRECTIONS, C4)[0], 2),  # staying, and going anywhere
        (with_pixels(trivial(C4, 1), 3, C4), trivial(C4, 1), 3),  # middle, edges, corners
        (with_pixels(trivial(C4, 1), 7, C4), regular(C4, 1), 49),
    ],
)
def test_as_many_maps_as_the_characters_say_and_each_commutes(inputs, outputs, count) -> None:
    basis = intertwiners(inputs, outputs)
    assert basis.shape == (count, inputs.size, outputs.size)
    turned = np.einsum("gij,kjl,gml->gkim", inputs.matrices, basis, outputs.matrices)
    np.testing.assert_allclose(turned, np.broadcast_to(basis, turned.shape), atol=1e-12)
    flat = basis.reshape(count, inputs.size * outputs.size)
    np.testing.assert_allclose(flat @ flat.T, np.eye(count), atol=1e-12)


def test_what_is_no_solution_does_not_commute() -> None:
    arbitrary = np.random.default_rng(0).normal(size=(4, 4))
    matrices = regular(C4, 1).matrices
    assert np.abs(np.einsum("gij,jl,gml->gim", matrices, arbitrary, matrices) - arbitrary).max() > 0.1


@pytest.mark.parametrize("group", [C4, D4, dihedral(8)], ids=lambda g: g.name)
def test_regular_features_are_a_representation(group) -> None:
    matrices = regular(group, 1).matrices
    for i, j in np.ndindex(group.order, group.order):
        np.testing.assert_array_equal(matrices[i] @ matrices[j], matrices[group.product[i, j]])


def test_actions_transform_as_their_meanings_do() -> None:
    for action in (FOUR_DIRECTIONS, EVERYTHING):
        for g, element in enumerate(C4.elements):
            (first, *_) = action_blocks(action, C4)
            if action is FOUR_DIRECTIONS:
                points = np.array(action.points)
                np.testing.assert_allclose(first.matrices[g].T @ points, points @ PlaneElement.of(element).matrix.T)
            else:
                np.testing.assert_array_equal(first.matrices[g], PlaneElement.of(element).matrix)
