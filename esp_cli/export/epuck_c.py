"""The C source around an exported policy that drives an e-puck: poses in, wheel speeds out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from esp_cli.export.c_parts import literal, numbers
from esp_cli.export.runtime.esp_epuck import PATIENCE_S
from esp_envs.errors import UserError

_PARAMETERS = """const float *poses, int robots, int own, const float goal[2],
    const float *pillars, int num_pillars"""

_HEADER = """/*
 * What an e-puck sees and does, for the policy beside this file. Untested on hardware.
 *
 * Positions are metres in the arena's frame (x right, y up), headings radians counter-clockwise from x.
 *   poses    x, y and heading of every robot of the team, 3 numbers a robot
 *   robots   how many there are: at least @team@
 *   own      which of them is this one, from 0
 *   goal     x and y of this robot's goal
 *   pillars  x and y of the middle of every pillar, num_pillars of them; may be NULL for none
 */
#ifndef ESP_EPUCK_H
#define ESP_EPUCK_H

#include "policy.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Nearest robots that an observation shows. */
#define ESP_EPUCK_SEEN_ROBOTS @seen@
/* Call esp_epuck_drive this often, s. */
#define ESP_EPUCK_PERIOD_S @period@
/* Age of poses beyond which the robot stands still, s. */
#define ESP_EPUCK_PATIENCE_S @patience@

/* Builds the observation of this robot. Returns 1, or 0 where a number is not finite or too few bodies are given. */
int esp_epuck_observe(@parameters@, float observation[ESP_POLICY_OBSERVATION]);

/*
 * Chooses the left and right wheel speed of this robot, rad/s; age_s says how old the poses are. Returns 1, or 0 with
 * both wheels at 0 where esp_epuck_observe returns 0, the poses are too old, or an action is not finite.
 */
int esp_epuck_drive(@parameters@, float age_s, float wheels[2]);

#ifdef __cplusplus
}
#endif

#endif
"""

_SOURCE = """#include "esp_epuck.h"

#include <math.h>

@pairs@static int all_finite(const float *x, int count)
{
    int k;
    for (k = 0; k < count; k++) {
        if (!isfinite(x[k])) return 0;
    }
    return 1;
}

@bodies@int esp_epuck_observe(@parameters@, float observation[ESP_POLICY_OBSERVATION])
{
    const float *from;
    int k;

    if (robots <= ESP_EPUCK_SEEN_ROBOTS || own < 0 || own >= robots || num_pillars < @pillars@) return 0;
    if (!all_finite(poses, 3 * robots) || !all_finite(goal, 2)) return 0;
    if (num_pillars && !all_finite(pillars, 2 * num_pillars)) return 0;
    from = poses + 3 * own;
@fields@    return 1;
}

int esp_epuck_drive(@parameters@, float age_s, float wheels[2])
{
    float observation[ESP_POLICY_OBSERVATION];
    int k;

    wheels[0] = wheels[1] = 0.0f;
    if (!(fabsf(age_s) <= ESP_EPUCK_PATIENCE_S)) return 0;
    if (!esp_epuck_observe(poses, robots, own, goal, pillars, num_pillars, observation)) return 0;
@act@    return 1;
}
"""

_BODIES = """/*
 * Returns the nearest body beyond *distance, or at it and after `last`; -1 for none. A body has `stride` numbers.
 * Writes its distance.
 */
static int nearest(const float *bodies, int stride, int count, int own, const float *from,
                   float *distance, int last)
{
    const float after = *distance;
    int k, best = -1;
    for (k = 0; k < count; k++) {
        const float apart = hypotf(bodies[k * stride] - from[0], bodies[k * stride + 1] - from[1]);
        if (k == own || apart < after || (apart == after && k <= last)) continue;
        if (best < 0 || apart < *distance) {
            best = k;
            *distance = apart;
        }
    }
    return best;
}

/* Writes the way to a body as it is seen. */
static void see(const float *body, const float *from, float distance, float reach, float *seen)
{
@see@}

"""

_OFFSET = """    int k;
    (void)distance;
    (void)reach;
    for (k = 0; k < 2; k++) seen[k] = body[k] - from[k];
"""
_NEARNESS = """    const float gap = distance > reach ? distance - reach : 0.0f;
    const float scale = expf(-gap / @fading@) / (distance > 1e-9f ? distance : 1e-9f);
    int k;
    for (k = 0; k < 2; k++) seen[k] = (body[k] - from[k]) * scale;
