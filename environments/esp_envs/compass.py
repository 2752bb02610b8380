"""A frame that agents and critic see: with it, every problem is exactly symmetric.

Dynamics and reward may prefer a direction. Written for a scene whose frame is an input, they are a function of scene
and frame, and turning both changes nothing: f(L_g s, g frame, K_g a) = L_g f(s, frame, a) for every g, whatever f is.
So a prior that turns the frame too never says anything false. The task itself only shows the frame that stands still.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from esp_envs.base import Environment, Observation, Step
from esp_envs.spec import Field, Items, Kind, TaskSpec, joint_layout, layout


def _of_the_worlds(method: str) -> Any:
    """Return a method that hands on to that of the worlds; the frame changes nothing for it."""
    return lambda self, *given, **named: getattr(self.inner, method)(*given, **named)


class Compass(Environment):
    """A task whose observations and states end with a frame.

    The frame is the two axes of the plane, as planar vectors: one vector alone is its own image in a mirror. Where
    agents are exchanged, each also sees a number that goes with it to its new place.

    Args:
        inner: the worlds.
        length: of both vectors; a short one is hard to learn from, so that the symmetry is given up late.
        labels: whether each agent sees a number of its own.
    """

    has, heuristic, scene, painter = map(_of_the_worlds, ("has", "heuristic", "scene", "painter"))
    action_mask, random_action = map(_of_the_worlds, ("action_mask", "random_action"))
    state_dict, load_state_dict = map(_of_the_worlds, ("state_dict", "load_state_dict"))

    def __init__(self, inner: Environment, length: float, labels: bool = False) -> None:
        super().__init__(inner.settings, inner.num_envs, inner.generators)
        self.inner, self.heuristics, self.ending = inner, inner.heuristics, inner.ending
        spec = inner.spec
        self._joint = spec.is_joint
        self.spec = framed(spec, labels)
        frame = torch.tensor([length, 0.0, 0.0, length], device=self.device)
        label = torch.linspace(-length, length, spec.num_agents, device=self.device) if labels else frame[:0]
        rows = frame.expand(spec.num_agents, -1)
        self._seen = torch.cat([rows, label.unsqueeze(-1)], -1) if labels else rows
        self._stated = torch.cat([frame, label])

    def reset(self) -> Observation:
        return self._framed(self.inner.reset())

    def step(self, action: Tensor) -> Step:
        step = self.inner.step(action)
        final = None if step.final is None else self._framed(step.final)
        return replace(step, next=self._framed(step.next), final=final)

    def set_state(self, state: Tensor) -> Observation:
        own = self.inner.spec
        if self._joint:
            rows = state.unflatten(-1, (own.num_agents, -1))
            return self._framed(self.inner.set_state(rows[..., : own.observation.width].flatten(2)))
        return self._framed(self.inner.set_state(state[..., : own.state.width]))

    def _framed(self, seen: Observation) -> Observation:
        lead = seen.obs.shape[:2]
        obs = torch.cat([seen.obs, self._seen.expand(*lead, -1, -1)], -1)
        state = obs.flatten(2) if self._joint else torch.cat([seen.state, self._stated.expand(*lead, -1)], -1)
        return replace(seen, obs=obs, state=state)


def framed(spec: TaskSpec, labels: bool = False) -> TaskSpec:
    """Return the spec of a task with its frame; arguments as of `Compass`."""
    frame = Field("compass", Kind.VECTOR, 2)
    own = (Field("label", Kind.SCALAR),) if labels else ()
    each = (Field("labels", Kind.SCALAR, spec.num_agents, items=Items.AGENTS),) if labels else ()
    observation = layout(*spec.observation.fields, frame, *own)
    if spec.is_joint:
        return replace(spec, observation=observation, state=joint_layout(observation, spec.num_agents))
    return replace(spec, observation=observation, state=layout(*spec.state.fields, frame, *each))
