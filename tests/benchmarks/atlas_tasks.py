"""Layouts of tasks of others for the atlas, a few lines each: mpe2, SISL, Gymnasium's MuJoCo, level-based foraging."""

from typing import Any

import numpy as np

from esp_envs import Continuous, Discrete, Field, Items, Kind, Layout, layout
from esp_envs.adapters.gymnasium import SingleAgentTask
from esp_envs.adapters.pettingzoo import ParallelTask
from esp_envs.mpe.task import MOVES
from esp_envs.spec import discrete_moves
from tests.envs import mpe_roles

V, S, P, OTHERS = Kind.VECTOR, Kind.SCALAR, Kind.PSEUDOSCALAR, Items.OTHERS


def zoo(module: str, *seen: Field, **attributes: Any) -> type[ParallelTask]:
    """Return the task of a module of mpe2 or `pettingzoo.sisl` that has a `parallel_env`."""

    def make_one(self: ParallelTask) -> Any:
        env = __import__(module, fromlist=["parallel_env"])
        return env.parallel_env(max_cycles=self.settings.horizon + 1)

    members: dict[str, Any] = {"observation": Layout(seen), "action": MOVES, "symmetry": "c1", "make_one": make_one}
    return type(module.rpartition(".")[2].title(), (ParallelTask,), members | {"convention": module} | attributes)


def gym(name: str, *seen: Field, torques: int = 0, **attributes: Any) -> type[SingleAgentTask]:
    """Return the task of a Gymnasium environment whose actions change sign in a mirror."""

    def make_single(self: SingleAgentTask) -> Any:
        import gymnasium

        return gymnasium.make(name)

    action = attributes.pop("action", None) or Continuous(layout(Field("torque", P, torques)))
    members: dict[str, Any] = {
        "observation": Layout(seen),
        "action": action,
        "symmetry": "c1",
        "terminates": name != "Reacher-v5",
    }
    members |= {"make_single": make_single, "convention": name}
    return type(name.title().replace("-", ""), (SingleAgentTask,), members | attributes)


def first_vectors(task: ParallelTask, agent: str, observation: Any) -> Any:
    """Put (cos, sin) of the arm and of the target side by side: [cos a, cos b, sin a, sin b, x, y, ...]."""
    a = np.asarray(observation)
    return np.concatenate([a[[0, 2]], a[[1]], a[[3]], a[4:]])


ARM = (Field("arm", V), Field("bend", S), Field("side", P), Field("target", V), Field("spins", P, 2), Field("gap", V))
TEAMS = {"collector": 6, "deposit": 2}


def teams(env: Any) -> list[Any]:
    """Return the collectors of collect_treasure, then the deposits."""
    return sorted(env.unwrapped.world.agents, key=lambda agent: not agent.collector)


def hoard(self: ParallelTask, env: Any) -> Any:
    """Return agents, what collectors hold, and treasures; one that was taken is parked far away, and is 0 here."""
    agents = teams(env)
    rows = [np.ravel([getattr(a.state, w) for a in t]) for t in (agents[:6], agents[6:]) for w in ("p_pos", "p_vel")]
    held = [-1 if agent.holding is None else agent.holding for agent in agents[:6]]
    marks = [(*(mark.state.p_pos * mark.alive), mark.alive, mark.type) for mark in env.unwrapped.world.landmarks]
    return np.concatenate([*rows, held, np.ravel(marks)])


def heap(self: ParallelTask, env: Any, state: Any) -> None:
    agents, start = teams(env), 0
    for some in (agents[:6], agents[6:]):
        rows = state[start : start + 4 * len(some)].reshape(2, len(some), 2)
        start += rows.size
        for agent, place, speed in zip(some, *rows, strict=True):
            agent.state.p_pos, agent.state.p_vel = place.astype(float), speed.astype(float)
    for agent, held in zip(agents[:6], state[start : start + 6], strict=True):
        agent.holding = None if held < 0 else round(float(held))
    for mark, (x, y, alive, kind) in zip(env.unwrapped.world.landmarks, state[start + 6 :].reshape(-1, 4), strict=True):
        mark.alive, mark.type = bool(alive > 0.5), round(float(kind))
        mark.state.p_pos = np.array([x, y] if mark.alive else [-999.0, -999.0])


