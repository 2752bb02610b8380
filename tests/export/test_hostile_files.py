"""Whatever is in a file, loading it gives the policy or one sentence: no traceback, no hang, no heap of memory.

Two floods: files whose bytes were spoilt at random (the checksum or the structure gives them away), and files that
somebody wrote on purpose, with right checksums around a hostile description or hostile tensors.
"""

import copy
import json
import pickle
import random
import resource
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from esp_cli.policies.bundled import MANIFEST, bundled_folder, read_bundled
from esp_cli.policies.loaded import load_policy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training import checkpoint
from esp_cli.training.checkpoint import POLICY_FORMAT, load_checkpoint, save_checkpoint
from tests.export.policies import drawn_policy, write_policy

T = TypeVar("T")

SPOILT, WRITTEN, MANIFESTS = 9_000, 1_500, 500
"""Cases of each flood: eleven thousand in all."""
MOST_MEMORY_KB = 300 * 1024
"""By which the process may grow over a flood."""

HOSTILE: list[Any] = [
    *(None, True, False, 0, -1, 1, 2, 7, 2**31, 2**63, 2**64, -(2**70), 10**30, 1e308, -1e308, 0.5),
    *("", "x", "0", "../../etc/passwd", "/dev/zero", "\x00", "\ud7ff" * 3, "9" * 5000, "e" * 100_000),
    *([], [[]], [0] * 1001, [1e9], [4096] * 16, [2**40], ["x"], [[[[[[[[0]]]]]]]], list(range(1000))),
    *({}, {"x": 1}, {"hidden": [4096] * 16}),
    *("mappo", "maddpg", "qmix", "formation", "predator-prey", "gru", "continuous", "discrete", "mujoco-3d"),
    *("cuda", "policy", "prey", "tanh", "bfloat16"),
]


def attempt(load: Callable[[], T]) -> T | None:
    """Return what loads, or None where one sentence came instead. Everything else is a failure."""
    try:
        return load()
    except ValueError as error:
        sentence = str(error)
    assert sentence
    assert "\n" not in sentence
    assert len(sentence) < 1000, sentence[:300]
    return None


def same(loaded: TrainedPolicy, original: TrainedPolicy) -> bool:
    """Return whether two policies are alike to the last bit."""
    mine, other = loaded.policy.state_dict(), original.policy.state_dict()
    return loaded.config == original.config and all(torch.equal(mine[name], other[name]) for name in other)


def peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def flip(content: bytearray, draw: random.Random) -> bytearray:
    for _ in range(draw.choice((1, 1, 1, 2, 8))):
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    return content


def resize(content: bytearray, draw: random.Random) -> bytearray:
    longer = content + draw.randbytes(draw.choice((1, 8, 4096)))
    return draw.choice((longer, content[: draw.randrange(len(content))]))


def overwrite(content: bytearray, draw: random.Random) -> bytearray:
    begin = draw.randrange(len(content))
    stop = min(len(content), begin + draw.choice((1, 4, 32, 512)))
    content[begin:stop] = draw.randbytes(stop - begin)
    return content


def move(content: bytearray, draw: random.Random) -> bytearray:
    """Cut a piece out and put it in elsewhere."""
    begin, place = draw.randrange(len(content)), draw.randrange(len(content))
    piece = content[begin : begin + draw.choice((1, 4, 64))]
    del content[begin : begin + len(piece)]
    content[place:place] = piece
    return content


def length(content: bytearray, draw: random.Random) -> bytearray:
    """Declare another header length: huge, negative if it were signed, or a little off."""
    (true,) = struct.unpack_from("<Q", content)
    declared = draw.choice((2**64 - 1, 2**63, 2**40, 2**32, len(content), true - 1, true + 1, 0, draw.getrandbits(64)))
    content[:8] = struct.pack("<Q", declared)
    return content


def digits(content: bytearray, draw: random.Random) -> bytearray:
    """Change numbers in the header: shapes, offsets, settings."""
    (size,) = struct.unpack_from("<Q", content)
    places = [k for k in range(8, 8 + size) if chr(content[k]).isdigit()]
    for _ in range(draw.choice((1, 2, 6))):
        content[draw.choice(places)] = ord(draw.choice("0123456789"))
    return content


