"""Runs an exported policy with numpy alone."""

from __future__ import annotations

from typing import Any

import numpy as np


class NumpyPolicy:
    """One greedy policy; every row of observations is an agent of its own, or those of a team stand side by side.

    Args:
        program: layers and head.
        weights: of the layers, as little-endian float32.
    """

    def __init__(self, program: dict[str, Any], weights: bytes) -> None:
        self.program = program
        self.hidden, self.previous = program["hidden"], program["previous"]
        numbers = np.frombuffer(weights, "<f4").astype(np.float32)
        self.layers: list[tuple[dict[str, Any], list[Any]]] = []
        for layer in program["layers"]:
            arrays = []
            for shape in layer["shapes"]:
                count = int(np.prod(shape))
                arrays.append(numbers[:count].reshape(shape))
                numbers = numbers[count:]
            self.layers.append((layer, arrays))
        if numbers.size:
            raise ValueError("the weights do not fit the layers; export the policy again")

    def act(self, obs: Any, action_mask: Any = None, sets: Any = None) -> Any:
        """Return the actions [...] or [..., width] of agents that see obs [..., D], a team's [..., N, D].

        A policy with masks needs the allowed actions [..., A], too; one over sets tables of their things [..., K, W] by
        name.
        """
        if self.hidden:
            raise ValueError("this policy remembers: begin with initial_memory(), and call step(obs, memory)")
        return self.step(obs, self.initial_memory(*np.shape(obs)[:-1]), action_mask, sets)[0]

    def initial_memory(self, *lead: int) -> Any:
        """Return the memory with which an episode begins: zeros [*lead, H]."""
        return np.zeros((*lead, self.hidden + self.previous), np.float32)

    def step(self, obs: Any, memory: Any, action_mask: Any = None, sets: Any = None) -> tuple[Any, Any]:
        """Return actions, and the memory [..., H] after them.

        Raises:
            ValueError: other shapes, or numbers that are not finite.
        """
        outputs, hidden = self.outputs(obs, memory, sets)
        for what, rows in {"the observation": obs, "the memory": memory, **(sets or {})}.items():
            if not np.isfinite(np.asarray(rows, np.float32)).all():
                raise ValueError(f"{what} holds a number that is not finite; check what the sensors gave")
        if self.program["head"] == "choose":
            action = self._allowed(outputs, action_mask).argmax(-1)
            encoded = np.eye(outputs.shape[-1], dtype=np.float32)[action]
        else:
            action = encoded = self._squash(outputs)
        return action, np.concatenate([hidden, encoded], -1) if self.previous else hidden

    def outputs(self, obs: Any, memory: Any, sets: Any = None) -> tuple[Any, Any]:
        """Return the last layer's outputs (logits, values or unbounded actions), and the hidden state after it."""
        x, memory = np.asarray(obs, np.float32), np.asarray(memory, np.float32)
        if x.shape[-1:] != (self.program["num_inputs"],):
            raise ValueError(f"the observation has shape {x.shape}, but (..., {self.program['num_inputs']}) is needed")
        if (team := self.program["team"]) > 1 and x.shape[-2:-1] != (team,):
            raise ValueError(f"the observation has shape {x.shape}, but (..., {team}, D) is needed")
        if memory.shape != (*x.shape[:-1], self.hidden + self.previous):
            raise ValueError(f"the memory has shape {memory.shape}, but initial_memory{x.shape[:-1]} is needed")
        sets = self._tables(sets or {}, x.shape[:-1])
        hidden = memory[..., : self.hidden]
        obs, x = x, np.concatenate([x, memory[..., self.hidden :]], -1)
        for layer, arrays in self.layers:
            x = LAYERS[layer["kind"]](x, layer, arrays, {"gru": hidden, "sets": sets}.get(layer["kind"], obs))
            hidden = x if layer["kind"] == "gru" else hidden
        return x, hidden

    def _tables(self, sets: Any, lead: tuple[int, ...]) -> Any:
        """Return the tables of sets as float32; there is at least one thing in each."""
        widths = {name: len(columns[0]) for name, columns in self.program["sets"]}
        if {*sets} != {*widths}:
            raise ValueError(f"the sets are {sorted(sets)}, but {sorted(widths)} are needed")
        tables = {name: np.asarray(table, np.float32) for name, table in sets.items()}
        for name, table in tables.items():
            if table.ndim < 2 or table.shape != (*lead, max(1, table.shape[-2]), widths[name]):
                raise ValueError(f"{name} has shape {table.shape}, but {(*lead, 'K', widths[name])} is needed, K > 0")
        return tables

    def _allowed(self, outputs: Any, action_mask: Any) -> Any:
        """Put those of forbidden actions out of reach; where none is allowed, all are."""
        if not self.program["masked"]:
            if action_mask is not None:
                raise ValueError("this policy has no action masks; leave action_mask out")
            return outputs
        if np.shape(action_mask) != outputs.shape:
            raise ValueError(f"the action mask has shape {np.shape(action_mask)}, but {outputs.shape} is needed")
        mask = np.asarray(action_mask, bool)
        return np.where(mask | ~mask.any(-1, keepdims=True), outputs, -np.inf)

    def _squash(self, outputs: Any) -> Any:
        """Bring each group of numbers into its bounds: u tanh|u| / |u|."""
        parts = np.split(outputs, np.cumsum(self.program["groups"])[:-1], -1)
        lengths = [np.sqrt((part * part).sum(-1, keepdims=True) + np.float32(1e-18)) for part in parts]
        return np.concatenate(
            [part * (np.tanh(length) / length) for part, length in zip(parts, lengths, strict=True)], -1
        )


