"""Four tasks of mpe2 whose agents are of several kinds that all learn."""

# ruff: noqa: RUF012  (as users write a task)

from esp_envs import Discrete, Field, Items, Kind, layout
from esp_envs.adapters.pettingzoo import ParallelTask
from esp_envs.spec import discrete_moves

MOVES = discrete_moves(("stay", "left", "right", "down", "up"))
WORDS = Discrete(Kind.SCALAR, ((0.0,), (1.0,), (2.0,)), ("red", "green", "blue"))
SPOKEN_MOVES = Discrete(
    Kind.VECTOR, MOVES.points * 4, tuple(f"{move}, say {word}" for word in range(4) for move in MOVES.names)
)


def places(name: str, count: int, family: str = "", items: Items = Items.FIXED) -> Field:
    return Field(name, Kind.VECTOR, count, family=family, items=items)


OWN = (places("velocity", 1), places("position", 1))


class Tag(ParallelTask):
    observation = {
        "adversary": layout(
            *OWN,
            places("obstacles", 2),
            places("fellows", 2, items=Items.OTHERS),
            places("prey", 1, "agent"),
            places("prey_velocity", 1, "agent"),
        ),
        "agent": layout(*OWN, places("obstacles", 2), places("predators", 3, "adversary")),
    }
    action = {"adversary": MOVES, "agent": MOVES}
    shared_reward = {"adversary": True}
    symmetry, convention = "d4*agents", "mpe2 simple_tag_v3"

    def make_one(self):
        from mpe2 import simple_tag_v3

        return simple_tag_v3.parallel_env(max_cycles=self.settings.horizon)


class SpeakerListener(ParallelTask):
    observation = {
        "speaker": layout(Field("goal_colour", Kind.SCALAR, 3)),
        "listener": layout(places("velocity", 1), places("landmarks", 3), Field("heard", Kind.SCALAR, 3)),
    }
    action = {"speaker": WORDS, "listener": MOVES}
    symmetry, convention = "d4", "mpe2 simple_speaker_listener_v4"

    def make_one(self):
        from mpe2 import simple_speaker_listener_v4

        return simple_speaker_listener_v4.parallel_env(max_cycles=self.settings.horizon)


class Adversary(ParallelTask):
    observation = {
        "adversary": layout(places("landmarks", 2), places("agents", 2, "agent")),
        "agent": layout(
            places("goal", 1),
            places("landmarks", 2),
            places("adversary", 1, "adversary"),
            places("fellows", 1, items=Items.OTHERS),
        ),
    }
    action = {"adversary": MOVES, "agent": MOVES}
    shared_reward = {"agent": True}
    symmetry, convention = "d4*agents", "mpe2 simple_adversary_v3"

    def make_one(self):
        from mpe2 import simple_adversary_v3

        return simple_adversary_v3.parallel_env(max_cycles=self.settings.horizon)


class WorldComm(ParallelTask):
    observation = {
        "leadadversary": layout(
            *OWN,
            places("things", 5),
            places("others", 3, "adversary"),
            places("prey", 2, "agent"),
            places("prey_velocities", 2, "agent"),
            Field("in_forest", Kind.SCALAR, 2),
            Field("said", Kind.SCALAR, 4),
        ),
        "adversary": layout(
            *OWN,
            places("things", 5),
            places("leader", 1, "leadadversary"),
            places("fellows", 2, items=Items.OTHERS),
            places("prey", 2, "agent"),
            places("prey_velocities", 2, "agent"),
            Field("in_forest", Kind.SCALAR, 2),
            Field("heard", Kind.SCALAR, 4),
        ),
        "agent": layout(
            *OWN,
            places("things", 5),
            places("leader", 1, "leadadversary"),
            places("hunters", 3, "adversary"),
            places("fellow", 1, items=Items.OTHERS),
            Field("in_forest", Kind.SCALAR, 2),
            places("fellow_velocity", 1, items=Items.OTHERS),
        ),
    }
    action = {"leadadversary": SPOKEN_MOVES, "adversary": MOVES, "agent": MOVES}
    symmetry, convention = "d4*agents", "mpe2 simple_world_comm_v3"

    def make_one(self):
        from mpe2 import simple_world_comm_v3

        return simple_world_comm_v3.parallel_env(max_cycles=self.settings.horizon)
