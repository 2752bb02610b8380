"""Checkpoint files: what goes in comes out, and whatever else is in a file ends in one UserError."""

import hashlib
import json
import os
import struct
from pathlib import Path

import pytest
import safetensors.torch
import torch

from esp_cli.training.checkpoint import load_checkpoint, save_checkpoint
from esp_envs.errors import UserError

META = {"step": 500_000, "task": "navigation", "nested": {"list": [1, 2.5, None, True], "text": "é"}}


def tensors():
    whole = torch.arange(12, dtype=torch.float32)
    return {
        "weight": torch.tensor([[1.5, -2.0, float("nan")], [float("inf"), 0.0, -0.0]]),
        "double": torch.tensor([1 / 3], dtype=torch.float64),
        "half": torch.tensor([1.0, 2.0]).bfloat16(),
        "counter": torch.tensor(2**62, dtype=torch.int64),
        "generator": torch.Generator().manual_seed(7).get_state(),
        "mask": torch.tensor([True, False, True]),
        "empty": torch.zeros(0, 3),
        "left": whole[:6],
        "right": whole[6:],
        "transposed": whole.view(3, 4).t(),
        "expanded": torch.ones(1).expand(5),
    }


def small_tensors():
    return {"a": torch.tensor([1.0, 2.0]), "b": torch.tensor([3], dtype=torch.int64), "c": torch.tensor([True])}


def bits(tensor):
    return tensor.contiguous().reshape(-1).view(torch.uint8)


def assert_same(left, right):
    assert left.keys() == right.keys()
    for name in left:
        assert left[name].dtype == right[name].dtype
        assert left[name].shape == right[name].shape
        assert torch.equal(bits(left[name]), bits(right[name])), name


def test_round_trip_keeps_every_bit(tmp_path):
    path = tmp_path / "a.safetensors"
    save_checkpoint(path, tensors(), META)
    loaded, meta = load_checkpoint(path)
    assert_same(loaded, tensors())
    assert meta == META
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.safetensors"]


def test_loaded_tensors_are_writable_and_apart(tmp_path):
    save_checkpoint(tmp_path / "a", tensors(), META)
    loaded, _ = load_checkpoint(tmp_path / "a")
    loaded["left"].fill_(-1.0)
    assert loaded["right"].tolist() == [6.0, 7.0, 8.0, 9.0, 10.0, 11.0]


def test_loaded_tensors_are_aligned_as_those_of_torch(tmp_path):
    odd = {f"{index}": torch.arange(index, dtype=torch.uint8) for index in range(1, 30, 2)}
    save_checkpoint(tmp_path / "a", odd, {})
    assert all(tensor.data_ptr() % 64 == 0 for tensor in load_checkpoint(tmp_path / "a")[0].values())
    # negative control: the loader's own are not
    loader = safetensors.torch.load((tmp_path / "a").read_bytes())
    assert any(tensor.data_ptr() % 64 for tensor in loader.values())


def test_other_safetensors_readers_read_the_file(tmp_path):
    save_checkpoint(tmp_path / "a", tensors(), META)
    assert_same(safetensors.torch.load_file(tmp_path / "a"), tensors())


def test_policy_files_have_their_description_at_the_top_level(tmp_path):
    path = tmp_path / "policy.safetensors"
    meta = {"task": "navigation", "network": {"kind": "mlp"}, "activation": "tanh"}
    save_checkpoint(path, small_tensors(), meta, format_name="esp-policy")
    with safetensors.safe_open(path, framework="pt") as file:
        description = json.loads(file.metadata()["esp"])
    assert description.pop("sha256")
    assert description == {"format": "esp-policy", "version": 1, **meta}
    assert load_checkpoint(path, format_name="esp-policy")[1] == meta
    with pytest.raises(UserError, match="format 'esp-policy', where 'esp-checkpoint' is needed"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("content", "meta", "text"),
    [
        ({}, {"text": "x" * (5 * 2**20)}, "larger than a reader accepts"),
        ({"a": torch.zeros(2, dtype=torch.complex64)}, {}, "'a' is no dense tensor"),
        ({"a": torch.eye(2).to_sparse()}, {}, "'a' is no dense tensor"),
        ({"a": 3}, {}, r"'a' is no dense tensor .* \(int\)"),
        ({"a": torch.zeros([1] * 17)}, {}, "at most 16 dimensions"),
    ],
)
def test_what_cannot_be_stored_is_refused_and_nothing_is_written(tmp_path, content, meta, text):
    with pytest.raises(UserError, match=text):
        save_checkpoint(tmp_path / "a", content, meta)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder_is_one_sentence(tmp_path):
    with pytest.raises(UserError, match=r"cannot write .*no/a: No such file or directory"):
        save_checkpoint(tmp_path / "no" / "a", {}, {})


# Damaged, foreign and hostile files


def build(tensor_entries, data, description=None, metadata=None, header=None):
    """Return a file's bytes with a header typed by hand."""
    if header is None:
        metadata = metadata if metadata is not None else {"esp": json.dumps(description)}
        header = json.dumps({"__metadata__": metadata, **tensor_entries}).encode()
    return struct.pack("<Q", len(header)) + header + data


def described(**changes):
    return {"format": "esp-checkpoint", "version": 1, "sha256": "0" * 64, **changes}


def entry(dtype="F32", shape=(2,), offsets=(0, 8)):
    return {"dtype": dtype, "shape": list(shape), "data_offsets": list(offsets)}