def _recur(x: Any, _: dict[str, Any], arrays: list[Any], hidden: Any) -> Any:
    """Advance the gated recurrent unit by one step."""
    p, q = x @ arrays[0] + arrays[1], hidden @ arrays[2] + arrays[3]
    (pr, pz, pn), (qr, qz, qn) = np.split(p, 3, -1), np.split(q, 3, -1)
    half = np.float32(0.5)  # s(x) = (1 + tanh(x / 2)) / 2 overflows nowhere
    reset, update = half + half * np.tanh(half * (pr + qr)), half + half * np.tanh(half * (pz + qz))
    candidate = np.tanh(pn + reset * qn)
    return candidate + update * (hidden - candidate)


def _normalise(x: Any, _: dict[str, Any], arrays: list[Any], __: Any) -> Any:
    """Normalise each row to mean 0 and variance 1, then scale and shift it."""
    centred = x - x.mean(-1, keepdims=True)
    x = centred / np.sqrt((centred * centred).mean(-1, keepdims=True) + np.float32(1e-5))
    return x * arrays[0] + arrays[1]


def _convolve(x: Any, layer: dict[str, Any], arrays: list[Any], _: Any) -> Any:
    """Apply filters to rows that hold pictures, channels first."""
    side, stride = layer["side"], layer["stride"]
    shape = [layer["channels"], layer["rows"], layer["columns"]]
    pictures = x[..., layer["begin"] : layer["begin"] + int(np.prod(shape))].reshape(*x.shape[:-1], *shape)
    windows = np.lib.stride_tricks.sliding_window_view(pictures, (side, side), (-2, -1))[..., ::stride, ::stride, :, :]
    places = windows.shape[-4] * windows.shape[-3]
    patches = np.moveaxis(windows, -5, -3).reshape(*x.shape[:-1], places, len(arrays[0]))
    return np.swapaxes(patches @ arrays[0] + arrays[1], -1, -2).reshape(*x.shape[:-1], places * len(arrays[1]))


def _aggregate(x: Any, layer: dict[str, Any], _: list[Any], obs: Any) -> Any:
    """Concatenate own features with the neighbours' mean relative position and mean message."""
    team, reach_squared = layer["team"], np.float32(layer["reach_squared"])
    ways = obs[..., layer["begin"] : layer["begin"] + 2 * (team - 1)].reshape(*obs.shape[:-1], team - 1, 2)
    near = ((ways * ways).sum(-1, keepdims=True) < reach_squared).astype(np.float32)
    share = near / (1 + near.sum(-2, keepdims=True))  # [..., N, N - 1, 1]
    others = [[j for j in range(team) if j != i] for i in range(team)]
    heard = x.reshape(-1, team, x.shape[-1])[:, others].reshape(*ways.shape[:-1], x.shape[-1])
    return np.concatenate([x, (share * (ways / np.sqrt(reach_squared))).sum(-2), (share * heard).sum(-2)], -1)


def _pool_sets(x: Any, layer: dict[str, Any], arrays: list[Any], tables: Any) -> Any:
    """Concatenate own numbers with mean and maximum over the embedded things of each set."""
    act = np.tanh if layer["activation"] == "tanh" else lambda x: np.maximum(x, 0)
    own, weights = x[..., layer["kept"]], arrays
    if layer["embeds_own"]:
        own, weights = act(own @ arrays[0] + arrays[1]), arrays[2:]
    things, places = [], {}
    for name, at, reader in layer["sets"]:
        table = tables[name]
        if at is not None and 0 < layer["near"] < table.shape[-2]:
            here = 0 if reader is None else x[..., None, reader : reader + 2]
            order = np.square(table[..., at : at + 2] - here).sum(-1).argsort(-1, kind="stable")
            order = order[..., : layer["near"], None]
            table = np.take_along_axis(table, order, -2)
        things.append(table)
        if at is not None:
            places[name] = table[..., at : at + 2]
    parts, squares = [own], [np.square(place).sum(-1) for place in places.values()]
    farthest = 4 * np.concatenate(squares, -1).max(-1, keepdims=True) if squares else 0
    for k, (table, (name, at, _)) in enumerate(zip(things, layer["sets"], strict=True)):
        first, shared, bias, second, second_bias = weights[5 * k : 5 * k + 5]
        columns = [table] if at is None else [table, np.sqrt(np.square(places[name]).sum(-1, keepdims=True))]
        for other, place in places.items() if at is not None else ():
            square = np.square(places[name][..., :, None, :] - place[..., None, :, :]).sum(-1)
            square = np.where(np.eye(table.shape[-2], dtype=bool), np.inf, square) if other == name else square
            least = square.min(-1)
            columns.append(np.sqrt(np.where(np.isinf(least), farthest, least))[..., None])
        rows = np.concatenate(columns, -1) @ first + (own @ shared + bias)[..., None, :]
        embedded = act(act(rows) @ second + second_bias)
        parts += [embedded.mean(-2), embedded.max(-2)]
    return np.concatenate([*parts, x[..., layer["inputs"] :]], -1)


LAYERS = {
    "affine": lambda x, _, arrays, *__: x @ arrays[0] + arrays[1],
    "relu": lambda x, *_: np.maximum(x, 0),
    "tanh": lambda x, *_: np.tanh(x),
    "norm": _normalise,
    "gru": _recur,
    "convolution": _convolve,
    "global_max_pool": lambda x, layer, *_: x.reshape(*x.shape[:-1], layer["channels"], layer["places"]).max(-1),
    "aggregate": _aggregate,
    "sets": _pool_sets,
}
"""What a layer makes of rows x [..., width], with its arrays and the observations, or hidden state, or tables."""