"""

_FIELDS = {
    "heading": """    observation[@place@] = cosf(from[2]);
    observation[@place@ + 1] = sinf(from[2]);
""",
    "goal": """    for (k = 0; k < 2; k++) observation[@place@ + k] = goal[k] - from[k];
""",
    "obstacle": """    {
        float distance = -1.0f;
        const int body = num_pillars ? nearest(pillars, 2, num_pillars, -1, from, &distance, -1) : -1;
        observation[@place@] = observation[@place@ + 1] = 0.0f; /* without pillars */
        if (body >= 0) see(pillars + 2 * body, from, distance, @pillar_reach@, observation + @place@);
    }
""",
    "robots": """    {
        float distance = -1.0f;
        int body = -1;
        for (k = 0; k < ESP_EPUCK_SEEN_ROBOTS; k++) {
            body = nearest(poses, 3, robots, own, from, &distance, body);
            see(poses + 3 * body, from, distance, @robot_reach@, observation + @place@ + 2 * k);
        }
    }
""",
}
"""Field of the task's layout -> the lines that write it."""

_GOAL_WITHIN = """    {
        const float apart = hypotf(goal[0] - from[0], goal[1] - from[1]), unit = @goal_unit@;
        for (k = 0; k < 2; k++) observation[@place@ + k] = (goal[k] - from[k]) / (apart > unit ? apart : unit);
    }
"""
_SQUASHED = """    esp_policy_act(observation, wheels);
    for (k = 0; k < 2; k++) {
        if (!isfinite(wheels[k])) {
            wheels[0] = wheels[1] = 0.0f;
            return 0;
        }
        wheels[k] = @max_speed@ * fmaxf(-1.0f, fminf(1.0f, wheels[k]));
    }
"""
_CHOSEN = """    {
        const float *pair = pairs + 2 * esp_policy_act(observation);
        if (!all_finite(esp_policy_outputs(), ESP_POLICY_ACTION)) return 0;
        for (k = 0; k < 2; k++) wheels[k] = @max_speed@ * pair[k];
    }
"""


def epuck_sources(description: Mapping[str, Any]) -> dict[str, bytes]:
    """Return the header and the source that build observations from poses and drive the wheels.

    Args:
        description: of an exported policy without memory that drives e-pucks.

    Raises:
        UserError: the policy sees something that poses do not tell.
    """
    robot, settings = description["robot"], description["task"]["settings"]
    fields, nearness = description["observation"], settings["sight"] == "nearness"
    options = description["action"].get("options")
    seen = min(settings["neighbours"], settings["num_agents"] - 1)
    names, body = [field["field"] for field in fields], robot["body_radius_m"]
    if unknown := set(names) - _FIELDS.keys():
        raise UserError(f"poses do not tell what this policy sees: {', '.join(sorted(unknown))}")
    unit = settings["goal_sight_m"]
    texts = _FIELDS if unit is None else _FIELDS | {"goal": _GOAL_WITHIN}
    lines = [texts[f["field"]].replace("@place@", f["index"].partition("..")[0]) for f in fields]
    pairs = [x for option in options or () for x in option["means"]]
    values = {
        "pairs": f"static const float pairs[] = {{\n{numbers(pairs)}}};\n\n" if pairs else "",
        "bodies": _BODIES if {"obstacle", "robots"} & set(names) else "",
        "fields": "".join(lines),
        "act": _CHOSEN if pairs else _SQUASHED,
        "see": _NEARNESS if nearness else _OFFSET,
        "parameters": _PARAMETERS,
        "seen": str(seen),
        "team": str(seen + 1),
        "pillars": "1" if "obstacle" in names and not nearness else "0",
        "period": literal(description["task"]["control_period_s"]),
        "patience": literal(PATIENCE_S),
        "pillar_reach": literal(settings["obstacle_radius_m"] + body),
        "robot_reach": literal(2 * body),
        "fading": literal(robot["fading_m"]),
        "goal_unit": literal(unit or 1.0),
        "max_speed": literal(robot["max_wheel_speed_rad_s"]),
    }
    return {"esp_epuck.h": _filled(_HEADER, values), "esp_epuck.c": _filled(_SOURCE, values)}


def _filled(text: str, values: Mapping[str, str]) -> bytes:
    """Put the values in their places; parts come before what stands in them."""
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text.encode()
