"""Spoilt content: by bytes, and by the structure of JSON and of safetensors."""

import copy
import json
import random
import struct
from typing import Any

JUNK: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2, 7, 10**9, 2**53, 2**63, 10**30, -(10**30), 0.5, -0.0, 1e308, -1e308, 1e-320,
    "", " ", "x", "x" * 5000, "../../x", "/etc/passwd", "a\nb", "\u0000", "\ud800", "é", "NaN", "1", "true", "[]",
    "|`$(x)", "c0", "d99999*agents", "rot1e9", "agents-1-0-2", "agents-0-0", "landmarks-2-0-1", "*", "discovered:x",
    [], {}, [[]], [None], [1, 2], [1.5] * 50, {"a": 1}, {"format": "x"}, [[[[[[[[[[]]]]]]]]]],
)  # fmt: skip
TEXTS = (b"NaN", b"Infinity", b"-Infinity", b"1e999", b"null", b"true", b"[" * 200_000, b'{"a":' * 5000, b"\xff\xfe")


def spoil_bytes(content: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        size = len(content)
        a, b = sorted((rng.randint(0, size), rng.randint(0, size)))
        b = min(b, a + rng.choice((1, 4, 64, size)))
        kind = rng.randrange(8)
        if kind == 0 and size:
            place = rng.randrange(size)
            content = content[:place] + bytes([content[place] ^ 1 << rng.randrange(8)]) + content[place + 1 :]
        elif kind == 1:
            content = content[:a]
        elif kind == 2:
            content = content[:a] + content[b:]
        elif kind == 3:
            content = content[:b] + content[a:b] + content[b:]
        elif kind == 4:
            content = content[:a] + rng.randbytes(min(b - a, 4096)) + content[b:]
        elif kind == 5:
            content = content[:a] + bytes(b - a) + content[b:]
        elif kind == 6:
            content = content[:a] + rng.choice(TEXTS) + content[b:]
        else:
            content = (
                content[:a] + rng.choice((b'"', b"{", b"}", b"[", b"]", b",", b":", b"\n", b"-", b"9")) + content[a:]
            )
    return content


def spoil_value(value: Any, rng: random.Random) -> Any:
    """Return a JSON value with one to three places changed; it may be changed itself."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        inner, key = _place(value, rng)
        if inner is None:
            value = _junk(rng)
        elif rng.random() < 0.2:
            del inner[key]
        elif isinstance(inner, dict) and rng.random() < 0.1:
            inner[rng.choice(("x", "", "format", "name", "../x", "é"))] = inner.pop(key)
        elif rng.random() < 0.1:
            inner[key] = [inner[key]] * rng.choice((1, 2, 100))
        else:
            inner[key] = _junk(rng)
    return value


def spoil_json(content: bytes, rng: random.Random) -> bytes:
    """Return the text of a JSON document, or of lines of JSON, with some places changed."""
    lines = content.split(b"\n")
    many = len(lines) > 2 and all(line.startswith(b"{") for line in lines if line)
    if not many:
        return _dump(spoil_value(json.loads(content), rng))
    place = rng.choice([k for k, line in enumerate(lines) if line])
    lines[place] = _dump(spoil_value(json.loads(lines[place]), rng))
    return b"\n".join(lines)


def spoil_header(content: bytes, rng: random.Random) -> bytes:
    (length,) = struct.unpack_from("<Q", content)
    header = json.loads(content[8 : 8 + length])
    if rng.random() < 0.5:
        described = json.loads(header["__metadata__"]["esp"])
        header["__metadata__"]["esp"] = _dump(spoil_value(described, rng)).decode("utf-8", "replace")
    else:
        header = spoil_value(header, rng)
    text = _dump(header)
    return struct.pack("<Q", len(text)) + text + content[8 + length :]


def _junk(rng: random.Random) -> Any:
    value = rng.choice(JUNK)
    return copy.deepcopy(value) if isinstance(value, dict | list) else value


def _dump(value: Any) -> bytes:
    return json.dumps(value).encode()


def _place(value: Any, rng: random.Random) -> tuple[Any, Any]:
    """Return a list or an object inside a value, and a key of it; (None, None) for the value itself."""
    inner, key = None, None
    while isinstance(value, dict | list) and value and (inner is None or rng.random() < 0.8):
        inner, key = value, rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
        value = inner[key]
    return inner, key
