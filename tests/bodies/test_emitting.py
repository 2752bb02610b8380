"""Files for the loops of others, and audits of mirrors that others wrote: each planted mistake is named."""

import importlib
import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from esp_cli import Body, Field, Kind, layout
from esp_cli.bodies.auditing import audit
from esp_cli.bodies.emitting import emitted, mirror_of
from esp_cli.bodies.kinds import grid
from esp_cli.bodies.numbers import ACTION, Numbers, map_of, numbers_of
from esp_envs.errors import UserError
from tests.bodies.models import biped, legged
from tests.bodies.test_fields import anymal
from tests.cli.running import esp, refused
from tests.torture.mirrors import ROBOTS, Mirrors


def groups(body: Body) -> Numbers:
    """Say what numbers are, as a user does in a module of her own."""
    seen = layout(body.spin(), body.gravity(), body.positions(), body.positions(history=2, name="actions"))
    feet = body.contacts(["left_foot", "right_foot"])
    scan = body.scan(grid((1, 2), 0.5))
    return {
        "policy": seen,
        "critic": layout(body.velocity(), feet, body.velocities(), scan, body.attitude()),
        "action": layout(body.positions()),
    }


ODD = "left\n\"'*/}knee"


@pytest.fixture
def body() -> Body:
    return Body.from_mjcf(mujoco.MjModel.from_xml_string(biped()))


def imported(text: str, folder: Path, name: str = "mirror"):
    (folder / f"{name}.py").write_text(text)
    return SimpleNamespace(**runpy.run_path(str(folder / f"{name}.py")))


def test_the_file_says_where_no_mistake_would_show():
    swing = '<body><joint name="swing" axis="1 0 0"/><geom type="capsule" fromto="0 0 0 0 0 -1" size=".1"/></body>'
    cart = f'<mujoco><worldbody><body><joint name="cart" type="slide" axis="1 0 0"/><geom size=".1"/>{swing}'
    motor = '<actuator><motor joint="swing"/></actuator>'
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(f"{cart}</body></worldbody>{motor}</mujoco>"))
    numbers = {"policy": layout(body.positions()), ACTION: layout(body.positions(["swing"]))}
    assert "to 0; not covered: cart'" in emitted(body, numbers, "cart.xml")


def test_the_file_does_what_the_layouts_say(body, tmp_path):
    numbers = groups(body)
    module = imported(emitted(body, numbers, "biped.xml"), tmp_path)
    assert module.ELEMENTS == ("flip-x",)
    (element,) = body.elements
    for name, told in numbers.items():
        rows, group = np.random.default_rng(0).normal(size=(5, told.width)), None if name == ACTION else name
        np.testing.assert_allclose(module.mirrored(rows, "flip-x", group), rows @ map_of(told, element).T)
        np.testing.assert_allclose(module.mirrored(torch.tensor(rows), "flip-x", group), rows @ map_of(told, element).T)
    obs, actions, reward = module.augment(
        np.ones((7, 5, numbers["policy"].width)), np.ones((7, 5, 9)), np.ones((7, 5)), axis=1
    )
    assert (obs.shape[1], actions.shape[1], reward.shape[1]) == (10, 10, 10)
    assert module.augment(obs[0], actions[0], None)[2] is None
    assert module.mirrored(np.ones((0, 9), "f2")[:, ::-1], "flip-x").dtype == np.float16
    for rows, group, sentence in (
        (np.ones((2, 8)), None, "rows of actions have 8 numbers, the mirror 9"),
        (np.ones((2, 9), int), None, "rows of actions are int64; give floats"),
        (torch.ones(2, 9).bool(), None, "rows of actions are torch.bool; give floats"),
        (np.ones((2, 9)), "image", "no mirror was written of the observations 'image'; name their terms"),
    ):
        with pytest.raises(ValueError, match=sentence):
            module.mirrored(rows, "flip-x", group)


def test_a_turn_that_mixes_numbers_is_written_as_sums_that_nothing_rounds(tmp_path):
    third = Body(["a", "b", "c"], {"rot120": {"a": "b", "b": "c", "c": "a"}})
    module = imported(emitted(third, numbers_of(third, None), "three"), tmp_path)
    rows = np.random.default_rng(0).normal(size=(4, 21))
    turned = module.mirrored(rows, "rot120", "policy")
    np.testing.assert_allclose(np.linalg.norm(turned[:, :3], axis=1), np.linalg.norm(rows[:, :3], axis=1))
    np.testing.assert_allclose(module.mirrored(turned, "rot240", "policy"), rows, atol=1e-9)
    np.testing.assert_allclose(turned[:, 12:15], rows[:, [14, 12, 13]])
    short = torch.tensor(rows, dtype=torch.float32)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(module.mirrored(short, "rot120", "policy"), torch.tensor(turned).float())
    assert module.mirrored(rows[:0], "rot120", "policy").shape == (0, 21)


