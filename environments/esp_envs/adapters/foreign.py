"""What an environment of others is and returns, read or refused in one sentence."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from esp_envs.errors import UserError
from esp_envs.installed import last_line, raised_in
from esp_envs.spec import ActionSpace, Continuous, Kind

PARALLEL, SINGLE = "a PettingZoo ParallelEnv", "a Gymnasium environment"
_AEC, _VECTOR = "a PettingZoo AEC environment, whose agents act in turn", "a vector of environments"
_ADVICE = {
    PARALLEL: "derive from esp_envs.adapters.pettingzoo.ParallelTask",
    SINGLE: "derive from esp_envs.adapters.gymnasium.SingleAgentTask",
    _AEC: "wrap it in pettingzoo.utils.aec_to_parallel",
    _VECTOR: "return one environment; the copies are made here",
}
_PARTS = {"reset": ("observations", "infos"), "step": ("observations", "rewards", "terminated", "truncated", "infos")}
_TURNS, _MIRRORS = r"o2|so2|[cd](?!1\b)\d|rot|quarter-turn|half-turn", r"o2|d\d|flip|left-right|front-back"
_HALF = {"c2", "d2", "rot180", "half-turn"}
"""Symmetries of the scene that turn a vector, that mirror it, and those that turn it by a half at most."""
_NEGATED = {"flip-x": 1, "left-right": 1, "d1": 1, "flip-y": 0, "front-back": 0}  # part of a vector, by mirror
EVERYONE = "__all__"  # the entry of a mapping of flags that speaks of all agents


def require_kind(env: Any, wanted: str, maker: str) -> None:
    """Refuse what is not `PARALLEL` or `SINGLE`, whichever is `wanted` of the method `maker`."""
    kind = _kind(env, wanted)
    if kind != wanted:
        raise UserError(f"'{maker}' returns {kind}; {_ADVICE.get(kind, f'return {wanted}')}")


def _kind(env: Any, wanted: str) -> str:
    if env is None or isinstance(env, type):
        return "nothing" if env is None else f"the class {env.__name__} instead of an object of it"
    for kind, sign in ((_VECTOR, "single_action_space"), (_AEC, "agent_iter")):
        if hasattr(env, sign):
            return kind
    if isinstance(getattr(env, "possible_agents", None), Iterable):
        return PARALLEL
    methods = all(callable(getattr(env, name, None)) for name in ("reset", "step"))
    space = getattr(env, "action_space", None)
    if methods and not (space is None or callable(space) or (wanted == PARALLEL and isinstance(space, Mapping))):
        return SINGLE
    missing = "possible_agents" if wanted == PARALLEL else "action_space"
    return f"a {type(env).__name__}, which has no '{missing if methods else 'reset and step'}'"


class ByAgent:
    """A Gymnasium environment as a PettingZoo `ParallelEnv`, as far as the adapter needs one.

    Agents are entries of Tuple spaces and lists, as in level-based foraging: "agent_0" and so on, or "agent" `alone`.
    """

    def __init__(self, env: Any, alone: bool = True) -> None:
        self.own, self._alone = env, alone
        spaces = [env.action_space] if alone else env.action_space.spaces
        self.possible_agents = self.agents = ["agent"] if alone else [f"agent_{k}" for k in range(len(spaces))]
        self._spaces = dict(zip(self.agents, spaces, strict=True))

    def __getattr__(self, name: str) -> Any:
        """Give `state`, `unwrapped` and all else of the environment."""
        if name == "own":  # not there while it is unpacked
            raise AttributeError(name)
        return getattr(self.own, name)

    def action_space(self, agent: str) -> Any:
        return self._spaces[agent]

    def reset(self, seed: int) -> tuple[Mapping[Any, Any], ...]:
        return self._named(self.own.reset(seed=seed), "reset", "observation", "info")

    def step(self, actions: Mapping[Any, Any]) -> tuple[Mapping[Any, Any], ...]:
        given = [actions[name] for name in self.agents]
        result = self.own.step(given[0] if self._alone else given)
        return self._named(result, "step", "observation", "reward", "terminated", "truncated", "info")

    def _named(self, given: Any, method: str, *parts: str) -> tuple[Mapping[Any, Any], ...]:
        """Return what each agent gets; one number, flag or info is for all."""
        complete = isinstance(given, tuple) and len(given) == len(parts)
        if not complete or not isinstance(given[-1], Mapping | list | tuple):
            shown = f"{len(given)} parts" if isinstance(given, tuple) else f"a {type(given).__name__}"
            raise UserError(f"'{method}' returns {shown}; return ({', '.join(parts)}), as Gymnasium does")
        if self._alone:
            return tuple({"agent": part} for part in given)
        is_one = [isinstance(x, Mapping) or (not isinstance(x, tuple | list) and np.ndim(x) == 0) for x in given]
        each = ([x] * len(self.agents) if one else x for x, one in zip(given, is_one, strict=True))
        return tuple(dict(zip(self.agents, part, strict=True)) for part in each)


def space_of(env: Any, agent: Any) -> Any:
    """Return an agent's action space, from the method `action_space` or from a mapping."""
    spaces = getattr(env, "action_space", None)
    if callable(spaces):
        return spaces(agent)
    spaces = spaces if isinstance(spaces, Mapping) else getattr(env, "action_spaces", {})
    if agent not in spaces:
        raise UserError(f"{agent} has no action space, neither in 'action_space' nor in 'action_spaces'")
    return spaces[agent]


