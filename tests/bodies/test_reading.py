"""Model files of strangers: nothing outside their folder is read, and what is wrong ends in one sentence."""

import os

import mujoco
import pytest

from esp_cli.bodies import Body, read_model
from esp_envs.errors import UserError
from tests.bodies.models import biped
from tests.cli.running import esp, refused

BOX = '<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>'
LINK = (
    '<link name="{0}"><inertial><origin xyz="0 0 -.1"/><mass value="1"/>'
    '<inertia ixx=".1" iyy=".2" izz=".3" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="{0}_joint" type="revolute"><parent link="base"/><child link="{0}"/><origin xyz="0 {1} 0"/>'
    '<axis xyz="{2}"/><limit lower="-1" upper="1" effort="1" velocity="1"/>{3}</joint>'
)
URDF = (
    '<robot name="two">' + "".join(map(LINK.format, ("base", "left", "right")))
    + JOINT.format("left", 0.1, "1 0 0", "") + JOINT.format("right", -0.1, "1 0 0", "{}") + "</robot>"
)  # fmt: skip


def sentence(path, **choice) -> str:
    with pytest.raises(UserError) as error:
        read_model(path, **choice)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<!DOCTYPE m [<!ENTITY a "b"><!ENTITY c "&a;&a;&a;">]><mujoco>&c;</mujoco>', "document type"),
        ("<mujoco>", "not an XML file"),
        ("\0\1", "not an XML file"),
        ("<a/>", "neither MJCF nor URDF"),
        ("<b>" * 200 + "</b>" * 200, "neither"),
        ("<mujoco>" + "<b>" * 200 + "</b>" * 200 + "</mujoco>", "too deep"),
        ('<mujoco><replicate count="999"><replicate count="999"><geom/></replicate></replicate></mujoco>', "more than"),
        ('<mujoco><asset><hfield name="h" nrow="70000" ncol="70000" size="1 1 1 1"/></asset></mujoco>', "cells"),
        ('<mujoco><size nuser_body="70000"/></mujoco>', "nuser_body"),
        ('<mujoco><asset><texture builtin="flat" type="cube" width="30000"/></asset></mujoco>', "cells"),
        ('<mujoco><asset><mesh name="m" builtin="supersphere" params="1e6 1 1"/></asset></mujoco>', "params"),
        ('<mujoco><replicate xmlns="a" count="99999"><geom/></replicate></mujoco>', "more than"),
        ('<mujoco><size memory="100G"/></mujoco>', "memory"),
        ('<mujoco><include file="../secret.xml"/></mujoco>', "outside"),
        ('<mujoco><asset><mesh file="../secret.xml"/></asset></mujoco>', "outside"),
        ('<mujoco><compiler meshdir=".."/><asset><mesh file="secret.xml"/></asset></mujoco>', "outside"),
        ('<mujoco><asset><mesh file="link.xml"/></asset></mujoco>', "outside"),
        ('<mujoco><include file="inner/more.xml"/></mujoco>', "outside"),
        ('<mujoco><include xmlns="a" file="inner/more.xml"/></mujoco>', "outside"),
        ('<mujoco><asset><model name="c" file="inner/part.xml"/></asset></mujoco>', "outside"),
        ('<mujoco><include file="pipe"/></mujoco>', "no regular file"),
        ('<mujoco><asset><mesh file="pipe"/></asset></mujoco>', "no regular file"),
        ('<mujoco><asset><texture file="../pipe"/></asset></mujoco>', "outside"),
        ('<mujoco><asset><mesh file="missing.stl"/></asset></mujoco>', "cannot read"),
        ('<mujoco><worldbody><body><joint/></body></worldbody></mujoco>', "a body moves but has no mass or inertia"),
        ('<mujoco><worldbody><body name="&#10;\'*/"><joint type="a&#10;b"/></body></worldbody></mujoco>', "keyword"),
    ],
)  # fmt: skip
def test_bad_files_end_in_one_sentence(tmp_path, text, words):
    folder = tmp_path / "robot"
    (folder / "inner").mkdir(parents=True)
    (tmp_path / "secret.xml").write_text(BOX)
    (folder / "link.xml").symlink_to(tmp_path / "secret.xml")
    for pipe in (folder / "pipe", tmp_path / "pipe"):
        os.mkfifo(pipe)
    (folder / "inner" / "more.xml").write_text('<mujocoinclude><include file="../../secret.xml"/></mujocoinclude>')
    (folder / "inner" / "part.xml").write_text(
        '<mujoco><compiler meshdir="../.."/><asset><mesh file="secret.xml"/></asset></mujoco>'
    )
    path = folder / "robot.xml"
    path.write_text(text)
    assert words in sentence(path)


def test_files_within_the_named_root_are_read(tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "shared.xml").write_text(BOX)
    path = tmp_path / "robot" / "robot.xml"
    path.write_text('<mujoco><include file="../shared.xml"/></mujoco>')
    assert "--root" in sentence(path)
    assert read_model(path, root=tmp_path).njnt == 1