def test_names_of_strangers_stay_text(tmp_path):
    text = biped().replace("left_knee", ODD.replace("\n", "&#10;").replace('"', "&quot;"))
    body = Body.from_mjcf(mujoco.MjModel.from_xml_string(text))
    module = imported(emitted(body, numbers_of(body, None), "a'''\n\"\"\".xml"), tmp_path)
    assert module.MODEL == "a'''\n\"\"\".xml"
    assert f"positions.{ODD!r}" in module.NUMBERS["policy"]


def test_the_file_needs_neither_this_package_nor_torch(body, tmp_path):
    (tmp_path / "mirror.py").write_text(emitted(body, numbers_of(body, None), "biped.xml"))
    code = (
        "import sys; sys.modules['esp_cli'] = sys.modules['torch'] = None; import numpy, mirror; "
        "print(mirror.compute_symmetric_states(None, numpy.ones((2, 39)), numpy.ones((2, 9)))[0].shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(4, 39)"


def test_without_rsl_rl_its_module_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "rsl_rl", None)
    monkeypatch.setitem(sys.modules, "rsl_rl.algorithms", None)
    monkeypatch.delitem(sys.modules, "esp_cli.loop.rsl_rl", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"needs the extra rsl_rl, .* is missing: pip install"):
        importlib.import_module("esp_cli.loop.rsl_rl")


def test_rsl_rl_takes_the_file(body, tmp_path):
    symmetry = pytest.importorskip("rsl_rl.extensions.symmetry")
    from tensordict import TensorDict

    module = imported(emitted(body, groups(body), "biped.xml"), tmp_path)
    extension = symmetry.Symmetry(
        None, module.compute_symmetric_states, use_data_augmentation=True, use_mirror_loss=True
    )
    widths = {group: len(labels) for group, labels in module.NUMBERS.items() if group != ACTION}
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
    module = imported(emitted(body, numbers_of(body, None), "anymal"), tmp_path)
    found = audit(module.compute_symmetric_states, body, numbers_of(body, None))
    assert [(copy.element, copy.wrong) for copy in found] == [
        (x, ()) for x in ("identity", "flip-x", "flip-y", "rot180")
    ]


def test_the_audit_names_what_is_wrong_and_what_is_right():
    body = anymal()

    def forgets_signs(obs, actions):
        return obs, torch.cat([actions, actions[:, [2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9]]])

    learned = torch.ones((), requires_grad=True)
    (_, copy) = [*audit(lambda actions: learned * forgets_signs(None, actions)[1], body, numbers_of(body, None))]
    assert copy.element == "flip-x"
    assert copy.is_involution
    assert copy.wrong[0] == ("actions.LF_HAA", "actions.RF_HAA", "-actions.RF_HAA")
    assert len(copy.wrong) == 4


def test_the_audit_says_what_it_did_not_see(body, tmp_path):
    mirrored = imported(emitted(body, numbers_of(body, None), "biped"), tmp_path).mirrored

    def right(obs):
        return torch.cat([obs, mirrored(obs, "flip-x", "policy")])

    (_, copy) = audit(right, body, numbers_of(body, None))
    assert (copy.element, copy.wrong, copy.unseen) == ("flip-x", (), ("action",))
    with pytest.raises(UserError, match="not a linear map"):  # it is right for small numbers alone
        audit(lambda obs: right(obs).clamp(-9, 9), body, numbers_of(body, None))