OWN = (Field("position", V), Field("velocity", V))
AROUND = (
    Field("others", Kind.RECORD, 7, parts=(Field("at", V), Field("speed", V), Field("is", S, 4))),
    Field("treasures", Kind.RECORD, 6, parts=(Field("at", V), Field("is", S, 2))),
)
MPE = {
    "simple": zoo("mpe2.simple_v3", Field("velocity", V), Field("mark", V)),
    "simple_formation": zoo(
        "mpe2.simple_formation_v1", Field("velocity", V), Field("position", V), Field("landmarks", V)
    ),
    "simple_line": zoo("mpe2.simple_line_v1", Field("velocity", V), Field("position", V), Field("landmarks", V, 2)),
    "simple_spread": zoo(
        "mpe2.simple_spread_v3",
        *(Field("velocity", V), Field("position", V), Field("landmarks", V, 3), Field("others", V, 2, items=OTHERS)),
        Field("messages", S, 4),
    ),
    "simple_reference": zoo(
        "mpe2.simple_reference_v3",
        *(Field("velocity", V), Field("landmarks", V, 3), Field("color", S, 3), Field("words", S, 10)),
        action=Discrete(V, MOVES.points * 10, tuple(f"{move}, {word}" for word in range(10) for move in MOVES.names)),
    ),
    "simple_tag": mpe_roles.Tag,
    "simple_adversary": mpe_roles.Adversary,
    "simple_speaker_listener": mpe_roles.SpeakerListener,
    "simple_world_comm": mpe_roles.WorldComm,
    "simple_push": zoo(
        "mpe2.simple_push_v3",
        observation={
            "adversary": layout(Field("velocity", V), Field("landmarks", V, 2), Field("other", V)),
            "agent": layout(
                *(Field("velocity", V), Field("goal", V), Field("color", S, 3), Field("landmarks", V, 2)),
                *(Field("colors", S, 6), Field("other", V)),
            ),
        },
        action={"adversary": MOVES, "agent": MOVES},
    ),
    "collect_treasure": zoo(
        "mpe2.collect_treasure_v1",
        observation={"collector": layout(*OWN, Field("holding", S, 2), *AROUND), "deposit": layout(*OWN, *AROUND)},
        action={"collector": MOVES, "deposit": MOVES},
        simulated=layout(
            *(Field(f"{who}.{what}", V, n, family=who) for who, n in TEAMS.items() for what in ("place", "speed")),
            Field("held", S, TEAMS["collector"], family="collector"),
            Field("hoard", Kind.RECORD, 6, parts=(Field("at", V), Field("alive", S), Field("type", S))),
        ),
        take=hoard,
        put=heap,
    ),
}


def reached(self: SingleAgentTask, env: Any) -> Any:
    """Return where the reacher's arm and target are, angles as (cos, sin), and how fast."""
    q, v = env.unwrapped.data.qpos, env.unwrapped.data.qvel
    return np.concatenate([[np.cos(q[0]), np.sin(q[0]), np.cos(q[1]), np.sin(q[1])], q[2:], v])


def reach(self: SingleAgentTask, env: Any, state: Any) -> None:
    """Put arm and target there."""
    angles = np.arctan2(state[[1, 3]], state[[0, 2]])
    env.unwrapped.set_state(np.concatenate([angles, state[4:6]]), state[6:])


