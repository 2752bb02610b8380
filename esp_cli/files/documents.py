"""JSON documents of a known format and version, and tables of settings: parsed within bounds, validated."""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from esp_cli.files.formatting import attempting, nearest, own_words, shortened
from esp_cli.files.opening import read_regular
from esp_cli.files.writing import replace_file
from esp_envs.errors import UserError

Model = TypeVar("Model", bound=BaseModel)

MAX_DOCUMENT_BYTES = 16 * 2**20  # parsed JSON takes some 20 times the space of its text
MAX_TABLE_BYTES = 2**20
MAX_NESTING = 64
_LARGEST = 1e30  # of the numbers that a setting takes; float32, in which most of them are used, ends at 3.4e38
_MAX_INTEGER = 2**63
_FORCES: dict[str, object] = {"gust_mean": 0.0, "gust_std": 0.0, "weak_agent": 0.0}
_GONE: dict[str, dict[str, object]] = {
    "navigation": _FORCES,
    "predator-prey": {"prey_policy": None, "prey_policy_seed": 0, "learned_prey": 0.0, **_FORCES},
    "formation": {"penalty_counts": "any", "lame_wheel": 0.0, "heading_offset_rad": 0.0, "blind_sector_rad": 0.0},
    "prior": {"stop_gradient": "none", "terms": "both"},
}
"""Settings that earlier versions wrote into files, with their defaults: of a task, or the prior."""
_TOO_DEEP = f"it is nested more than {MAX_NESTING} deep"
# Parts of a key, bare or quoted, with dots between them. Before the first stands nothing that could belong to it, so
# that each text is tried a bounded number of times.
_PART = r"""(?:[\w-]++|"(?:\\.|[^"\\\n])*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![\w\\-])(?:{_PART}[ \t]*+\.[ \t]*+){{{MAX_NESTING}}}")


class Strict(BaseModel):
    """A model whose fields cannot change, and that refuses a field which it does not have."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True)
