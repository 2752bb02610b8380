"""How far a policy is from turning with its body: right, wrong and hostile policies."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from esp_cli import Body, layout
from esp_cli.bodies.turning import policy_of, rows_of, turning
from esp_envs.errors import UserError
from tests.bodies.models import QUADRUPED
from tests.cli.running import esp, refused


@pytest.fixture
def pair() -> tuple[Body, dict]:
    """Two joints that a mirror exchanges with a sign; the policy sees both, and moves both."""
    body = Body(["left", "right"], {"left-right": {"left": "-right", "right": "-left"}})
    return body, {"policy": layout(body.positions(), body.gravity()), "action": layout(body.positions(name="target"))}


def test_distances_by_hand(pair):
    body, numbers = pair
    (found,) = turning(lambda rows: 2 * rows[:, :2], body, numbers)
    assert (found.element, found.distance) == ("flip-x", 0)
    # one joint takes its own position, the other none: K pi(s) = (0, -a) where pi(L s) = (-b, 0)
    (found,) = turning(lambda rows: rows[:, :2] * [1, 0], body, numbers)
    assert found.distance == pytest.approx(1, abs=0.05)
    # a fifth is added to one joint: its gap is 0.2, an unrelated state's sqrt(2 + 0.04), and likewise of its image
    (found,) = turning(lambda rows: rows[:, :2] + [0.2, 0], body, numbers)
    assert found.distance == pytest.approx(0.2 / 2.04**0.5, abs=0.01)
    (found,) = turning(lambda rows: np.ones((len(rows), 2)), body, numbers)
    assert found.distance == pytest.approx(1)
    assert found.action in ("target.left", "target.right")
    two = np.array([[1.0, 2, 0, 0, 1], [3, 4, 0, 0, 1]])
    (found,) = turning(lambda rows: rows[:, :2], body, numbers, two)
    assert found.distance == 0
    # pi(L s) is (-2, 0) and (-4, 0), K pi(s) is (0, -1) and (0, -3): gaps of 4 + 1 and 16 + 9, and of unlike rows of
    # 4 + 9 and 16 + 1
    (found,) = turning(lambda rows: rows[:, :2] * [1, 0], body, numbers, two)
    assert found.distance == pytest.approx((30 / 30) ** 0.5)
    with pytest.raises(UserError, match="the rows are all the same"):
        turning(lambda rows: rows[:, :2], body, numbers, np.repeat(two[:1], 3, 0))


def test_the_order_of_rows_says_nothing(pair):
    walk = np.cumsum(np.random.default_rng(0).normal(size=(500, 5)), 0)  # each row is like the one before
    shuffled = np.random.default_rng(1).permutation(walk)
    (first,), (second,) = (turning(lambda x: np.tanh(x[:, :2] + [0.3, 0]), *pair, x) for x in (walk, shuffled))
    assert first.distance == pytest.approx(second.distance)


def test_what_has_length_one_has_it(pair):
    body, numbers = pair
    turning(
        lambda rows: np.testing.assert_allclose(np.linalg.norm(rows[:, 2:], axis=1), 1) or rows[:, :2], body, numbers
    )


@pytest.mark.parametrize(
    ("actor", "words"),
    [
        (lambda rows: rows, r"returns \[2048, 5\]; give finite actions \[2048, 2\]"),
        (lambda rows: rows[:, :2] * np.nan, "give finite actions"),
        (lambda rows: 1 / 0, "the policy raises ZeroDivisionError: division by zero; it was given rows"),
        (lambda rows: sys.exit(0), "the policy raises SystemExit: 0"),
        (lambda rows: {"action": rows}, "the policy raises TypeError"),
    ],
)
def test_what_is_no_policy_of_the_body_is_refused(pair, actor, words):
    with pytest.raises(UserError, match=words):
        turning(actor, *pair)


def test_files_of_policies_and_rows_are_read_or_refused(tmp_path):
    class Doubled(torch.nn.Module):
        def forward(self, rows):
            return 2 * rows

    torch.jit.script(Doubled()).save(str(tmp_path / "policy.pt"))
    assert policy_of(str(tmp_path / "policy.pt"))(np.ones((3, 2))).tolist() == [[2, 2]] * 3
    torch.jit.script(torch.nn.Linear(2, 1).double()).save(str(tmp_path / "double.pt"))
    assert policy_of(str(tmp_path / "double.pt"))(np.ones((3, 2))).dtype == np.float64
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    for inputs, name in (
        ("float[n, 2] x", "policy.onnx"),
        ("float[1, 2] x", "alone.onnx"),
        ("float[n, 2] x, float[n, 2] memory", "memory.onnx"),
    ):
        text = f'<ir_version: 8, opset_import: ["": 17]> policy ({inputs}) => (float[n, 2] y) {{ y = Add(x, x) }}'
        (tmp_path / name).write_bytes(onnx.parser.parse_model(text).SerializeToString())
    for name in ("policy.onnx", "alone.onnx"):
        assert policy_of(str(tmp_path / name))(np.array([[1, 2], [3, 4]])).tolist() == [[2, 4], [6, 8]]
    with pytest.raises(UserError, match="takes x, memory; give a policy of observations alone"):
        policy_of(str(tmp_path / "memory.onnx"))
    for name, words in (("bad.onnx", "is no ONNX model"), ("bad.pt", "is neither ONNX nor TorchScript")):
        (tmp_path / name).write_bytes(b"PK\x03\x04 nothing")
        with pytest.raises(UserError, match=words):
            policy_of(str(tmp_path / name))
    np.save(tmp_path / "rows.npy", np.ones((3, 2), "f4"))
    assert rows_of(tmp_path / "rows.npy").dtype == np.float64
    np.save(tmp_path / "code.npy", np.array([{}], object), allow_pickle=True)
    content = (tmp_path / "rows.npy").read_bytes()
    (tmp_path / "vast.npy").write_bytes(content.replace(b"(3, 2), }" + b" " * 12, b"(3, 2" + b"0" * 11 + b"), } "))
    np.save(tmp_path / "waves.npy", np.ones((3, 2), complex))
    np.save(tmp_path / "words.npy", np.array([["1", "2"]]))
    for name in ("code.npy", "bad.pt", "vast.npy", "waves.npy", "words.npy"):
        with pytest.raises(UserError, match=r"is no \.npy file of numbers"):
            rows_of(tmp_path / name)


def test_the_command_measures_a_function(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("robot.xml").write_text(QUADRUPED)
    Path("walking.py").write_text(
        "def act(rows):\n    return 2 * rows[:, 12:20]\n\ndef odd(rows):\n    return rows[:, :8]\n"
    )
    right = esp("check", "policy", "walking:act", "robot.xml", "--json", "-").stdout
    assert [(one["element"], one["distance"]) for one in json.loads(right)["elements"]] == [
        (name, 0) for name in ("flip-x", "flip-y", "rot180")
    ]
    told = esp("check", "policy", "walking:odd", "robot.xml").stdout
    assert "unrelated states" in told
    assert "--rows are observations" in refused("check", "mirror", "a:b", "robot.xml", "--rows", "a.npy")
    assert "name the robot's model too" in refused("check", "policy", "walking:act")
    assert "belong to tasks" in refused("check", "policy", "walking:act", "robot.xml", "--transforms", "d4")
    assert "belong to 'esp check mirror|policy'" in refused("check", "task", "navigation", "robot.xml")
    np.save("rows.npy", np.ones((4, 3)))
    said = refused("check", "policy", "walking:act", "robot.xml", "--rows", "rows.npy")
    assert "the rows have shape [4, 3]; give finite numbers [M, 36]" in said