MUJOCO = {
    "InvertedPendulum-v5": gym("InvertedPendulum-v5", *(Field(n, P) for n in ("x", "angle", "v", "spin")), torques=1),
    "InvertedDoublePendulum-v5": gym(
        "InvertedDoublePendulum-v5",
        *(Field("x", P), Field("sin", P, 2), Field("cos", S, 2), Field("rates", P, 3), Field("force", P)),
        torques=1,
        simulated=layout(Field("q", P, 3), Field("v", P, 3)),
    ),
    "Reacher-v5": gym(
        "Reacher-v5",
        *ARM,
        torques=2,
        reading=first_vectors,
        simulated=layout(*ARM[:5], Field("target_velocity", V)),
        take=reached,
        put=reach,
    ),
}
ROBOTS = ("ant", "halfcheetah", "walker2d", "humanoid", "swimmer", "ant4x2", "halfcheetah2x3")
"""Tasks that have a name here."""
MORE_ROBOTS = ("HumanoidStandup-v5", "Hopper-v5")
"""Other robots of Gymnasium, of which the models say all."""


def robot(name: str) -> type[SingleAgentTask]:
    from esp_cli.bodies.gymnasium import MujocoTask

    return type(name.partition("-")[0], (MujocoTask,), {"scenario": name, "convention": name, "terminates": True})


PURSUIT = zoo(
    "pettingzoo.sisl.pursuit_v5",
    Field("seen", Kind.PICTURE, 3, pixels=(7, 7)),
    action=discrete_moves(("left", "right", "up", "down", "stay")),
    reading=lambda self, agent, obs: np.asarray(obs).transpose(2, 1, 0)[:, ::-1],
    terminates=True,
)


AT = (Field("at", V), Field("level", S))
FOODS = Field("foods", Kind.RECORD, 3, parts=(*AT, Field("is_there", S)), sorted_by=(-4, -2, 1))


class Foraging(ParallelTask):
    """Level-based foraging: foods from the top, each row from the left, then players, the own one first."""

    observation = layout(
        FOODS, Field("own", Kind.RECORD, parts=AT), Field("others", Kind.RECORD, parts=AT, items=OTHERS)
    )
    simulated = layout(FOODS, Field("players", Kind.RECORD, 2, parts=AT, items=Items.AGENTS), Field("spawned", S))
    action = Discrete(
        V, ((0, 0), (0, 1), (0, -1), (-1, 0), (1, 0), (0, 0)), ("stay", "up", "down", "left", "right", "load")
    )
    symmetry, convention, terminates = "c1", "Foraging-8x8-2p-3f-v3", True

    def make_one(self) -> Any:
        from lbforaging.foraging import ForagingEnv

        return ForagingEnv(
            players=2, min_player_level=1, max_player_level=2, min_food_level=1, max_food_level=None,
            field_size=(8, 8), max_num_food=3, sight=8, max_episode_steps=50, force_coop=False,
        )  # fmt: skip

    def reading(self, agent: str, observation: Any) -> Any:
        """Turn (row, column) from the top into (x, y) about the middle; what is not there is 0."""
        row, column, level = np.asarray(observation).reshape(-1, 3).T
        there = row >= 0
        seen = np.stack([there * (column - 3.5), there * (3.5 - row), level, there], 1)
        return np.concatenate([seen[:3].ravel(), seen[3:, :3].ravel()])

    def take(self, env: Any) -> Any:
        bare = env.unwrapped
        found = [(row, column, bare.field[row, column]) for row, column in zip(*np.nonzero(bare.field), strict=True)]
        players = [(*player.position, player.level) for player in bare.players]
        every = found + [(-1, -1, 0)] * (3 - len(found)) + players
        return np.append(self.reading("", np.array(every, float)), bare._food_spawned)

    def put(self, env: Any, state: Any) -> None:
        """Put foods and players to their places."""
        bare = env.unwrapped
        bare.field[:] = 0
        for x, y, level, there in state[:12].reshape(3, 4):
            if there > 0.5:
                bare.field[round(3.5 - y), round(x + 3.5)] = round(level)
        for player, (x, y, level) in zip(bare.players, state[12:18].reshape(2, 3), strict=True):
            player.position, player.level = (round(3.5 - y), round(x + 3.5)), round(level)
        bare._food_spawned = state[18]
        bare._gen_valid_moves()
