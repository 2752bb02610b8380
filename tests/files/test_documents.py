"""JSON documents: what is written is read again, and anything else ends in one sentence."""

import json

import pytest
from pydantic import BaseModel, ConfigDict, Field

from esp_cli.files import documents
from esp_cli.files.documents import MAX_DOCUMENT_BYTES, MAX_NESTING, DocumentFormat, parse_value, read_table
from esp_envs.errors import UserError

TOY = DocumentFormat("esp-toy", 2, "a toy")


class Toy(BaseModel):
    model_config = ConfigDict(extra="forbid")
    size: int = Field(ge=1)


def document(**content):
    return json.dumps({"format": "esp-toy", "version": 2, **content}).encode()


def test_what_is_written_is_read_again(tmp_path):
    TOY.write(tmp_path / "a.json", {"size": 3})
    assert json.loads((tmp_path / "a.json").read_text()) == {"format": "esp-toy", "version": 2, "size": 3}
    assert TOY.read(tmp_path / "a.json") == {"size": 3}
    assert TOY.parse(tmp_path / "a.json", Toy) == Toy(size=3)


def test_a_document_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "a.json"
    TOY.write(path, {"name": "é"})
    for content in ({"x": float("inf")}, {"x": object()}, {"format": "other"}, {"x": "\ud800"}):
        with pytest.raises(UserError, match=r"cannot write .*(not JSON|may not use the keys)"):
            TOY.write(path, content)
    assert TOY.read(path) == {"name": "é"}
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "cannot read .*: No such file or directory"),
        (b"", "not valid JSON"),
        (b"{", "not valid JSON"),
        (b"\xff\xfe", "not valid JSON"),
        (b"[]", "no JSON object"),
        (b"[" * 200_000, "nested more than 64 deep"),
        (b'{"a":' * 200_000, "nested more than 64 deep"),
        (document(a=None).replace(b"null", b"[" * 64 + b"]" * 64), "nested more than 64 deep"),
        (b'{"a": NaN}', "NaN is no finite number"),
        (b'{"a": 1e999}', "1e999 is no finite number"),
        (b'{"a": ' + b"9" * 5000 + b"}", "has more than 64 bits"),
        (b'{"a": 1, "a": 2}', "a key stands twice"),
        (b'{"size": 3}', "is foreign: it is not a toy of esp"),
        (b'{"format": "other", "version": 2}', "is foreign: it is not a toy of esp"),
        (b'{"format": "esp-toy", "version": true}', "is foreign"),
        (b'{"format": "esp-toy", "version": 3}', "was written by a newer esp; update esp"),
        (document(), "the setting 'size' is missing"),
        (document(size=0), "bad value 0 for 'size': input should be greater than or equal to 1"),
        (document(size=1, colour="red"), "unknown setting 'colour'; it has size"),
        (document(size="x" * 500), r"bad value '[x]{70,80}\.\.\. for 'size'"),
        (b" " * (MAX_DOCUMENT_BYTES + 1), "is larger than a toy can be"),
    ],
)
def test_damage_ends_in_one_sentence(tmp_path, content, text):
    if content is not None:
        (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(UserError, match=text) as caught:
        TOY.parse(tmp_path / "a.json", Toy)
    assert str(tmp_path / "a.json") in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_values_at_the_bounds_are_read():
    assert parse_value("[" * MAX_NESTING + "]" * MAX_NESTING) is not None
    assert parse_value(str(2**63 - 1)) == 2**63 - 1
    with pytest.raises(ValueError, match="64 bits"):
        parse_value(str(2**63))


@pytest.mark.parametrize("part", ["a", " a\t", '"a.b"', '"\\""', "'a \\'"])
@pytest.mark.parametrize("line", ["{} = 1", "[{}]", "[[{}]]", "a = {{b = 1, {} = 1}}"])
def test_a_deep_key_of_toml_is_refused_before_it_takes_time_and_memory(tmp_path, monkeypatch, part, line):
    file = tmp_path / "a.toml"
    file.write_text(line.format(".".join([part] * (MAX_NESTING - 2))))  # a list of tables is two more
    assert read_table(file)
    monkeypatch.setattr(documents.tomllib, "loads", pytest.fail)
    file.write_text(line.format(".".join([part] * (MAX_NESTING + 1))))
    with pytest.raises(UserError, match="is not valid TOML: it is nested more than 64 deep"):
        read_table(file)
