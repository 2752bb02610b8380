"""Numbers of robots in layouts: by hand, as groups ask, in any simulator's order, and in a loop with histories."""

from itertools import product

import mujoco
import numpy as np
import pytest
import torch

from esp_cli import Body, Continuous, Field, Symmetry, layout
from esp_cli.bodies import ATTITUDE_6D, AXIAL_3D, PLANAR_COMMAND, QUATERNION, QUATERNION_XYZW, VECTOR_3D, grid
from esp_envs.errors import UserError
from tests.bodies.models import QUADRUPED, biped

JOINTS = [f"{leg}_{part}" for part in ("HAA", "HFE", "KFE") for leg in ("LF", "LH", "RF", "RH")]
"""ANYmal's, in the order of Isaac Sim."""


def anymal() -> Body:
    swap = {"LF": "RF", "LH": "RH", "RF": "LF", "RH": "LH"}
    hind = {"LF": "LH", "LH": "LF", "RF": "RH", "RH": "RF"}
    flip = {"HAA": "-", "HFE": "", "KFE": ""}
    turn = {"HAA": "", "HFE": "-", "KFE": "-"}
    mirrors = {
        "left-right": {j: flip[j[3:]] + swap[j[:2]] + j[2:] for j in JOINTS},
        "front-back": {j: turn[j[3:]] + hind[j[:2]] + j[2:] for j in JOINTS},
    }
    return Body(JOINTS, mirrors, limbs={"left-right": swap, "front-back": hind})


def walker(body: Body, history: int = 1) -> Symmetry:
    """Return the symmetry of Isaac Lab's velocity task on rough ground."""
    observation = layout(
        body.velocity(history),
        body.spin(history),
        body.gravity(history),
        body.command(history),
        body.positions(JOINTS, history),
        body.velocities(JOINTS, history),
        body.controls(JOINTS, history),
        body.scan(grid((1.6, 1.0), 0.1), history),
    )
    action = Continuous(layout(body.controls(JOINTS)))
    return Symmetry(observation=observation, action=action, group="d2", copies="all")


def moved(field: Field, element: str, row: list[float]) -> list[float]:
    symmetry = Symmetry(observation=layout(field), action=Continuous(layout(Field("a", VECTOR_3D))), group=element)
    obs = torch.tensor([row], dtype=torch.float64)
    return symmetry.transforms(obs)[0].obs(obs)[0].tolist()


@pytest.mark.parametrize(
    ("kind", "element", "row", "image"),
    [
        (VECTOR_3D, "flip-x", [1, 2, 3], [1, -2, 3]),
        (VECTOR_3D, "flip-y", [1, 2, 3], [-1, 2, 3]),
        (VECTOR_3D, "rot90", [1, 2, 3], [-2, 1, 3]),
        (AXIAL_3D, "flip-x", [1, 2, 3], [-1, 2, -3]),
        (AXIAL_3D, "flip-y", [1, 2, 3], [1, -2, -3]),
        (AXIAL_3D, "rot90", [1, 2, 3], [-2, 1, 3]),
        (QUATERNION, "flip-x", [1, 2, 3, 4], [1, -2, 3, -4]),
        (QUATERNION, "rot90", [1, 2, 3, 4], [1, -3, 2, 4]),
        (QUATERNION_XYZW, "flip-x", [2, 3, 4, 1], [-2, 3, -4, 1]),
        (PLANAR_COMMAND, "flip-x", [1, 2, 3], [1, -2, -3]),
        (PLANAR_COMMAND, "rot90", [1, 2, 3], [-2, 1, 3]),
    ],
)  # fmt: skip
def test_numbers_in_space_by_hand(kind, element, row, image):
    assert moved(Field("x", kind), element, row) == image


def test_a_mirrored_attitude_is_the_mirror_times_the_attitude_times_the_mirror():
    q = np.array([0.5, -0.1, 0.7, 0.3]) / np.linalg.norm([0.5, -0.1, 0.7, 0.3])
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, q)
    R = R.reshape(3, 3)
    for element, M in (("flip-x", np.diag([1, -1, 1])), ("rot90", np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))):
        image = np.zeros(9)
        mujoco.mju_quat2Mat(image, np.array(moved(Field("q", QUATERNION), element, q.tolist())))
        np.testing.assert_allclose(image.reshape(3, 3), M @ R @ M.T, atol=1e-12)
        six = moved(Field("r", ATTITUDE_6D), element, R[:, :2].ravel().tolist())
        np.testing.assert_allclose(np.reshape(six, (3, 2)), (M @ R @ M.T)[:, :2], atol=1e-12)


