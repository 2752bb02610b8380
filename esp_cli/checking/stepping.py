"""States along the episodes of a task, and the steps that follow from them and from their images.

A run draws its chance from a seed. So the run from the images can meet the same chance as the run from the states: if
both give the same, up to the transform, they have one distribution.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from esp_cli.checking.recorded import picked
from esp_cli.checking.shifting import Unmoved, leaves
from esp_cli.checking.verdicts import Watch, stop_at
from esp_cli.symmetry import Element, Transform, build_transform
from esp_envs.base import Environment, Observation, Step, joined
from esp_envs.errors import UserError
from esp_envs.promises import MakeWorlds
from esp_envs.spec import Continuous, Layout, TaskSpec
from esp_envs.views import OthersAtRandom, RoleView

MOMENTS = 8  # points of an episode at which states are taken
_NUDGE = 1e-6  # how far a state is moved to see what rounding does


def visit(env: Environment, watch: Watch, until: float, early: bool = False) -> list[tuple[Tensor, Tensor]]:
    """Return states and joint actions along episodes, half of the worlds random, half by the heuristic if any.

    Where episodes were terminated, the last moment has the states and actions that this followed; other worlds repeat.
    After `until` no more steps are taken. With `early`, moments lie closer together at the beginning, so that a slow
    simulator reaches most of them in time: 0, 1, 5, 12, 31, 74, 177, 421 of 1000 steps.
    """
    observation, last = env.reset(), env.spec.horizon - 1
    places = (((last + 1) ** (k / MOMENTS) - 1) if early else k * last / MOMENTS for k in range(MOMENTS))
    taken = set(map(round, places))
    visited: list[tuple[Tensor, Tensor]] = []
    ending: tuple[Tensor, Tensor] | None = None
    for t in range(max(taken) + 1):
        if visited and time.monotonic() > until:
            break
        action = env.random_action()
        if t in taken:
            visited.append((observation.state.clone(), action))
        steered, half = action.clone(), env.num_envs // 2
        if env.heuristics:
            steered[:, :half] = env.heuristic()[:, :half]
        step = env.step(steered)
        if env.spec.terminates and bool(step.terminated.any()):
            before, old = (observation.state, steered), ending or visited[0]
            ending = (picked(step.terminated, before[0], old[0]), picked(step.terminated, before[1], old[1]))
        observation = step.next
        watch(t + 1, max(taken) + 1, "steps")
    return visited if ending is None else [*visited, ending]


def outcomes(
    env: Environment,
    visited: Sequence[tuple[Tensor, Tensor]],
    turned: Transform | Unmoved,
    seed: int,
    until: float,
    onwards: bool = False,
) -> Step:
    """Return the steps from each moment's states as one step, of as many worlds as all moments have together.

    What is seen at the start replaces `next`; moments at which a simulator does not say it are left out there.
    `turned` makes the images. Agents of other roles act at random with the run's `seed`, alike in each run, in images
    turned. With `onwards` episodes go on from the first moment's states, with the actions of all moments: clocks run,
    and what no state holds builds up.
    """
    _begin(env, len(visited), turned, seed)
    steps, seen = list[Step](), None
    for state, action in visited:
        stop_at(until)
        if seen is None or not onwards:
            env.reset()
            seen = env.set_state(turned.state(state))
        step = env.step(turned.action(action))
        steps.append(replace(step, next=seen, final=step.reached, metrics={}))
        seen = step.next
    starts = [step.next for step in steps if is_told(step.next)]
    return Step(
        next=_side_by_side(starts or [steps[0].next]),
        reward=torch.cat([step.reward for step in steps], 1),
        terminated=torch.cat([step.terminated for step in steps], 1),
        truncated=torch.cat([step.truncated for step in steps], 1),
        final=_side_by_side([step.reached for step in steps]),
        metrics={},
    )


def is_told(seen: Observation) -> bool:
    """Return whether a simulator says what is seen; some of others do not before a step."""
    return bool(seen.obs.isfinite().any())


def _side_by_side(seen: Sequence[Observation]) -> Observation:
    masks = [one.action_mask for one in seen if one.action_mask is not None]
    alive = [one.alive for one in seen if one.alive is not None]
    return Observation(
        torch.cat([one.obs for one in seen], 1),
        torch.cat([one.state for one in seen], 1),
        torch.cat(masks, 1) if masks else None,
        torch.cat(alive, 1) if alive else None,
    )


def _begin(env: Environment, steps: int, turned: Transform | Unmoved, seed: int) -> None:
    """Let all that chance decides follow from a seed, and agents of other roles act alike in each run, but turned."""
    worlds = env.inner if isinstance(env, RoleView) else env
    if isinstance(env, RoleView) and isinstance(env.turns, OthersAtRandom):
        _seed(worlds, 0)
        image = _joint_image(worlds.spec, turned.elements[0].in_place)
        drawn = iter([] if worlds.spec.masks else [worlds.random_action() for _ in range(steps)])
        env.turns.image = lambda action: image(next(drawn, action))
    _seed(worlds, seed)


def _seed(env: Environment, seed: int) -> None:
    for k, generator in enumerate(env.generators):
        generator.manual_seed(seed + k)


def _joint_image(spec: TaskSpec, scene: Element) -> Callable[[Tensor], Tensor]:
    """Return what turns the joint actions of all roles; those of a role that cannot carry the element stay."""
    maps = []
    for role, where in spec.parts:
        try:
            transform = build_transform([scene], role)
        except UserError:
            transform = build_transform([Element()], role)
        width = role.action.width if isinstance(role.action, Continuous) else None
        own: tuple[slice, ...] = (slice(None), slice(None), where)
        maps.append((transform, own if width is None else (*own, slice(width))))

    return lambda action: joined([one.action(action[own]) for one, own in maps])


def seek_end(
    make: MakeWorlds, state: Tensor, steps: int, until: float, sought: Collection[str]
) -> tuple[Tensor, Tensor]:
    """Return states [1, E, state width] and actions, of which up to a quarter end something; else a LookupError.

    That is an episode ("end") or what one agent does ("alive"): each that is `sought`, as play did not show it, has an
    equal part. In half of the worlds all things gather first, as at a goal. Worlds act at random, and go on from the
    quarter of them that was paid most so far.
    """
    env = make(state.shape[1], [0])
    env.renews, half = False, env.num_envs // 2
    state = torch.cat([stretched(state[:, :half], env.spec.state, decades=-3.0), state[:, half:]], 1)
    paid, count = torch.zeros(env.num_envs, device=state.device), max(1, env.num_envs // 4)
    first, ends, missing = None, list[tuple[Tensor, Tensor]](), dict.fromkeys(sought, max(1, count // len(sought)))
    for _ in range(steps):
        stop_at(until)
        env.reset()
        env.set_state(state)
        action = env.random_action()
        step = env.step(action)
        first, alive = first or (state, action), step.reached.alive
        for name, most in missing.items():
            over = step.terminated if name == "end" or alive is None else ~alive.all(-1)
            where = over[0].nonzero()[:most, 0]
            ends.append((state[:, where], action[:, where]))
            missing[name] -= len(where)
        if not any(missing.values()):
            break
        paid = paid + step.reward.flatten(0, 1).flatten(1).mean(-1).nan_to_num(-torch.inf)
        best = paid.topk(count).indices.repeat(-(-env.num_envs // count))[: env.num_envs]
        state, paid = step.reached.state[:, best], paid[best]
    ended, done = (torch.cat(part, 1) for part in zip(*ends, strict=True))
    if first is None or not ended.shape[1]:
        raise LookupError
    return torch.cat([ended, first[0][:, ended.shape[1] :]], 1), torch.cat([done, first[1][:, ended.shape[1] :]], 1)


def played(make: MakeWorlds, state: Tensor, steps: int, seed: int, until: float) -> list[tuple[Tensor, Tensor]]:
    """Return states [1, E, state width] and random actions that are allowed in the steps that follow them."""
    env = make(state.shape[1], [0])
    env.renews, episode = False, list[tuple[Tensor, Tensor]]()
    _seed(env, seed)
    env.reset()
    env.set_state(state)
    for _ in range(steps):
        stop_at(until)
        episode.append((state, env.random_action()))
        env.step(episode[-1][1])
    return episode


def stretched(state: Tensor, layout: Layout, decades: float = 1.0) -> Tensor:
    """Return states [1, E, state width] whose vectors are up to 10**decades times as long, all of one alike."""
    share = torch.rand(state.shape[1], 1, generator=torch.Generator().manual_seed(0)).to(state.device)
    factor = 10 ** (decades * share)
    out = state.clone()
    for field, where in leaves(layout.fields):
        if field.kind.is_vector and not bool((state[..., where] == state[..., where].round()).all()):  # no cells
            out[..., where] *= factor
    return out


def nudged(state: Tensor) -> Tensor:
    """Return states that differ by about what rounding leaves; whole numbers, as of cells, stay."""
    noise = torch.randn(state.shape, generator=torch.Generator().manual_seed(0)).to(state.device)
    return torch.where(state == state.round(), state, state + _NUDGE * (1 + state.abs()) * noise)