class DocumentFormat:
    """A kind of JSON document: an object with the keys ``format`` and ``version`` beside its content."""

    name: str  # value of ``format``
    version: int  # newest value of ``version`` that this program reads
    noun: str  # what it is for people, such as "the configuration of a run"

    def read(self, path: str | os.PathLike[str]) -> dict[str, Any]:
        """Return the content without ``format`` and ``version``; a document that is wrong is a UserError."""
        with attempting("read", path):
            text = read_regular(path, MAX_DOCUMENT_BYTES)
        if text is None:
            raise UserError(f"{path} is foreign: it is larger than {self.noun} can be")
        try:
            document = parse_object(text, "text")
        except UserError as error:
            raise UserError(f"{path} {error}") from None
        version = document.pop("version", None)
        if document.pop("format", None) != self.name or type(version) is not int:
            raise UserError(f"{path} is foreign: it is not {self.noun} of esp")
        if version > self.version:
            raise UserError(f"{path} was written by a newer esp; update esp to use it")
        return document

    def is_one(self, path: Path) -> bool:
        """Return whether a file is such a document, which begins with its format."""
        return begins_with(path, f'"format": "{self.name}"')

    def parse(self, path: str | os.PathLike[str], model: type[Model]) -> Model:
        """Read a document and validate its content; errors as of `read`."""
        content = self.read(path)
        try:
            return validate(model, content)
        except UserError as error:
            raise UserError(f"{path} is damaged: {error}") from None

    def write(self, path: str | os.PathLike[str], content: Mapping[str, Any]) -> None:
        """Write a document as a whole or not at all; a UserError says that content is no JSON (NaN) or a key taken."""
        if "format" in content or "version" in content:
            raise UserError(f"cannot write {path}: its content may not use the keys 'format' and 'version'")
        replace_file(path, encode(self.document(content), path))

    def document(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """Return content with the keys that say what it is."""
        return {"format": self.name, "version": self.version, **content}


def begins_with(path: Path, text: str) -> bool:
    """Return whether the first lines of a file hold a text, such as the format of a document."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return text.encode() in file.read(100)


def validate(model: type[Model], content: object, section: str = "") -> Model:
    """Return the validated content of a document; a value of another type is refused, not converted (true is not 1)."""
    try:
        return model.model_validate_json(json.dumps(content), strict=True)
    except ValidationError as error:
        raise UserError(_one_sentence(error, model, section)) from None


def validated(model: type[BaseModel], values: Mapping[str, object], section: str, owner: str = "") -> Any:
    """Build a model from settings that a user chose; what is unknown, of another kind or not finite is a UserError."""
    try:
        built = model(**values)
    except ValidationError as error:
        raise UserError(_one_sentence(error, model, section, owner)) from None
    for name, value in values.items():
        given, taken = _numbers(value), _numbers(getattr(built, name))
        problem = ""
        if any(type(number) is int and abs(number) >= _MAX_INTEGER for number in taken):
            problem = "it has more than 64 bits"
        elif not all(abs(number) <= _LARGEST for number in taken):  # false for NaN
            problem = f"it has to be a finite number of at most {_LARGEST:g}"
        elif sum(isinstance(x, bool) for x in given) > sum(isinstance(x, bool) for x in taken):
            problem = "it has to be a number"  # pydantic takes true for 1
        if problem:
            raise UserError(f"bad value {shortened(str(value).lower())} for '{section}.{name}': {problem}")
    return built


def _numbers(value: object) -> list[bool | int | float]:
    items = value if isinstance(value, list | tuple) else [value]
    return [item for item in items if isinstance(item, bool | int | float)]


def without_gone(owner: str, stored: object) -> object:
    """Return stored settings without those that went; one that is not at its old default is a UserError."""
    gone = _GONE.get(owner, {})
    if not isinstance(stored, Mapping) or not gone.keys() & stored.keys():
        return stored
    if away := [name for name in gone if stored.get(name, gone[name]) != gone[name]]:
        raise UserError(f"this esp has no '{away[0]}' any more; use the esp that wrote it, or train without it")
    return {name: value for name, value in stored.items() if name not in gone}


def encode(value: object, path: str | os.PathLike[str]) -> bytes:
    """Return a value as indented JSON; what is not JSON, as NaN and infinity, is a UserError."""
    try:
        return (json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n").encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise UserError(f"cannot write {path}: its content is not JSON ({error})") from None


def parse_object(text: bytes | str, noun: str) -> dict[str, Any]:
    """Parse strict JSON that is an object; the caller bounds it, and puts the name of a file before the error."""
    try:
        value = parse_value(text.decode("utf-8") if isinstance(text, bytes) else text)
    except ValueError as error:
        raise UserError(f"is damaged or foreign: its {noun} is not valid JSON ({shortened(str(error))})") from None
    if not isinstance(value, dict):
        raise UserError(f"is damaged or foreign: its {noun} is no JSON object")
    return value


def parse_value(text: str) -> Any:
    """Parse strict JSON: no NaN, infinity, key twice, integer above 64 bits or nesting above `MAX_NESTING`."""
    try:
        value = json.loads(
            text, object_pairs_hook=_unique, parse_constant=_finite, parse_float=_finite, parse_int=_bounded
        )
    except RecursionError:
        raise UserError(_TOO_DEEP) from None
    _refuse_nesting(value)
    return value


def _refuse_nesting(value: object) -> None:
    level: list[Any] = [[value]]
    for _ in range(1 + MAX_NESTING):
        inside = (outer.values() if isinstance(outer, dict) else outer for outer in level)
        level = [item for items in inside for item in items if isinstance(item, dict | list)]
        if not level:
            return
    raise UserError(_TOO_DEEP)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        raise UserError("a key stands twice")
    return result


def _finite(number: str) -> float:
    # also called for NaN and Infinity, which are no JSON; 1e999 is, and would be read as infinity
    value = float(number)
    if not math.isfinite(value):
        raise UserError(f"{shortened(number)} is no finite number")
    return value


def _bounded(number: str) -> int:
    value = int(number) if len(number) <= 20 else _MAX_INTEGER
    if abs(value) >= _MAX_INTEGER:
        raise UserError("an integer has more than 64 bits")
    return value


def _one_sentence(error: ValidationError, model: type[BaseModel], section: str, owner: str = "") -> str:
    """Say what is wrong with the first bad setting of a model, and what could stand there."""
    first = error.errors(include_url=False)[0]
    name = shortened(".".join([*([section] if section else []), *(str(part) for part in first["loc"])]))
    if first["type"] == "extra_forbidden":
        near = nearest(str(first["loc"][-1]), model.model_fields) if len(first["loc"]) == 1 else None
        if near is not None:
            return f"unknown setting '{name}'; did you mean '{f'{section}.{near}' if section else near}'?"
        return f"unknown setting '{name}'; {owner or section or 'it'} has {', '.join(model.model_fields)}"
    if first["type"] == "missing":
        return f"the setting '{name}' is missing"
    if not first["loc"] and isinstance(first["input"], Mapping):  # settings that do not go together
        return f"bad settings{f' for {section}' if section else ''}: {own_words(first['msg'])}"
    message = "it has to be a list, as [64,64]" if first["type"] == "tuple_type" else own_words(first["msg"])
    given = "" if isinstance(first["input"], Mapping) else f" {shortened(repr(first['input']))}"
    return f"bad value{given} for '{name}': {message[0].lower()}{message[1:]}"


def read_table(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file that a person wrote: one JSON object, or TOML where its name ends in .toml; else a UserError."""
    with attempting("read", path):
        text = read_regular(path, MAX_TABLE_BYTES)
    if text is None:
        raise UserError(f"{path} is larger than a file of settings can be")
    if Path(path).suffix.lower() != ".toml":
        try:
            return parse_object(text, "text")
        except UserError as error:
            raise UserError(f"{path} {error}; write TOML into a file whose name ends in .toml") from None
    try:
        content = text.decode("utf-8")
        if _DEEP_KEY.search(content):  # tomllib takes time and memory with the square of the parts
            raise UserError(_TOO_DEEP)
        table = tomllib.loads(content)
        _refuse_nesting(table)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid TOML: {shortened(str(error))}") from None
    for name, value in flat(table):
        if isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"{path} sets '{name}' to {value}; write a finite number")
        if not isinstance(value, bool | int | float | str | list):
            raise UserError(f"{path} sets '{name}' to a date or time; write a number, a text or a list")
    return table


def flat(table: Mapping[str, Any], dots: int | None = None, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted name and value of all in nested tables, {"a": {"b": 1}} -> ("a.b", 1).

    A table whose name has as many `dots` is yielded whole.
    """
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and (dots is None or name.count(".") < dots):
            yield from flat(value, dots, f"{name}.")
        else:
            yield name, value