def test_all_fields_of_a_body_multiply_as_its_elements_do():
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(QUADRUPED))
    shins = [f"shin{i}" for i in range(4)]
    fields = [
        body.positions(),
        body.velocities(),
        body.controls(),
        body.contacts(shins, 2),
        body.scan([[1, 0], [-1, 0]]),
    ]
    fields += [
        Field("x", kind) for kind in (VECTOR_3D, AXIAL_3D, QUATERNION, QUATERNION_XYZW, ATTITUDE_6D, PLANAR_COMMAND)
    ]
    for field, g, h in product(fields, body.elements, body.elements):
        both, single = (g @ h).block(field), g.block(field) @ h.block(field)
        np.testing.assert_allclose(both, single, atol=1e-12)
        np.testing.assert_allclose(single @ single.T, np.eye(field.item_width), atol=1e-12)


def test_isaac_labs_mirror_of_anymal_is_reproduced_bit_for_bit():
    obs, action = torch.randn(64, 48 + 187), torch.randn(64, 12)
    sides = {
        "left-right": ([1, -1, 1], [-1, 1, -1], [1, -1, -1], [2, 3, 0, 1], [-1, 1, 1], 0),
        "front-back": ([-1, 1, 1], [1, -1, -1], [-1, 1, -1], [1, 0, 3, 2], [1, -1, -1], 1),
    }

    def legs(x: torch.Tensor, order: list[int], signs: list[int]) -> torch.Tensor:
        return torch.cat([sign * part[:, order] for sign, part in zip(signs, x.split(4, 1), strict=True)], 1)

    def by_hand(x: torch.Tensor, side: str) -> torch.Tensor:
        polar, axial, told, order, signs, axis = sides[side]
        v, w, g, c, *joints, scan = x.split([3, 3, 3, 3, 12, 12, 12, 187], 1)
        parts = [y * torch.tensor(s) for y, s in ((v, polar), (w, axial), (g, polar), (c, told))]
        parts += [legs(y, order, signs) for y in joints]
        return torch.cat([*parts, scan.view(-1, 11, 17).flip(1 + axis).flatten(1)], 1)

    left, front = by_hand(obs, "left-right"), by_hand(obs, "front-back")
    wanted = {"flip-x": left, "flip-y": front, "rot180": by_hand(left, "front-back")}
    symmetry = walker(anymal())
    for g in symmetry.transforms(obs):
        assert torch.equal(g.obs(obs), wanted[g.elements[0].name])
    acted = legs(action, sides["left-right"][3], sides["left-right"][4])
    assert torch.equal(
        next(g for g in symmetry.transforms(obs) if g.elements[0].name == "flip-x").action(action), acted
    )


def test_joints_come_in_the_simulators_order():
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()))
    order = ["right_knee", "waist", "left_knee"]
    assert moved(body.positions(order), "flip-x", [1, 2, 3]) == [3, -2, 1]
    assert moved(body.positions(order, history=2), "flip-x", [1, 2, 3, 10, 20, 30]) == [3, -2, 1, 30, -20, 10]
    assert moved(body.positions(order), "left-right", [1, 2, 3]) == [3, -2, 1]
    assert moved(body.controls(["a_right_pitch", "a_left_pitch"]), "flip-x", [1, 2]) == [2, 1]
    assert moved(body.contacts(["left_foot", "right_foot"], width=2), "flip-x", [1, 2, 3, 4]) == [3, 4, 1, 2]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda b: b.positions(["left_knee"]), "left_knee under flip-x, right_knee, is not among them; add it"),
        (lambda b: b.positions(["left_knee", "knee"]), "there is no knee among the joints waist, "),
        (lambda b: b.positions(["waist", "waist"]), "names waist twice; name it once"),
        (lambda b: b.contacts(["left_foot"]), "left_foot under flip-x, right_foot, is not among them; add it"),
        (lambda b: b.contacts(["paw"]), "there is no paw among the limbs"),
        (lambda b: b.scan([[1, 0.5], [1, 0]]), "the image of point 0 under flip-x is no point"),
        (lambda b: b.scan([]), "points have shape"),
        (lambda b: b.scan("x"), "points have shape"),
        (lambda b: b.positions("left_knee"), "field 'positions' is given 'left_knee'; give a list of names"),
        (lambda b: b.positions(history=0), "has a history of 0 steps; give 1 or more"),
        (lambda b: b.contacts(["left_foot", "right_foot"], width=0), "has 0 numbers of each; give a width of 1"),
        (lambda b: b.check_pose({"left_knee": "x"}), "the pose has left_knee at x; give joints"),
        (lambda b: grid((1.0,), 0.1), "give two sizes"),
        (lambda b: grid((1, 1), np.nan), "give two sizes"),
        (lambda b: b.check_pose({"left_knee": 0.3}), "left_knee is off by 0.3"),
        (lambda b: b.check_pose({"knee": 0.3}), "the pose has knee at 0.3; give joints"),
        (lambda b: b.check_pose({"left_knee": np.nan, "right_knee": np.nan}), "the pose has left_knee at nan"),
        (lambda b: Symmetry(observation=layout(b.positions()), action=Continuous(layout(b.controls())), group="d2"),
         "has no such symmetry for its joints; it has flip-x"),
    ],
)  # fmt: skip
def test_fields_that_do_not_fit_are_refused(make, words):
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()))
    with pytest.raises(UserError, match=words):
        make(body)
    body.check_pose({"left_knee": 0.3, "right_knee": 0.3, "left_pitch": -0.2, "right_pitch": 0.2})