def reset(env: Any, seed: int) -> Any:
    """Reset a copy by its seed; refuse one whose `reset` takes none."""
    try:
        return env.reset(seed=seed)
    except TypeError as error:
        inside = error.__traceback__ is not None and error.__traceback__.tb_next is not None
        if inside or "unexpected keyword argument 'seed'" not in str(error):
            raise
        raise UserError("'reset' takes no seed; define reset(self, seed=None, options=None)") from error


def parts(given: Any, method: str) -> tuple[Mapping[Any, Any], ...]:
    """Return the mappings by agent that `reset` or `step` has returned."""
    names = _PARTS[method]
    shown = f"{len(given)} parts" if isinstance(given, tuple) else f"a {type(given).__name__}"
    if isinstance(given, tuple) and len(given) == len(names):
        named = zip(names, given, strict=True)
        wrong = [f"{name} as a {type(part).__name__}" for name, part in named if not isinstance(part, Mapping)]
        if not wrong:
            return given
        shown = wrong[0]
    raise UserError(f"'{method}' returns {shown}; return ({', '.join(names)}), each a mapping by agent")


def numbers(given: Any, what: str, width: int | None = None) -> NDArray[np.float32]:
    """Return what an environment or a hook gives as a row of `width` numbers; `what` begins an error's sentence."""
    if isinstance(given, torch.Tensor):
        given = given.detach().cpu()
        given = given.float() if given.dtype == torch.bfloat16 else given  # which numpy does not have
    try:
        row = np.asarray(given)
    except (TypeError, ValueError):  # rows of unequal length
        row = np.empty(0, object)
    if row.dtype.kind not in "biuf":
        what_kind = type(row.item() if row.ndim == 0 else given).__name__
        raise UserError(f"{what} is a {what_kind}, not an array of real numbers")
    if width is not None and row.size != width:
        raise UserError(f"{what} has {row.size} numbers, expected {width}")
    return row.reshape(-1).astype(np.float32, copy=False)


def ends(
    env: Any, agents: Sequence[Any], terminated: Mapping[Any, Any], truncated: Mapping[Any, Any]
) -> tuple[set[Any], set[Any]]:
    """Return who has terminated in or before this step, and who was truncated.

    An agent's own flag goes before that of `EVERYONE`. One that left `env.agents` without a flag has terminated.
    """
    over = {name for name in agents if _is_set(terminated, name)}
    cut = {name for name in agents if _is_set(truncated, name)} - over
    if _is_set(terminated, EVERYONE):
        over = set(agents) - cut
    elif _is_set(truncated, EVERYONE):
        cut = set(agents) - over
    present = getattr(env, "agents", None)
    if present is None:
        return over, cut
    if strange := set(present) - set(agents):
        raise UserError(f"{min(map(str, strange))} is in 'env.agents', but not in 'possible_agents'; list it there")
    return over | (set(agents) - set(present) - cut), cut


def _is_set(flags: Mapping[Any, Any], name: Any) -> bool:
    flag = flags.get(name, False)
    if isinstance(flag, str) or flag not in (False, True):
        raise UserError(f"the flag of {name} is {flag!r}; give True or False")
    return bool(flag)


@contextmanager
def naming(place: str, what: str) -> Iterator[None]:
    """Say which copy fails, and where, if one does."""
    try:
        yield
    except UserError:
        raise
    except (Exception, SystemExit) as error:  # an environment that calls sys.exit ends no run with code 0
        line = f", in {found}" if (found := raised_in(error)) else ""
        raise UserError(f"{place} raises in '{what}': {last_line(error)}{line}") from error


def require_round(action: Continuous, symmetry: str, name: Any, box: tuple[NDArray[Any], NDArray[Any]]) -> None:
    """Refuse bounds that break the declared symmetry.

    Of a vector a turn needs equal ones around 0, a half turn some around 0, and a mirror of an axis too for the part
    that it negates. Under mirrors those of a pseudoscalar lie around 0, and both wheels have the same.
    """
    words = re.split(r"[*,]", symmetry)
    turns, mirrors = ([word for word in words if re.match(pattern, word)] for pattern in (_TURNS, _MIRRORS))
    low, high = box
    for field, where in zip(action.layout.fields, action.layout.slices().values(), strict=True):
        lows, highs = low[where], high[where]
        around = np.isclose(lows, -highs)
        alike = around.all() and np.ptp(highs) == 0
        if field.kind.is_vector:
            negated = [_NEGATED.get(word) for word in mirrors if word not in turns]
            bent = any(not alike if part is None else not around[part::2].all() for part in negated)
            bent |= bool(turns) and not (around.all() if _HALF.issuperset(turns) else alike)
        elif field.kind is Kind.PSEUDOSCALAR:
            bent = bool(mirrors) and not around.all()
        else:
            unlike = any(not np.array_equal(end[0::2], end[1::2]) for end in (lows, highs))
            bent = field.kind is Kind.WHEELS and bool(mirrors) and unlike
        if bent:
            raise UserError(
                f"{name} acts by '{field.name}', a {field.kind.name}, between {low[where].tolist()} and "
                f"{high[where].tolist()}, which '{symmetry}' does not leave alone; declare a smaller symmetry, or "
                "give bounds that are equal on all sides"
            )


def bounds_of(space: Any, action: ActionSpace) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Return the bounds of a finite Box of as many real numbers as the action has, None for any other space."""
    if not isinstance(action, Continuous) or not hasattr(space, "low") or space.dtype.kind != "f":
        return None
    if space.shape != (action.width,):
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        is_finite = np.isfinite(space.high - space.low).all()  # bounds of the largest numbers are none
    return (np.asarray(space.low), np.asarray(space.high)) if is_finite else None