SPOILERS = (flip, resize, overwrite, move, length, digits)


@pytest.fixture(scope="module")
def original() -> TrainedPolicy:
    return drawn_policy("choice", seeds=(3, 7), hidden=(4,))


@pytest.mark.parametrize("spoiler", SPOILERS, ids=lambda spoiler: spoiler.__name__)
def test_spoilt_bytes_give_a_sentence_or_the_very_same_policy(original, tmp_path, spoiler):
    path = write_policy(original, tmp_path / "policy.safetensors")
    content, draw = path.read_bytes(), random.Random(spoiler.__name__)
    before, refused, count = peak_kb(), 0, -(-SPOILT // len(SPOILERS))
    for _ in range(count):
        path.write_bytes(spoiler(bytearray(content), draw))
        loaded = attempt(lambda: TrainedPolicy.read(path))
        refused += loaded is None
        # what is not meant (a space in the JSON) may change; whoever gets a policy gets the right one
        assert loaded is None or same(loaded, original)
    assert refused > 0.9 * count
    assert peak_kb() - before < MOST_MEMORY_KB


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths to everything within a JSON value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path, *(deeper for key, item in items for deeper in places(item, (*path, key)))]


def with_hostile_value(meta: dict[str, Any], draw: random.Random) -> dict[str, Any]:
    """Put something hostile somewhere into a description, or take something away."""
    changed = copy.deepcopy(meta)
    *way, last = draw.choice(places(changed)[1:])
    inner: Any = changed
    for key in way:
        inner = inner[key]
    if draw.random() < 0.1 and isinstance(inner, dict):
        del inner[last]
    else:
        inner[last] = draw.choice(HOSTILE)
    if draw.random() < 0.1 and isinstance(changed.get("config"), dict):
        changed["config"][draw.choice(("__class__", "seeds", "x" * 100))] = draw.choice(HOSTILE)
    return changed


SHAPES = [(0,), (), (2, 0, 5), (1000, 1, 1), (2, 4096, 8), (2,)]
TYPES = [torch.float64, torch.float16, torch.int64, torch.uint8, torch.bool]
HOSTILE_TENSORS: list[Callable[[Tensor, random.Random], Tensor]] = [
    lambda tensor, _: tensor.reshape(-1),
    lambda _, draw: torch.zeros(draw.choice(SHAPES)),
    lambda tensor, draw: tensor.to(draw.choice(TYPES)),
    lambda tensor, draw: tensor.clone().fill_(draw.choice([float("nan"), float("inf"), float("-inf")])),
    lambda tensor, _: tensor.transpose(0, -1).contiguous(),
    lambda tensor, _: torch.cat([tensor, tensor]),
]
HOSTILE_NAMES = ["actor", "head.epsilon", "x" * 500, "../x", "actor.layers.9.weight"]


def with_hostile_tensor(tensors: dict[str, Tensor], draw: random.Random) -> dict[str, Tensor]:
    """Spoil one tensor: its shape, its dtype, its numbers, its name, or its being there."""
    changed, name, kind = dict(tensors), draw.choice(sorted(tensors)), draw.randrange(8)
    tensor = changed.pop(name)
    if kind < len(HOSTILE_TENSORS):
        changed[name] = HOSTILE_TENSORS[kind](tensor, draw)
    elif kind == len(HOSTILE_TENSORS):
        changed[draw.choice(HOSTILE_NAMES)] = tensor
    return changed


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["choice", "wheels", "values, recurrent"])
def test_files_written_on_purpose_give_a_sentence_or_a_policy(kind: str, tmp_path: Path) -> None:
    original = drawn_policy(kind, seeds=(3, 7), hidden=(4,))
    path, draw = write_policy(original, tmp_path / "policy.safetensors"), random.Random(kind)
    tensors, meta = load_checkpoint(path, format_name=POLICY_FORMAT)
    before, refused, count = peak_kb(), 0, WRITTEN // 3
    for _ in range(count):
        spoil_tensors = draw.random() < 0.3
        description = meta if spoil_tensors else with_hostile_value(meta, draw)
        stored = with_hostile_tensor(tensors, draw) if spoil_tensors else tensors
        save_checkpoint(path, stored, description, POLICY_FORMAT)
        loaded = attempt(lambda: TrainedPolicy.read(path))
        refused += loaded is None
        assert loaded is None or all(bool(t.isfinite().all()) for t in loaded.policy.state_dict().values())
    # the rest changed what a policy does not depend on, as the steps of its run
    assert refused > 0.5 * count
    assert peak_kb() - before < MOST_MEMORY_KB