@pytest.mark.parametrize(
    ("mirror", "words"),
    [
        ({"a": "-d"}, "d, which is none of the joints"),
        ({"a": "b"}, "or several, to or from c"),
        ({"a": "b", "b": "b", "c": "c"}, "several"),
        ({"left-right": {"a": "b", "c": "c"}, "front-back": {"a": "c", "b": "b"}}, "do not multiply"),
        ({"half": {"a": "b"}}, "half"),
    ],
)
def test_tables_that_are_no_symmetry_are_refused(mirror, words):
    with pytest.raises(UserError, match=words):
        Body(["a", "b", "c"], mirror)


def test_a_turn_that_does_not_undo_itself_is_not_completed():
    with pytest.raises(UserError, match="to or from a"):
        Body(["a", "b", "c", "d"], {"rot90": {"a": "b", "c": "d"}})
    assert Body(["a", "b"], {"rot180": {"a": "b"}}).elements, "the control"


@pytest.mark.parametrize(
    ("joints", "mirror", "words"),
    [
        (["a"], None, "the mirror of the joints is None; give by name the name of its image"),
        ([1, 2], {1: 2}, r"is given \[1, 2\]; give a list of names"),
        ("ab", {"a": "b"}, "is given 'ab'; give a list of names"),
        (["a", "a"], {"a": "a"}, "the list of joints names a twice; name it once"),
        (["a", "b"], {"left-right": {"a": 1}}, "give by name the name of its image"),
    ],
)
def test_joints_that_are_no_list_of_names_are_refused(joints, mirror, words):
    with pytest.raises(UserError, match=words):
        Body(joints, mirror)


def test_a_scan_of_a_grid_turns_by_quarters_only_where_it_is_square():
    quarter = Body(["a"], {"rot90": {"a": "a"}})
    assert moved(quarter.scan(grid((1, 1), 1)), "rot90", [1, 2, 3, 4]) == [3, 1, 4, 2]
    assert moved(quarter.scan(grid((2, 1), 1)), "rot180", [1, 2, 3, 4, 5, 6]) == [6, 5, 4, 3, 2, 1]
    with pytest.raises(UserError, match="the body has no such symmetry for its points; it has rot180"):
        moved(quarter.scan(grid((2, 1), 1)), "rot90", [1, 2, 3, 4, 5, 6])


def test_whole_histories_are_mirrored_and_a_wrong_mirror_shows():
    body = anymal()
    symmetry = walker(body)
    obs, action = torch.randn(7, 5, 235), torch.randn(7, 5, 12)
    more, acted, () = symmetry.augment(obs, action, dim=1)
    assert (more.shape, acted.shape) == ((7, 20, 235), (7, 20, 12))
    # a memory that adds up what the joints did turns with its history; one that is carried over from the original not
    joints = slice(24, 36)

    def policy(rows: torch.Tensor) -> torch.Tensor:
        return rows[..., joints].cumsum(0)

    assert symmetry.policy_loss(policy, obs) < 1e-10
    kept = obs[:3, ..., joints].sum(0)
    assert symmetry.policy_loss(lambda rows: kept + rows[..., joints].cumsum(0), obs[3:]) > 0.1