def test_hundreds_of_wrong_mirrors_are_caught_and_relabelled_right_ones_never(tmp_path, monkeypatch):
    mirrors = Mirrors(tmp_path, 0)
    assert [mirrors.run(number) for number in range(27)] == [None] * 27
    assert mirrors.count() == sum(mirrors.counts.values()) >= 300
    assert {robot for robot, _ in mirrors.counts} == set(ROBOTS)
    assert len({kind for _, kind in mirrors.counts}) == 14
    monkeypatch.setattr("esp_cli.bodies.auditing._TOLERANCE", 10)
    assert "a wrong sign of an action is taken" in mirrors.run(0), "the control: an audit that sees nothing"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1", "has no function 'numbers'"),
        ("numbers = lambda body: 1", "returns int; return layouts"),
        ("numbers = lambda body: {'action': 1}", "returns dict"),
        ("numbers = lambda body: {}", "returns dict"),
        ("1 / 0", "cannot import the module 'my_{}' of the function: ZeroDivisionError"),
        ("numbers = lambda body: {}['hip']", ":numbers raises KeyError: 'hip'; it was given the body"),
    ],
)
def test_numbers_that_say_nothing_are_refused(body, tmp_path, monkeypatch, text, words):
    monkeypatch.chdir(tmp_path)
    name = f"my_{abs(hash(text))}"
    Path(f"{name}.py").write_text(text)
    with pytest.raises(UserError, match=words.format(name.removeprefix("my_"))):
        numbers_of(body, f"{name}:numbers")


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda actions: 1, "returns int as actions; return a tensor"),
        (lambda obs, actions: (obs.repeat(2, 1), None), "returns NoneType as actions"),
        (lambda obs, actions: (obs.repeat(3, 1), actions.repeat(2, 1)), "policy 3 times and action 2 times; return"),
        (lambda obs, actions: (obs, actions), "policy 1 times and action 1 times; return all rows, then as many"),
        (lambda actions: actions[:, :2], "rows of 9 were given"),
        (lambda actions: actions.abs(), "not a linear map"),
        (lambda actions: 1 / 0, "raises ZeroDivisionError"),
        (min, "no signature found for builtin .*; give a function of Python that calls it"),
        (lambda obs, actions: 3, r"returns int as observations; return a tensor, or tensors by group \(policy\)"),
        (lambda obs, actions: ({"policy": 3}, actions), "returns dict as observations"),
        (lambda obs, actions: ({}, actions), "returns dict as observations"),
    ],
)
def test_functions_that_are_no_mirror_are_refused(body, function, words):
    with pytest.raises(UserError, match=words):
        audit(function, body, numbers_of(body, None))


def test_a_function_is_called_as_each_version_of_rsl_rl_calls_it(body, tmp_path):
    tensordict = pytest.importorskip("tensordict")
    numbers = numbers_of(body, None)
    right = imported(emitted(body, numbers, "biped"), tmp_path).compute_symmetric_states

    def of_groups(env, obs, actions):
        made = obs.repeat(2)
        made["policy"][obs.batch_size[0] :] = right(env, obs["policy"], actions)[0][len(actions) :]
        return tensordict.TensorDict(made, made.batch_size), right(env, None, actions)[1]

    def passes_on(env, **words):
        return right(env, words.pop("obs"), **words)

    def of_words(**words):
        return passes_on(**words)

    alone = torch.nn.Linear(9, 9, bias=False)  # a module takes anything, and is given the actions
    alone.weight.data = torch.tensor(map_of(numbers[ACTION], body.elements[0])).float()
    both = torch.nn.Module()
    both.forward = lambda actions: torch.cat([actions, alone(actions)])
    (_, copy) = audit(both, body, numbers)
    assert (copy.element, copy.wrong) == ("flip-x", ())
    for function in (of_groups, passes_on, of_words):
        assert [(copy.element, copy.wrong) for copy in audit(function, body, numbers)] == [
            ("identity", ()),
            ("flip-x", ()),
        ]


def test_one_tensor_for_several_groups_is_refused(body):
    pytest.importorskip("tensordict")
    with pytest.raises(UserError, match=r"returns Tensor as observations; return a tensor, or tensors by group"):
        audit(lambda obs, actions: (obs["policy"].repeat(2, 1), actions.repeat(2, 1)), body, groups(body))


def test_a_mirror_is_of_the_elements_that_all_numbers_carry():
    body, action = Body(["a"], {"rot90": {"a": "a"}, "flip-x": {"a": "a"}}), Field("a", Kind.SCALAR)
    square, oblong = ({"policy": layout(body.scan(grid(size, 1))), ACTION: layout(action)} for size in ((1, 1), (2, 1)))
    assert body.group == "d4"
    assert set(mirror_of(body, oblong).ELEMENTS) == {"flip-x", "flip-y", "rot180"}
    assert len(mirror_of(body, square).ELEMENTS) == 7
    with pytest.raises(UserError, match="the body has no rot90; its group is d2"):
        mirror_of(body, oblong, "rot90")
    for group in ("so2", "o2", "flip-x*a-1-0"):
        with pytest.raises(UserError, match=r"is no list of turns and mirrors; write some of .*flip-y"):
            mirror_of(body, oblong, group)
    along, across = body.scan([[1, 0], [2, 0]], name="along"), body.scan([[0, 1], [0, 2]], name="across")
    with pytest.raises(UserError, match="the numbers carry no element of d4 together; leave a field of points out"):
        mirror_of(body, {"policy": layout(along, across), ACTION: layout(action)})