def test_spoilt_manifests_give_a_sentence_or_entries(tmp_path: Path) -> None:
    file, draw = tmp_path / MANIFEST, random.Random("manifest")
    whole = json.loads((bundled_folder() / MANIFEST).read_bytes())
    content = json.dumps(whole | {"policies": whole["policies"][:1]}, indent=2).encode()
    for k in range(MANIFESTS):
        file.write_bytes(SPOILERS[k % 4](bytearray(content), draw))
        found = attempt(lambda: read_bundled(tmp_path))
        assert found is None or all(len(e.sha256) == 64 and "/" not in e.file for e in found)
    file.write_bytes(content)
    assert [entry.name for entry in read_bundled(tmp_path)] == [whole["policies"][0]["name"]]


def container(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<Q", len(header)) + header + data


def nested(depth: int) -> bytes:
    return b'{"__metadata__":' + b'{"a":' * depth + b"0" + b"}" * depth + b"}"


class _Bomb:
    """Leaves a trace when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("exploded"),)


CRAFTED: dict[str, Callable[[], bytes]] = {
    "nothing": lambda: b"",
    "zeros": lambda: bytes(1 << 20),
    "a pickle": lambda: pickle.dumps(_Bomb()),
    "a pickle behind a header": lambda: container(b"{}", pickle.dumps(_Bomb())),
    "a zip file": lambda: b"PK\x03\x04" + bytes(100),
    "a header of petabytes": lambda: struct.pack("<Q", 2**50) + b"{}",
    "a header of 5 MB": lambda: container(b" " * (5 << 20)),
    "a header of blanks": lambda: container(b" " * (3 << 20)),
    "a deep header": lambda: container(nested(100_000)),
    "a million keys": lambda: container(b"{" + b",".join(b'"%d":0' % k for k in range(300_000)) + b"}"),
    "a long number": lambda: container(b'{"a":' + b"9" * 1_000_000 + b"}"),
    "no metadata": lambda: container(b"{}"),
    "a tensor of exabytes": lambda: container(
        json.dumps({
            "__metadata__": {"esp": json.dumps({"format": POLICY_FORMAT, "version": 1, "sha256": "0" * 64})},
            "a": {"dtype": "F32", "shape": [2**20, 2**20, 2**20], "data_offsets": [0, 2**62]},
        }).encode()
    ),
    "a deep description": lambda: container(
        json.dumps({"__metadata__": {"esp": '{"a":' * 100_000 + "0" + "}" * 100_000}}).encode()
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", CRAFTED)
def test_a_crafted_file_gives_a_sentence(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file, before = tmp_path / "policy.safetensors", peak_kb()
    file.write_bytes(CRAFTED[kind]())
    with pytest.raises(ValueError, match=r"policy\.safetensors") as caught:
        load_policy(file)
    assert "\n" not in str(caught.value)
    assert not Path("exploded").exists(), "loading ran code"
    assert peak_kb() - before < MOST_MEMORY_KB


def test_a_newer_format_and_another_task_version_are_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = drawn_policy("choice")
    path = write_policy(trained, tmp_path / "policy.safetensors")
    tensors, meta = load_checkpoint(path, format_name=POLICY_FORMAT)
    for changed, version, sentence in (
        (meta, 2, "has version 2 of 'esp-policy', newer than 1; update esp"),
        (
            meta | {"task_version": 9},
            1,
            "was trained on navigation version 9, but this is version 1, in which observations",
        ),
        (
            meta | {"esp_version": "7.0", "config": meta["config"] | {"mood": 1}},
            1,
            r"unknown setting 'config\.mood'.*written by esp 7\.0, this is 0\.1\.0",
        ),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "_VERSION", version)
            save_checkpoint(path, tensors, changed, POLICY_FORMAT)
        with pytest.raises(ValueError, match=sentence):
            load_policy(path)
