"""Files for the loops of others, and audits of mirrors that others wrote: each planted mistake is named."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from esp_cli import Body
from esp_cli.bodies.auditing import audit
from esp_cli.bodies.emitting import emitted
from esp_cli.bodies.terms import map_of, read_numbers
from esp_envs.errors import UserError
from tests.bodies.models import QUADRUPED, biped
from tests.bodies.test_deriving import GYMNASIUM
from tests.bodies.test_fields import JOINTS, anymal
from tests.cli.running import esp, refused

GROUPS = {
    "observations": {
        "policy": ["base_ang_vel", "projected_gravity", "joint_pos", {"term": "actions", "history": 2}],
        "critic": ["base_lin_vel", {"term": "contacts", "names": ["left_foot", "right_foot"]}, "joint_vel",
                   {"term": "height_scan", "size": [1, 2], "resolution": 0.5}, {"term": "quaternion", "name": "q"}],
    }
}  # fmt: skip
ODD = "left\n\"'*/}knee"


@pytest.fixture
def body() -> Body:
    return Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()))


def numbers_of(body: Body, told: object, folder: Path):
    (folder / "order.json").write_text(json.dumps(told))
    return read_numbers(body, folder / "order.json")


def imported(text: str, folder: Path, name: str = "mirror"):
    (folder / f"{name}.py").write_text(text)
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_file_does_what_the_layouts_say(body, tmp_path):
    numbers = numbers_of(body, GROUPS, tmp_path)
    module = imported(emitted(body, numbers, "biped.xml"), tmp_path)
    assert module.ELEMENTS == ("flip-x",)
    (element,) = body.elements
    for group, layout in [*numbers.groups.items(), (None, numbers.action)]:
        rows = np.random.default_rng(0).normal(size=(5, layout.width))
        np.testing.assert_allclose(module.mirrored(rows, "flip-x", group), rows @ map_of(layout, element).T)
        np.testing.assert_allclose(
            module.mirrored(torch.tensor(rows), "flip-x", group), rows @ map_of(layout, element).T
        )
    obs, actions, reward = module.augment(
        np.ones((7, 5, numbers.groups["policy"].width)), np.ones((7, 5, 9)), np.ones((7, 5)), axis=1
    )
    assert (obs.shape[1], actions.shape[1], reward.shape[1]) == (10, 10, 10)
    with pytest.raises(ValueError, match="rows of actions have 8 numbers, the mirror 9"):
        module.mirrored(np.ones((2, 8)), "flip-x")


def test_a_turn_that_mixes_numbers_is_written_as_a_matrix(tmp_path):
    third = Body(["a", "b", "c"], {"rot120": {"a": "b", "b": "c", "c": "a"}})
    module = imported(emitted(third, read_numbers(third, None), "three"), tmp_path)
    rows = np.random.default_rng(0).normal(size=(4, 21))
    turned = module.mirrored(rows, "rot120", "policy")
    np.testing.assert_allclose(np.linalg.norm(turned[:, :3], axis=1), np.linalg.norm(rows[:, :3], axis=1))
    np.testing.assert_allclose(module.mirrored(turned, "rot240", "policy"), rows, atol=1e-9)
    np.testing.assert_allclose(turned[:, 12:15], rows[:, [14, 12, 13]])


def test_names_of_strangers_stay_text(tmp_path):
    text = biped().replace("left_knee", ODD.replace("\n", "&#10;").replace('"', "&quot;"))
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(text))
    module = imported(emitted(body, read_numbers(body, None), "a'''\n\"\"\".xml"), tmp_path)
    assert module.MODEL == "a'''\n\"\"\".xml"
    assert repr(ODD) in "".join(module.NUMBERS["policy"])


def test_the_file_needs_neither_this_package_nor_torch(body, tmp_path):
    (tmp_path / "mirror.py").write_text(emitted(body, read_numbers(body, None), "biped.xml"))
    code = (
        "import sys; sys.modules['esp_cli'] = sys.modules['torch'] = None; import numpy, mirror; "
        "print(mirror.compute_symmetric_states(None, numpy.ones((2, 39)), numpy.ones((2, 9)))[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(4, 39)"


def test_rsl_rl_takes_the_file(body, tmp_path):
    symmetry = pytest.importorskip("rsl_rl.extensions.symmetry")
    from tensordict import TensorDict

    module = imported(emitted(body, numbers_of(body, GROUPS, tmp_path), "biped.xml"), tmp_path)
    extension = symmetry.Symmetry(
        None, module.compute_symmetric_states, use_data_augmentation=True, use_mirror_loss=True
    )
    widths = {group: len(labels) for group, labels in module.NUMBERS.items() if group}
    obs = TensorDict({group: torch.randn(6, width) for group, width in widths.items()}, batch_size=[6])
    ones = torch.ones(6, 1)
    batch = type("Batch", (), {"observations": obs, "actions": torch.randn(6, 9), "old_actions_log_prob": ones,
                               "values": ones, "advantages": ones, "returns": ones})()  # fmt: skip
    extension.augment_batch(batch, 6)
    assert (batch.observations.batch_size[0], len(batch.actions), len(batch.returns)) == (12, 12, 12)

    def actor(rows: TensorDict) -> torch.Tensor:
        return rows["policy"][:, 6:15]  # targets are the joint positions: it turns with the body

    assert extension.compute_loss(actor, batch, 6) < 1e-10
    assert extension.compute_loss(lambda rows: rows["policy"][:, :9], batch, 6) > 0.1


def test_the_audit_of_a_right_mirror_names_its_elements(tmp_path):
    body = anymal()
    module = imported(emitted(body, read_numbers(body, None), "anymal"), tmp_path)
    found = audit(module.compute_symmetric_states, body, read_numbers(body, None))
    assert [(copy.element, copy.wrong) for copy in found] == [
        (x, ()) for x in ("identity", "flip-x", "flip-y", "rot180")
    ]


def test_the_audit_names_what_is_wrong_and_what_is_right():
    body = anymal()

    def forgets_signs(obs, actions):
        return obs, torch.cat([actions, actions[:, [2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9]]])

    (_, copy) = [*audit(lambda actions: forgets_signs(None, actions)[1], body, read_numbers(body, None))]
    assert copy.element == "flip-x"
    assert copy.is_involution
    assert copy.wrong[0] == ("action.LF_HAA", "action.RF_HAA", "-action.RF_HAA")
    assert len(copy.wrong) == 4


def robots() -> dict[str, Body]:
    files = {name: Body.from_mjcf(GYMNASIUM / f"{name}.xml") for name in ("ant", "humanoid", "swimmer")}
    texts = {"biped": biped(), "quadruped": QUADRUPED}
    return (
        files | {n: Body.from_mjcf(mujoco.MjModel.from_xml_string(t)) for n, t in texts.items()} | {"anymal": anymal()}
    )


def test_hundreds_of_wrong_mirrors_are_caught_and_relabelled_right_ones_never(tmp_path):
    caught = 0
    terms = ["base_lin_vel", "base_ang_vel", "projected_gravity", "quaternion", "joint_vel"]
    terms.append({"term": "joint_pos", "history": 3})
    scan = {"term": "height_scan", "size": [2, 1], "resolution": 0.5}
    for body in robots().values():
        order = list(np.random.default_rng(0).permutation(list(body.joints)))
        seen = terms if body.group == "d4" else [*terms, scan]  # a grid that is no square does not turn by quarters
        numbers = numbers_of(body, {"joints": order, "observations": seen}, tmp_path)
        (layout,) = numbers.groups.values()
        for element in body.elements[:3]:
            right = map_of(layout, element), map_of(numbers.action, element)
            assert verdict(*right, body, numbers) == []
            for wrong in mistakes(*right, layout):
                assert verdict(*wrong, body, numbers)
                caught += 1
    assert caught >= 300


def verdict(seen: np.ndarray, acted: np.ndarray, body: Body, numbers) -> list:
    L, K = torch.tensor(seen).float(), torch.tensor(acted).float()

    def function(obs, actions):
        return torch.cat([obs, obs @ L.T]), torch.cat([actions, actions @ K.T])

    return [row for copy in audit(function, body, numbers) for row in copy.wrong]


def mistakes(seen: np.ndarray, acted: np.ndarray, layout):
    """Yield maps with one mistake: signs, orders, polar for axial, quaternions, histories, scans."""
    places = layout.slices()
    for k in range(len(acted)):
        yield seen, acted * np.where(np.arange(len(acted)) == k, -1, 1)[:, None]
        start = places["joint_pos"].start + k
        yield seen * np.where(np.arange(len(seen)) == start, -1, 1)[:, None], acted
    for name in ("base_lin_vel", "base_ang_vel", "quaternion"):
        part = places[name]
        for change in (-1.0, None):
            wrong = seen.copy()
            wrong[part, part] = -wrong[part, part] if change else np.roll(wrong[part, part], 1, axis=0)
            yield wrong, acted
    swapped = seen.copy()
    swapped[:6, :6] = 0
    swapped[:3, :3], swapped[3:6, 3:6] = seen[3:6, 3:6], seen[:3, :3]
    if not np.array_equal(swapped, seen):  # a turn does the same to both
        yield swapped, acted
    for part in (places["joint_pos"], places.get("height_scan")):
        if part is not None:
            wrong = seen.copy()
            wrong[part] = np.roll(wrong[part], 1, axis=0)
            yield wrong, acted
    if len(acted) > 1:
        yield seen, np.roll(acted, 1, axis=0)


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ([1], "holds something else"),
        ({"joint": []}, "holds 'joint'"),
        ({"joints": "hip"}, "no list of names"),
        ({"joints": ["paw"]}, "no paw among its joints"),
        ({"observations": ["speed"]}, "'speed' is no term; a term is base_lin_vel"),
        ({"observations": []}, "no list of terms"),
        ({"observations": [{"term": "joint_pos", "history": 0}]}, "whole numbers from 1"),
        ({"observations": [{"term": "contacts"}]}, "no list of names"),
        ({"observations": ["joint_pos", "joint_pos"]}, "field names must differ"),
    ],
)
def test_orders_that_fit_nothing_are_refused(body, tmp_path, told, words):
    with pytest.raises(UserError, match=words):
        numbers_of(body, told, tmp_path)


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda actions: 1, "neither observations nor actions"),
        (lambda actions: actions[:, :2], "rows of 9 were given"),
        (lambda actions: actions.abs(), "not a linear map"),
        (lambda actions: 1 / 0, "raises ZeroDivisionError"),
    ],
)
def test_functions_that_are_no_mirror_are_refused(body, function, words):
    with pytest.raises(UserError, match=words):
        audit(function, body, read_numbers(body, None))


def test_the_command_writes_audits_and_refuses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("biped.xml").write_text(biped())
    told = esp("mirror", "biped.xml", "--emit", "rsl_rl", "-o", "my_mirror.py").stdout
    assert told.startswith("my_mirror.py has compute_symmetric_states for flip-x: policy (base_lin_vel 3,")
    assert esp("mirror", "biped.xml", "--check", "my_mirror:compute_symmetric_states").stdout == (
        "my_mirror:compute_symmetric_states is right: its copies are identity, flip-x\n"
    )
    text = Path("my_mirror.py").read_text().replace("'sign': [-1,", "'sign': [1,")
    Path("my_wrong.py").write_text(text)
    result = esp("mirror", "biped.xml", "--check", "my_wrong:compute_symmetric_states", "--json", "-", code=1)
    assert json.loads(result.stdout)["check"][1]["wrong"] == [["action.waist", "action.waist", "-action.waist"]]
    assert "exists" in refused("mirror", "biped.xml", "--emit", "numpy", "-o", "my_mirror.py")
    assert "belong together" in refused("mirror", "biped.xml", "--emit", "numpy")
    assert "cannot import" in refused("mirror", "biped.xml", "--check", "nowhere:mirror")
    assert "names no function" in refused("mirror", "biped.xml", "--check", "nowhere")
    assert "not JSON" in refused("mirror", "biped.xml", "--check", "my_mirror:augment", "--order", "biped.xml")


def test_joint_names_of_the_page_are_isaac_sims():
    assert JOINTS[:4] == ["LF_HAA", "LH_HAA", "RF_HAA", "RH_HAA"]
    assert all(len({a, b}) == 2 for a, b in product(JOINTS[:1], JOINTS[1:]))
