"""The algorithms by name, and presets: what `--preset` and the task change in the defaults.

`PRESETS` holds settings by algorithm, preset and section. `TUNED` holds what the preset `default` changes on a task:
the settings that measured best there; `PAPER` is the same for the preset `paper`. `FAST` holds what the preset `fast`
changes in `default` on a task: fewer seconds to the same return. `SETS` holds the settings of tasks on which a network
over sets is best; both presets have them there, unless another network is chosen. A setting that no table names keeps
the default of its config class.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from esp_envs.errors import UserError
from esp_envs.installed import Registry

if TYPE_CHECKING:
    from esp_cli.algorithms.learner import Learner

ALGORITHMS: Registry[Learner] = Registry(
    "algorithm",
    {
        "mappo": "esp_cli.algorithms.mappo:Mappo",
        "maddpg": "esp_cli.algorithms.maddpg:Maddpg",
        "qmix": "esp_cli.algorithms.qmix:Qmix",
    },
    base="esp_cli.algorithms.learner:Learner",
    option="--algo",
    example="reinforce:Reinforce",
)

Sections = dict[str, dict[str, object]]  # settings by section: the algorithm's name, "network", "prior" or "evaluation"

_GRU: dict[str, object] = {"name": "gru", "hidden": (64, 64), "activation": "relu", "layer_norm": True}
_QUARTER_TURN: dict[str, object] = {"transforms": "rot90", "consistency_coef": 0.5}
_ONE_EPISODE: dict[str, object] = {"num_envs": 1, "rounds": 20, "replay_episodes": 5000, "td_lambda": 0.0}
_PLAIN_LEARNING: dict[str, object] = {"learning_rate": 7e-4, "anneal_learning_rate": False}
_PAPER_OFF_POLICY = {**_ONE_EPISODE, **_PLAIN_LEARNING, "critic_sees_time": False}

# "paper" is supplement table 2 (MAPPO) or 3 (MADDPG, QMIX), and the MAPPO paper's defaults where these are silent.
_PAPER_MAPPO = {"num_envs": 128, "num_minibatches": 1, **_PLAIN_LEARNING, "anneal_entropy": False, "clip_value": True}
_PAPER_ACTOR = {"actor_learning_rate": 7e-4, "actor_actions": "own", "output_penalty": 0.0}
_PAPER_COPIES: Sections = {"network": _GRU, "prior": {**_QUARTER_TURN, "replay": "stored"}}
PRESETS: dict[str, dict[str, Sections]] = {
    "mappo": {
        "default": {},
        "paper": {"mappo": {**_PAPER_MAPPO, "value_decay": 0.99999}, "network": _GRU, "prior": _QUARTER_TURN},
    },
    "maddpg": {
        "default": {"network": {"activation": "relu"}},
        "paper": {"maddpg": {**_PAPER_OFF_POLICY, **_PAPER_ACTOR}, **_PAPER_COPIES},
    },
    "qmix": {
        "default": {"network": {"activation": "relu"}},
        "paper": {"qmix": {**_PAPER_OFF_POLICY, "critic_input": "state"}, **_PAPER_COPIES},
    },
}

_TURNS: dict[str, object] = {"transforms": "c4"}
# Episodes of formation are twelve times as long as those of the particle tasks, and rows of wildlife are pictures, so
# batch and replay hold fewer of them.
_LONG: dict[str, object] = {"updates_per_episode": 4, "batch_episodes": 4, "replay_episodes": 80}
_PICTURES: dict[str, object] = {"batch_episodes": 8, "replay_episodes": 200, "epsilon_steps": 20_000}

TUNED: dict[str, dict[str, Sections]] = {
    "mappo": {
        # All worlds are in lockstep, so a rollout has to span an episode. In the last seconds of an episode all robots
        # rest, and the normalised advantages of these seconds alone are noise.
        "formation": {
            "mappo": {"num_envs": 8, "num_steps": 300, "num_epochs": 5, "num_minibatches": 8}
            | {"gae_lambda": 0.98, "entropy_coef": 0.003, "critic_input": "own"},
            "network": {"activation": "relu"},
            "prior": _TURNS,
            "evaluation": {"every_steps": 100_000},
        },
        "wildlife": {
            "mappo": {"num_envs": 64, "num_steps": 16, "num_epochs": 4, "num_minibatches": 2, "critic_input": "own"},
            "network": {"name": "mpn", "activation": "relu"},
            "prior": _TURNS,
        },
        # A robot that shakes falls, so noise has to shrink before it can walk, but not at once.
        "quadruped": {
            "mappo": {"num_envs": 256, "num_steps": 24, "num_epochs": 5, "entropy_coef": 0.003},
            "network": {"activation": "relu"},
            "evaluation": {"every_steps": 50_000},
        },
    },
    "maddpg": {
        # The robots are slow and their actions bounded. Without strong noise, and a penalty that keeps the outputs off
        # the bounds, the replay holds too few steering actions for the critic to value them.
        "formation": {
            "maddpg": {**_LONG, "td_lambda": 0.9, "epsilon_finish": 0.4}
            | {"actor_actions": "own", "output_penalty": 0.05},
            "prior": _TURNS,
            "evaluation": {"every_steps": 50_000},
        },
        # The critic sees all pictures. The actor's gradient is the expected one, with a larger penalty: with the
        # state's coordinates and the gradient of a draw, the actor becomes nearly deterministic before the critic is
        # accurate.
        "wildlife": {
            "maddpg": {**_PICTURES, "learning_rate": 2e-3, "actor_learning_rate": 2e-3}
            | {"actor_gradient": "expected", "output_penalty": 0.01},
            "network": {"name": "mpn"},
            "prior": _TURNS,
        },
    },
    "qmix": {
        # One value per wheel speed learns faster than one per pair of speeds.
        "formation": {
            "qmix": {**_LONG, "learning_rate": 2e-3},
            "network": {"separate_parts": True},
            "prior": _TURNS,
            "evaluation": {"every_steps": 50_000},
        },
        # With few and recent episodes the plain learner memorises them; with 5000 both learners end higher.
        "predator-prey": {"qmix": {"replay_episodes": 5000}},
        "wildlife": {
            "qmix": {**_PICTURES, "learning_rate": 2e-3, "critic_input": "state"},
            "network": {"name": "mpn"},
            "prior": _TURNS,
        },
    },
}

# Acting takes a tenth of the time of ten epochs, so more worlds and fewer passes over what they bring save seconds.
# What this loses per step, a larger rate and a nearer horizon bring back.
_FEWER_PASSES: dict[str, object] = {"num_envs": 128, "num_epochs": 5, "num_minibatches": 5, "learning_rate": 4e-3}
_ON_PARTICLES: Sections = {"mappo": {**_FEWER_PASSES, "gamma": 0.95, "gae_lambda": 0.9}}
FAST: dict[str, dict[str, Sections]] = {"mappo": {"navigation": _ON_PARTICLES, "predator-prey": _ON_PARTICLES}}

# A network over sets learns each landmark and each agent once, not for every order of them.
_SETS: Sections = {"network": {"name": "set"}}
SETS: dict[str, dict[str, Sections]] = {
    "mappo": {"navigation": {"mappo": {**_ON_PARTICLES["mappo"], "critic_input": "state"}, **_SETS}},
    "maddpg": {"navigation": _SETS},
    "qmix": {"navigation": _SETS},
}

# what a task changes in the preset `paper`, whose recurrent MAPPO needs whole episodes
PAPER: dict[str, dict[str, Sections]] = {"mappo": {"formation": {"mappo": {"num_steps": 300}}}}


def preset_layers(task: str, algorithm: str, preset: str, network: object = None) -> list[Sections]:
    """Return a preset's settings on a task, layer by layer, for the user's network; a later one has the last word."""
    presets, fast = PRESETS.get(algorithm, {"default": {}}), FAST.get(algorithm, {})
    sets = SETS.get(algorithm, {}).get(task, {})
    if preset == "paper" or network not in (None, sets.get("network", {}).get("name")):
        sets = {}
    if preset == "fast" and fast:
        if task not in fast:
            raise UserError(f"{algorithm} has no preset 'fast' for {task}; it has one for {', '.join(fast)}")
        return [presets["default"], TUNED.get(algorithm, {}).get(task, {}), fast[task], sets]
    if preset not in presets:
        raise UserError(f"{algorithm} has no preset '{preset}'; it has {', '.join([*presets, *['fast'][: len(fast)]])}")
    of_task = {"default": TUNED, "paper": PAPER}.get(preset, {})
    return [presets[preset], of_task.get(algorithm, {}).get(task, {}), sets]
