"""MAPPO on tasks whose best policy is known: it is found, sooner with a true symmetry, and not with a false one."""

from operator import methodcaller

import pytest
import torch
from torch import Tensor

from esp_cli.algorithms.mappo import Mappo, MappoConfig
from esp_cli.networks.plain import MlpConfig
from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import transform_set
from esp_cli.training.build import PolicyController, ScriptedController, generators, stream_seeds
from tests.learning.pointing import HORIZON, SEEDS, AlwaysRight, Pointing, iterations_to, score

ITERATIONS = 20


def learn(task: type[Pointing], **prior: object) -> list[Tensor]:
    """Return the greedy return [S] of untrained policies, and after each iteration of 256 steps, over the optimum."""
    learner = Mappo(
        task(32, stream_seeds(SEEDS, "training worlds")),
        # gamma 0: the next target does not depend on the action
        MappoConfig(num_steps=2 * HORIZON, num_epochs=6, learning_rate=5e-3, gamma=0.0),
        MlpConfig(hidden=(32,)),
        PriorConfig.model_validate(prior),
        generators(SEEDS, "learner"),
        generators(SEEDS, "prior"),
    )
    shares = [score(task, PolicyController(learner.policy))]
    for k in range(ITERATIONS):
        learner.iterate(k / ITERATIONS)
        shares.append(score(task, PolicyController(learner.policy)))
    return shares


@pytest.fixture(scope="module")
def plain() -> list[Tensor]:
    return learn(Pointing, kind="none")


def test_the_answer_is_known_and_far_from_chance():
    assert score(Pointing, ScriptedController(methodcaller("heuristic"))).tolist() == [1.0, 1.0]
    assert score(Pointing, ScriptedController(methodcaller("random_action"))).tolist() == pytest.approx(
        [0.25, 0.25], abs=0.03
    )


def test_the_best_action_turns_with_the_target_and_the_false_task_breaks_that():
    observation = Pointing(100, list(SEEDS)).reset()
    for task, holds in ((Pointing, True), (AlwaysRight, False)):
        env = task(100, list(SEEDS))
        env.set_state(observation.state)
        best = env.best()
        agreed = []
        for g in transform_set("d4", env.spec).each():
            env.set_state(g.state(observation.state.unsqueeze(2)).squeeze(2))
            agreed.append(torch.equal(env.best(), g.action(best.unsqueeze(2)).squeeze(2)))
        assert all(agreed) is holds


def test_plain_mappo_finds_the_answer_within_a_few_thousand_steps(plain):
    assert plain[0].max() < 0.5
    assert plain[-1].min() > 0.95


def test_the_prior_finds_it_too_and_sooner(plain):
    esp = learn(Pointing, kind="esp", transforms="d4")
    assert esp[-1].min() > 0.95
    assert iterations_to(esp, 0.95) < iterations_to(plain, 0.95)
    early = slice(1, 6)
    shortfall, plain_shortfall = (1 - torch.stack(curve[early]).mean(0) for curve in (esp, plain))
    assert (shortfall < 0.75 * plain_shortfall).all(), "of each seed"


def test_a_false_symmetry_hurts():
    """A policy that keeps the symmetry chooses 'right' for a quarter of the targets, however long it learns."""
    without = learn(AlwaysRight, kind="none")
    forced = learn(AlwaysRight, kind="esp", transforms="d4", consistency_coef=10.0)
    assert without[-1].min() > 0.95
    assert forced[-1].max() < 0.5
