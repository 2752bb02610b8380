"""The mirrors of a robot's observations and actions, derived from its model and proven in MuJoCo.

They need numpy, or torch for tensors, alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

ELEMENTS, OBSERVATIONS, ACTIONS = tuple[str, ...](), dict[str, Any](), dict[str, Any]()  # DATA


def mirrored(rows: Any, element: str, group: str | None = None) -> Any:
    """Return rows [..., D] of a group of observations, or of actions (None), under one of ELEMENTS."""
    if group is not None and group not in OBSERVATIONS:
        raise ValueError(f"no mirror was written of the observations {group!r}; name their terms")
    source, factor = (ACTIONS if group is None else OBSERVATIONS[group])[element]
    if rows.shape[-1] != len(source[0]):
        raise ValueError(f"rows of {group or 'actions'} have {rows.shape[-1]} numbers, the mirror {len(source[0])}")
    if "float" not in str(rows.dtype):
        raise ValueError(f"rows of {group or 'actions'} are {rows.dtype}; give floats")
    make = rows.new_tensor if hasattr(rows, "new_tensor") else lambda x: np.asarray(x, rows.dtype)
    # term by term, since the product of a matrix would be rounded under autocast and TF32
    terms = [rows[..., index] * make(times) for index, times in zip(source, factor, strict=True)]
    return sum(terms[1:], terms[0])


def with_copies(rows: Any, images: list[Any], axis: int = 0) -> Any:
    """Return rows with their copies behind them."""
    if isinstance(rows, np.ndarray):
        return np.concatenate([rows, *images], axis)
    import torch  # noqa: PLC0415 - only where rows are tensors

    return torch.cat([rows, *images], axis)


def compute_symmetric_states(
    env: Any = None,  # noqa: ARG001 - rsl_rl hands it over
    obs: Any = None,
    actions: Any = None,
    obs_type: str | None = None,
) -> Any:
    """Return observations and actions, each followed by its copies: `data_augmentation_func` of rsl_rl.

    Args:
        env: is not used.
        obs: a TensorDict of groups [B, D], or rows [B, D] of one group.
        actions: [B, A].
        obs_type: the group of rows; by default the first.
    """
    if obs is not None and hasattr(obs, "batch_size"):
        copies = [obs.clone() for _ in ELEMENTS]
        for copy, element in zip(copies, ELEMENTS, strict=True):
            for group in obs.keys():  # noqa: SIM118 - a TensorDict
                copy[group] = mirrored(obs[group], element, group)
        obs = with_copies(obs, copies)
    elif obs is not None:
        group = obs_type or next(iter(OBSERVATIONS), "policy")
        obs = with_copies(obs, [mirrored(obs, element, group) for element in ELEMENTS])
    if actions is not None:
        actions = with_copies(actions, [mirrored(actions, element) for element in ELEMENTS])
    return obs, actions


def augment(obs: Any, actions: Any, *numbers: Any, group: str | None = None, axis: int = 0) -> Any:
    """Return rows, actions, and numbers that stay (rewards, log-probabilities, None), each followed by its copies.

    Copies are made of all ELEMENTS; take out those under which your reward is another.
    Histories [T, B, D] of a recurrent policy are rows with axis=1: mirror them whole, from their first step.
    """
    group = group or next(iter(OBSERVATIONS), "policy")
    obs = with_copies(obs, [mirrored(obs, element, group) for element in ELEMENTS], axis)
    actions = with_copies(actions, [mirrored(actions, element) for element in ELEMENTS], axis)
    return obs, actions, *(x if x is None else with_copies(x, [x] * len(ELEMENTS), axis) for x in numbers)
