"""How symmetric a policy is, along its own episodes, and that a check of many elements leaves none of them out."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from esp_cli.checking import candidates, check_policy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.symmetry import FiniteGroup, parse_elements
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs.promises import MakeWorlds
from esp_envs.registry import make


def worlds(**settings: object) -> MakeWorlds:
    return lambda count, seeds: make("navigation", count, seeds, settings)


def untrained(**overrides: object) -> TrainedPolicy:
    names = {name.replace("__", "."): value for name, value in overrides.items()}
    config = resolve_config("navigation", seeds=[0, 1], overrides={"mappo.num_envs": 2, **names})
    learner = build_learner(config)
    return TrainedPolicy(config, learner.policy, learner.spec, 0, Path("run"))


class SymmetricAtFirst(torch.nn.Module):
    """Stays in the first step of an episode, and goes right from then on."""

    def initial_memory(self, count: int, obs: Tensor) -> int:
        return 0

    def act(self, obs: Tensor, memory: int, action_mask: Tensor | None = None) -> tuple[Tensor, int]:
        return torch.full(obs.shape[:-1], 2 if memory else 0), memory + 1


def agreements(trained: TrainedPolicy, transforms: str = "rot90,flip-x") -> dict[str, float]:
    return {one.element: one.agreement for one in check_policy(trained, worlds(), transforms)}


def test_an_equivariant_network_agrees_everywhere_and_a_plain_one_does_not() -> None:
    turned_by_c4 = agreements(untrained(network__name="equivariant", network__hidden=[8]))
    assert turned_by_c4["rot90"] == 1
    assert turned_by_c4["flip-x"] < 0.9
    assert max(agreements(untrained(network__hidden=[8])).values()) < 0.9


class GoesWhereItLooks(torch.nn.Module):
    """Continuous actions that are symmetric, but for a drift."""

    def __init__(self, drift: float) -> None:
        super().__init__()
        self.drift = drift

    def initial_memory(self, count: int, obs: Tensor) -> None:
        return None

    def act(self, obs: Tensor, memory: None, action_mask: Tensor | None = None) -> tuple[Tensor, None]:
        return obs[..., 2:4].clamp(-1, 1) + torch.tensor([self.drift, 0.0]), None


@pytest.mark.parametrize(("drift", "agreement", "apart"), [(0.0, 1.0, 0.0), (0.04, 1.0, None), (0.06, 0.0, None)])
def test_continuous_actions_agree_within_a_tenth_and_have_a_distance(drift, agreement, apart) -> None:
    trained = untrained(network__hidden=[8], task__actions="continuous")
    trained = TrainedPolicy(trained.config, GoesWhereItLooks(drift), trained.spec, 0, trained.source)
    (mirror,) = check_policy(trained, worlds(actions="continuous"), "flip-y,rot180")[:1]
    assert mirror.agreement == agreement, "a drift of x counts twice where x is mirrored"
    assert mirror.distance is not None
    assert mirror.distance == pytest.approx(0, abs=1e-6) if apart == 0 else 0 < mirror.distance < 0.5


def test_discrete_actions_have_no_distance() -> None:
    (verdict,) = check_policy(untrained(network__hidden=[8]), worlds(), "rot90")
    assert verdict.distance is None


def test_a_policy_that_remembers_is_judged_with_what_it_remembers() -> None:
    trained = untrained(network__hidden=[8])
    trained = TrainedPolicy(trained.config, SymmetricAtFirst(), trained.spec, 0, trained.source)
    assert agreements(trained)["rot90"] == pytest.approx(0.1)  # one of ten steps


def test_a_policy_with_a_compass_is_judged_in_worlds_with_one() -> None:
    assert set(agreements(untrained(prior__compass=1.0, network__hidden=[8]))) == {"rot90", "flip-x"}


def test_many_elements_are_tried_by_those_that_generate_them() -> None:
    spec = worlds(num_agents=5)(2, [0]).spec
    tried = candidates(spec, "d4*agents")
    assert len(tried) < 10
    assert set(parse_elements("d4*agents", 5)) < set(FiniteGroup.generated_by("tried", tried).elements)
    assert [len(candidates(spec, text)) for text in ("d4", "d4*agents-1-0-2-3-4")] == [7, 8]
    of_six = candidates(worlds(num_agents=6)(2, [0]).spec, "d4,agents")
    assert len(of_six) < 10, "though d4 and all orders of six generate more than can be listed"
