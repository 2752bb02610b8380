"""How far a trained policy is from turning with its body, in states that are mirrored by the proven map."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch

from esp_cli.bodies.body import Body
from esp_cli.bodies.kinds import QUATERNION, QUATERNION_XYZW
from esp_cli.bodies.numbers import ACTION, Numbers, labels_of, map_of
from esp_cli.files.opening import read_regular
from esp_cli.symmetry.elements import Floats
from esp_envs.errors import UserError
from esp_envs.installed import import_function, install, last_line
from esp_envs.spec import Layout

_ROWS, _MOST_BYTES = 2048, 1 << 30
_OF_LENGTH_ONE = {QUATERNION, QUATERNION_XYZW}
Actor = Callable[[Floats], Any]


@dataclass(frozen=True)
class Turning:
    """How far a policy is from turning with one element.

    `distance` is between pi(L s) and K pi(s), as a share of that between actions of unrelated states: 0 where the
    policy turns with the body, about 1 where it knows nothing of the element.
    """

    element: str
    distance: float
    action: str  # the number of the action that is farthest off, as a share of its own distance
    worst: float  # that share


def turning(actor: Actor, body: Body, numbers: Numbers, rows: Floats | None = None) -> list[Turning]:
    """Compare what a policy does in states and in their images, by default normal ones with quaternions of length 1.

    The actor takes rows [M, D] of the first group of observations to actions [M, A].
    """
    seen = numbers[next((name for name in numbers if name != ACTION), ACTION)]
    rows = _drawn(seen) if rows is None else rows
    if rows.ndim != 2 or rows.shape[1] != seen.width or not np.isfinite(rows).all():
        raise UserError(f"the rows have shape {list(rows.shape)}; give finite numbers [M, {seen.width}] of states")
    if (rows == rows[:1]).all():
        raise UserError("the rows are all the same, so none is unrelated to another; give rows of several states")
    labels = labels_of(numbers[ACTION])
    here, found = _acted(actor, rows, len(labels)), []
    for element in body.elements:
        there = _acted(actor, rows @ map_of(seen, element).T, len(labels))
        image = here @ map_of(numbers[ACTION], element).T
        gap, unrelated = ((there - image) ** 2).mean(0), _between(there, image)
        shares = np.sqrt(gap / np.maximum(unrelated, 1e-30))
        worst = int(shares.argmax())
        distance = float(np.sqrt(gap.mean() / max(unrelated.mean(), 1e-30)))
        found.append(Turning(element.name, distance, labels[worst], float(shares[worst])))
    return found


def _between(here: Floats, there: Floats) -> Floats:
    """Return the mean square by which each number of a row is off that of any other row, of two arrays [M, A]."""
    count = len(here)
    every = here.var(0) + there.var(0) + (here.mean(0) - there.mean(0)) ** 2  # over all pairs, equal ones too
    return (count * every - ((here - there) ** 2).mean(0)) / (count - 1)


def policy_of(name: str) -> Actor:
    """Return the policy of an ONNX file, of TorchScript, or a function "module:function" of tensors [M, D]."""
    path = Path(name)
    if ":" in name and not path.exists():
        return _of_tensors(import_function(name))
    content = read_regular(path, _MOST_BYTES)
    if content is None:
        raise UserError(f"{path} has more than {_MOST_BYTES} bytes; give a policy")
    if path.suffix != ".onnx":
        try:
            return _of_tensors(torch.jit.load(BytesIO(content), map_location="cpu").eval())
        except RuntimeError as error:
            raise UserError(f"{path} is neither ONNX nor TorchScript: {last_line(error)}") from None
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        runtime = import_module("onnxruntime")
    except ImportError:
        raise UserError(f"an ONNX policy needs the package onnxruntime: {install('export')}") from None
    try:
        session = runtime.InferenceSession(content, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise UserError(f"{path} is no ONNX model: {last_line(error)}") from None
    inputs = session.get_inputs()
    if len(inputs) != 1:
        names = ", ".join(given.name for given in inputs)
        raise UserError(f"{path} takes {names}; give a policy of observations alone, without memory")
    alone = inputs[0].shape[:1] == [1]  # it was exported for one row

    def act(rows: Floats) -> Any:
        parts = np.split(rows.astype(np.float32), len(rows) if alone else 1)
        return np.concatenate([session.run(None, {inputs[0].name: part})[0] for part in parts])

    return act


def rows_of(path: Path) -> Floats:
    """Read observations [M, D] of a .npy file."""
    try:
        content = BytesIO(read_regular(path, _MOST_BYTES) or b"")
        rows = np.lib.format.read_array(content, allow_pickle=False)
        return rows.astype(np.float64, casting="same_kind")  # no text, date or complex number
    except (ValueError, TypeError, MemoryError) as error:
        raise UserError(f"{path} is no .npy file of numbers: {last_line(error)}") from None


def _of_tensors(module: Callable[..., Any]) -> Actor:
    weights = module.parameters() if isinstance(module, torch.nn.Module) else iter(())
    number = next((weight.dtype for weight in weights if weight.is_floating_point()), torch.float32)

    def act(rows: Floats) -> Any:
        with torch.no_grad():
            given = module(torch.from_numpy(rows).to(number))
        given = given[0] if isinstance(given, tuple | list) else given
        return given.detach().cpu().numpy() if isinstance(given, torch.Tensor) else given

    return act


def _acted(actor: Actor, rows: Floats, width: int) -> Floats:
    """Return the actions [M, A] of a policy."""
    try:
        actions = np.asarray(actor(rows), np.float64)
    except (Exception, SystemExit) as error:
        raise UserError(f"the policy raises {last_line(error)}; it was given rows {list(rows.shape)}") from error
    if actions.shape != (len(rows), width) or not np.isfinite(actions).all():
        raise UserError(f"the policy returns {list(actions.shape)}; give finite actions {[len(rows), width]}")
    return actions


def _drawn(seen: Layout) -> Floats:
    """Return normal rows, in which what has length 1 has it."""
    rows = np.random.default_rng(0).standard_normal((_ROWS, seen.width))
    for field, where in zip(seen.fields, seen.slices().values(), strict=True):
        if field.kind in _OF_LENGTH_ONE or field.name == "gravity":
            items = rows[:, where].reshape(_ROWS, field.count, -1)
            rows[:, where] = (items / np.linalg.norm(items, axis=-1, keepdims=True)).reshape(_ROWS, -1)
    return rows
