"""MADDPG and QMIX on the tasks whose best policy is known: found, sooner with a true symmetry, not with a false one."""

import pytest
import torch
from torch import Tensor

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.networks.plain import MlpConfig
from esp_cli.prior.config import PriorConfig
from esp_cli.training.build import PolicyController, generators, stream_seeds
from tests.learning.pointing import SEEDS, AlwaysRight, Pointing, score

ROUNDS = 40
LOOK_EVERY = 10
RATES = {"learning_rate": 3e-3, "actor_learning_rate": 3e-3, "anneal_learning_rate": False}
SETTINGS = {"num_envs": 8, "gamma": 0.0, "epsilon_steps": 1000, **RATES}
"""An iteration is eight episodes of four steps; gamma 0, as the next target does not depend on the action."""


def learn(algorithm: str, task: type[Pointing], rounds: int = ROUNDS, **prior: object) -> list[Tensor]:
    """Return the greedy return [S] over the optimum of untrained policies and then every few iterations."""
    cls = ALGORITHMS[algorithm]
    learner = cls(
        task(8, stream_seeds(SEEDS, "training worlds")),
        cls.config_class(**{name: value for name, value in SETTINGS.items() if name in cls.config_class.model_fields}),
        MlpConfig(hidden=(32,), activation="relu"),
        PriorConfig.model_validate(prior),
        generators(SEEDS, "learner"),
        generators(SEEDS, "prior"),
    )
    shares = [score(task, PolicyController(learner.policy))]
    for k in range(1, rounds + 1):
        learner.iterate(k / rounds)
        if k % LOOK_EVERY == 0:
            shares.append(score(task, PolicyController(learner.policy)))
    return shares


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_the_answer_is_found_and_sooner_with_the_prior(algorithm: str) -> None:
    plain = learn(algorithm, Pointing, kind="none")
    assert plain[0].max() < 0.5
    assert plain[-1].min() > 0.9
    esp = learn(algorithm, Pointing, kind="esp", transforms="d4")
    assert esp[-1].min() > 0.9
    early = slice(1, 4)
    assert (torch.stack(esp[early]).mean(0) > torch.stack(plain[early]).mean(0)).all(), "of each seed"


@pytest.mark.parametrize("algorithm", ["maddpg", "qmix"])
def test_a_false_symmetry_hurts(algorithm: str) -> None:
    """A policy that keeps the symmetry chooses 'right' for a quarter of the targets.

    MADDPG's actor is held to it by S_pi; QMIX's S_Q asks it of the team's value alone, so less is lost there.
    """
    without = learn(algorithm, AlwaysRight, 20, kind="none")
    forced = learn(algorithm, AlwaysRight, 20, kind="esp", transforms="d4", consistency_coef=10.0)
    assert without[-1].min() > 0.95
    assert forced[-1].max() < {"maddpg": 0.5, "qmix": 0.85}[algorithm]