def test_missing_and_huge_files_are_refused(tmp_path):
    assert "no model file" in sentence(tmp_path / "none.xml")
    (tmp_path / "huge.xml").write_bytes(b"<mujoco>" + b" " * (17 * 2**20) + b"</mujoco>")
    assert "MiB" in sentence(tmp_path / "huge.xml")
    with (tmp_path / "huge.stl").open("wb") as mesh:
        mesh.truncate(300 * 2**20)
    (tmp_path / "mesh.xml").write_text('<mujoco><asset><mesh file="huge.stl"/></asset></mujoco>')
    assert "has 300 MiB" in sentence(tmp_path / "mesh.xml")
    for place in ('<compiler meshdir="{}"/>', '<asset><mesh file="{}"/></asset>'):
        (tmp_path / "mesh.xml").write_text(f"<mujoco>{place.format('x/' * 3000)}</mujoco>")
        assert "give a shorter name" in sentence(tmp_path / "mesh.xml")


def test_a_joint_without_a_name_is_not_taken_for_another():
    second = '<body pos="0 0 .2"><joint name="joint#0"/><geom size=".1"/></body>'
    text = f'<mujoco><worldbody><body><joint/><geom size=".1"/>{second}</body></worldbody></mujoco>'
    with pytest.raises(UserError, match="without a name is called as another"):
        Body.from_mjcf(mujoco.MjModel.from_xml_string(text))


def test_models_of_thousands_of_parts_are_refused(tmp_path):
    path = tmp_path / "many.xml"
    for many in (
        biped(extra="<body/>" * 1000),
        biped().replace("</actuator>", '<motor joint="waist"/>' * 200 + "</actuator>"),
        biped(extra='<body><joint/><geom size=".1"/></body>' * 200),
    ):
        path.write_text(many)
        assert "1 to 200 degrees of freedom and at most 200 actuators and 1000 bodies" in refused("mirror", path)


def test_contacts_that_take_more_memory_than_the_model_grants_are_one_sentence_or_none(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    limbs = "".join(f'<body pos="0 0 {k / 100}"><joint axis="0 1 0"/><geom size=".3"/></body>' for k in range(40))
    for memory in ("20K", "200K"):
        text = f'<mujoco><size memory="{memory}"/><worldbody><body><freejoint/><geom size=".3"/>{limbs}</body>'
        (tmp_path / f"{memory}.xml").write_text(f"{text}</worldbody></mujoco>")
    assert "MuJoCo cannot simulate the model" in refused("mirror", "20K.xml")
    assert Body.from_mjcf("200K.xml").group == "d2"
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert capfd.readouterr() == ("", "")


def test_a_urdf_moves_freely_and_keeps_its_mimic_joint(tmp_path):
    path = tmp_path / "two.urdf"
    path.write_text(URDF.format('<mimic joint="left_joint" multiplier="-1"/>'))
    body = Body.from_urdf(path)
    assert body.group == "d2"
    assert body.rows("flip-x")[0][:3] == ("left_joint", "right_joint", -1)
    assert body.found["flip-x"].proof.verdict == "exact"
    path.write_text(URDF.format('<mimic joint="left_joint"/>'))  # both swing to one side, as they do in the mirror
    assert Body.from_urdf(path).found["flip-x"].proof.verdict == "exact"
    path.write_text(URDF.format('<mimic joint="left_joint" multiplier="2"/>'))
    body = Body.from_urdf(path)
    assert body.group == "flip-y"
    assert "accelerations of left_joint differ by" in body.refused["flip-x"]


def test_a_urdf_without_inertia_is_refused(tmp_path):
    path = tmp_path / "none.urdf"
    path.write_text('<robot name="r"><link name="a"/><link name="b"/>' + JOINT.format("b", 1, "1 0 0", "")
                    .replace('parent link="base"', 'parent link="a"') + "</robot>")  # fmt: skip
    assert ": a moves but has no mass or inertia; give it an <inertial>" in sentence(path)


def test_odd_names_are_quoted_in_tables_and_messages(tmp_path):
    path = tmp_path / "odd.xml"
    path.write_text(biped().replace("left_knee", "left&#10;&quot;'*/knee"))
    result = esp("mirror", path)
    assert "-waist" in result.stdout
    assert "left\n" not in result.stdout


def test_the_command_answers_first_and_says_why_not(tmp_path):
    path = tmp_path / "biped.xml"
    path.write_text(biped())
    lines = esp("mirror", path, "--json", tmp_path / "mirror.json").stdout.splitlines()
    assert lines[0] == "biped.xml is symmetric under flip-x, exactly; 9 joints"
    assert "left_roll" in "".join(lines)
    path.write_text(biped(right_y=-0.2))
    assert "no mirror or turn" in esp("mirror", path, code=1).stdout
    assert "no model file" in refused("mirror", tmp_path / "none.xml")
    assert "there is no folder nowhere; name the one" in refused("mirror", path, "--root", "nowhere")
    with pytest.raises(UserError, match="is MJCF, not URDF; read it with"):
        Body.from_urdf(path)
    with pytest.raises(UserError, match="a model is given as NoneType; give the path of a file"):
        Body.from_mjcf(None)