def test_the_commands_name_the_elements_that_a_scan_leaves_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    Path("spider.xml").write_text(legged([(0.2, 0, 0), (0, 0.2, 90), (-0.2, 0, 180), (0, -0.2, 270)]))
    Path("my_scan.py").write_text(
        "from esp_cli import layout\nfrom esp_cli.bodies import grid\ndef numbers(body):\n"
        "    return {'policy': layout(body.scan(grid((2, 1), 1))), 'action': layout(body.controls())}\n"
    )
    order = ["--order", "my_scan:numbers"]
    written = esp("mirror", "spider.xml", "--emit", "numpy", "-o", "my_spider.py", *order)
    audited = esp("check", "mirror", "my_spider:compute_symmetric_states", "spider.xml", *order)
    assert audited.stdout.endswith("is right: its copies are identity, flip-x, flip-y, rot180\n")
    for result in (written, audited):
        assert "left out, as not all numbers carry them: rot90, rot270" in result.stderr
    assert subprocess.run([sys.executable, "-I", "test_my_spider.py"], check=True, capture_output=True).stdout


def test_the_command_writes_audits_and_refuses(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    Path("biped.xml").write_text(biped())
    told = esp("mirror", "biped.xml", "--emit", "rsl_rl", "-o", "my_mirror.py").stdout
    assert told.startswith("my_mirror.py has compute_symmetric_states for flip-x; policy: velocity 3, spin 3")
    assert esp("check", "mirror", "my_mirror:compute_symmetric_states", "biped.xml").stdout == (
        "my_mirror:compute_symmetric_states is right: its copies are identity, flip-x\n"
    )
    Path("my_again.py").write_text(
        "import torch\nfrom my_mirror import compute_symmetric_states\n"
        "def again(env, obs, actions):\n"
        "    made = compute_symmetric_states(env, obs, actions)\n"
        "    return tuple(torch.cat([x, x[len(actions) :]]) for x in made)\n"
    )
    assert esp("check", "mirror", "my_again:again", "biped.xml").stdout == (
        "my_again:again is right: its copies are identity, flip-x, flip-x\n"
        "but it returns flip-x 2 times; once is enough\n"
    )
    Path("my_half.py").write_text(
        "from my_mirror import compute_symmetric_states\n"
        "def half(actions):\n    return compute_symmetric_states(None, None, actions)[1]\n"
    )
    assert esp("check", "mirror", "my_half:half", "biped.xml").stdout.endswith(
        "not compared: policy, of which it makes no copies\n"
    )
    proof = [sys.executable, "-I", "test_my_mirror.py"]
    assert subprocess.run(proof, capture_output=True, text=True, check=True).stdout == "proven\n"
    right = Path("my_mirror.py").read_text()
    text = right.replace("[[-1,", "[[1,")
    Path("my_mirror.py").write_text(text)
    assert b"AssertionError" in subprocess.run(proof, capture_output=True, check=False).stderr, "one sign is wrong"
    Path("my_mirror.py").write_text(right)
    Path("my_wrong.py").write_text(text)
    result = esp("check", "mirror", "my_wrong:compute_symmetric_states", "biped.xml", "--json", "-", code=1)
    assert json.loads(result.stdout)["copies"][1]["wrong"] == [["actions.waist", "actions.waist", "-actions.waist"]]
    assert "exists" in refused("mirror", "biped.xml", "--emit", "numpy", "-o", "my_mirror.py")
    Path("my_mirror.py").unlink()
    assert "test_my_mirror.py exists" in refused("mirror", "biped.xml", "--emit", "numpy", "-o", "my_mirror.py")
    Path("my_mirror.py").write_text(right)
    assert "belong together" in refused("mirror", "biped.xml", "--emit", "numpy")
    assert "has to end in .py" in refused("mirror", "biped.xml", "--emit", "numpy", "-o", "my_mirror")
    assert "cannot import" in refused("check", "mirror", "nowhere:mirror", "biped.xml")
    assert "names no function" in refused("check", "mirror", "nowhere", "biped.xml")
    assert "names no function" in refused("check", "mirror", "my_mirror:augment", "biped.xml", "--order", "1:")
    Path("order.txt").write_text("right_knee\nleft_knee\n\n waist \n")
    esp("mirror", "biped.xml", "--emit", "numpy", "-o", "few.py", "--order", "order.txt")
    assert "'actions.right_knee', 'actions.left_knee', 'actions.waist'" in Path("few.py").read_text()
    esp("check", "mirror", "few:compute_symmetric_states", "biped.xml", "--order", "order.txt")
    for text, words in (
        ("left_knee", "the image of left_knee"),
        ("knee", "there is no knee"),
        ("\n", "no list of joints"),
    ):
        Path("order.txt").write_text(text)
        assert words in refused("mirror", "biped.xml", "--emit", "numpy", "-o", "no.py", "--order", "order.txt")
    assert "no.txt" in refused("mirror", "biped.xml", "--emit", "numpy", "-o", "no.py", "--order", "no.txt")
    assert "add --emit" in refused("mirror", "biped.xml", "--order", "order.txt")
    Path("biped.xml").write_text(biped(right_y=-0.2))
    assert "has no mirror or turn" in refused("check", "mirror", "few:mirrored", "biped.xml")
