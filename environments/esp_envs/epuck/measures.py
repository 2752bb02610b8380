"""Reward and metrics of a step of the formation."""

from __future__ import annotations

from esp_envs.epuck.formation_spec import FormationSettings
from esp_envs.epuck.robot import BODY_RADIUS_M, Array, Flags

RISKY_GAP_M = 0.05
"""Gap between two robots below which a state is risky (supplement of the paper)."""
CONTACT_GAP_M = 0.001
"""Gap below which two bodies count as touching."""


def step_reward(settings: FormationSettings, progress: Array, apart: Array) -> Array:
    """Return g_i + c_i: [W, N].

    Args:
        settings: of the task.
        progress: [W, N] by how much each robot came nearer to its goal, m.
        apart: [W, N, N + M] distances of the centres to all robots and pillars, m.
    """
    near = apart < settings.radius
    count = near.any(-1) if settings.penalty_counts == "any" else near.sum(-1)
    return settings.progress_weight * progress - settings.penalty * count


def step_metrics(
    settings: FormationSettings,
    new: Flags,
    arrived: Flags,
    begun: Flags,
    apart: Array,
    way: Array,
    final_distance: Array,
) -> dict[str, Array]:
    """Return the metrics of a step, each [W].

    Args:
        settings: of the task.
        new: [W, N] whether each robot arrived in this step.
        arrived: [W, N] whether each has arrived so far.
        begun: [W, N, N + M] whether a contact of two bodies began in this step.
        apart: [W, N, N + M] distances of the centres, m.
        way: [W, N] length of each robot's way in this step, m.
        final_distance: [W, N] distance to the goal in the last step, 0 before, m.
    """
    robots = settings.num_agents
    risky = apart[..., :robots] < RISKY_GAP_M + 2 * BODY_RADIUS_M
    return {
        "arrival_rate": new.mean(-1),
        "time_to_arrival_s": (~arrived).mean(-1) * settings.control_period_s,
        "collisions": begun[..., :robots].sum((1, 2)) / 2 + begun[..., robots:].sum((1, 2)),
        "risky_rate": risky.any((1, 2)),
        "path_length_m": way.mean(-1),
        "final_distance_m": final_distance.mean(-1),
    }