EIGHT = b"\0" * 8
HOSTILE = {
    "empty": b"",
    "short": b"\x01\x02",
    "huge header": struct.pack("<Q", 2**63) + b"{}",
    "header past the end": struct.pack("<Q", 100) + b"{}",
    "header over the limit": struct.pack("<Q", 5 * 2**20) + b" " * (5 * 2**20),
    "no JSON": build({}, b"", header=b"{'a': 1}"),
    "not UTF-8": build({}, b"", header=b'{"\xff": 1}'),
    "a list": build({}, b"", header=b"[1, 2]"),
    "nested deeply": build({}, b"", header=b"[" * 100_000),
    "nested deeply inside": build({}, b"", metadata={"esp": '{"a":' * 100_000}),
    "long number": build({}, b"", header=b'{"a": ' + b"9" * 10_000 + b"}"),
    "key twice": build({}, b"", header=b'{"__metadata__": {"esp": "{}"}, "__metadata__": {"esp": "{}"}}'),
    "no metadata": build({}, b"", header=json.dumps({"a": entry()}).encode()) + EIGHT,
    "metadata a list": build({}, b"", metadata=["esp"]),
    "metadata not text": build({}, b"", metadata={"esp": {"format": "esp-checkpoint"}}),
    "foreign metadata": build({"a": entry()}, EIGHT, metadata={"format": "pt"}),
    "description a number": build({}, b"", description=3),
    "description NaN": build({}, b"", description=described(score=float("nan"))),
    "description infinite": build({}, b"", metadata={"esp": json.dumps(described())[:-1] + ', "score": 1e999}'}),
    "other format": build({}, b"", description=described(format="esp-policy")),
    "format a list": build({}, b"", description=described(format=["x"] * 1000)),
    "newer": build({}, b"", description=described(version=2)),
    "version true": build({}, b"", description=described(version=True)),
    "no checksum": build({}, b"", description=described(sha256=None)),
    "wrong checksum": build({"a": entry()}, EIGHT, description=described()),
    "entry a number": build({"a": 1}, EIGHT, description=described()),
    "wrong dtype": build({"a": entry("F8_E5M2")}, EIGHT, description=described()),
    "another dtype": build({"a": entry("F8_E5M2", (8,))}, EIGHT, description=described()),
    "twenty dimensions": build({"a": entry("F32", [1] * 20, (0, 4))}, EIGHT[:4], description=described()),
    "dtype does not fit": build({"a": entry("F64")}, EIGHT, description=described()),
    "gigantic": build({"a": entry("F32", (2**40,), (0, 2**42))}, EIGHT, description=described()),
    "gigantic and empty": build({"a": entry("F32", (0, 2**62, 2**62), (0, 0))}, b"", description=described()),
    "offsets turned": build({"a": entry("F32", (2,), (8, 0))}, EIGHT, description=described()),
    "overlap": build({"a": entry(), "b": entry()}, EIGHT, description=described()),
    "gap": build({"a": entry(offsets=(4, 12))}, EIGHT + EIGHT, description=described()),
    "tail": build({"a": entry()}, EIGHT + b"x", description=described()),
    "truncated": build({"a": entry()}, EIGHT[:5], description=described()),
    "half a surrogate": build({"\ud800": entry()}, EIGHT, description=described()),
    "pickle": b"\x80\x04\x95\x1f\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x94\x8c\x06system\x94\x93\x94.",
    "zip": b"PK\x03\x04" + b"\0" * 60,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_in_one_sentence(tmp_path, name):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(HOSTILE[name])
    with pytest.raises(UserError) as caught:
        load_checkpoint(path)
    text = str(caught.value)
    assert text.startswith(f"{path} ")
    assert "\n" not in text
    assert len(text) < len(str(path)) + 260


def test_truth_values_are_zero_or_one(tmp_path):
    description = {"format": "esp-checkpoint", "version": 1}
    digest = hashlib.sha256(json.dumps(description, sort_keys=True, separators=(",", ":")).encode())
    digest.update(b'["a","torch.bool",[1]]' + b"\x02")
    bad = build({"a": entry("BOOL", (1,), (0, 1))}, b"\x02", {**description, "sha256": digest.hexdigest()})
    (tmp_path / "a").write_bytes(bad)
    with pytest.raises(UserError, match="truth values other than 0 and 1"):
        load_checkpoint(tmp_path / "a")


@pytest.mark.parametrize("kind", ["missing", "folder", "pipe", "device"])
def test_what_is_no_plain_file_is_refused_without_waiting(tmp_path, kind):
    path = {"device": Path("/dev/zero"), "folder": tmp_path}.get(kind, tmp_path / "x")
    if kind == "pipe":
        os.mkfifo(path)
    with pytest.raises(UserError, match="is a folder" if kind == "folder" else "no plain file"):
        load_checkpoint(path)


def test_every_flipped_bit_and_every_cut_is_noticed(tmp_path):
    path = tmp_path / "a"
    save_checkpoint(path, {"a": torch.tensor([True]), "b": torch.tensor([1.5])}, {"n": 1})
    good = path.read_bytes()
    for position in range(len(good)):
        path.write_bytes(good[:position])
        with pytest.raises(UserError):
            load_checkpoint(path)
        for bit in range(8):
            flipped = bytearray(good)
            flipped[position] ^= 1 << bit
            path.write_bytes(flipped)
            with pytest.raises(UserError):
                load_checkpoint(path)


def test_a_file_larger_than_its_header_declares_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "a"
    save_checkpoint(path, small_tensors(), META)
    with path.open("rb+") as file:
        file.truncate(40 * 2**30)  # a hole, which takes no space
    with pytest.raises(UserError, match="its size, 42949672960 bytes, is not what its header declares"):
        load_checkpoint(path)
