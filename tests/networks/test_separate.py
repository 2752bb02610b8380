"""Values of actions as sums over their parts."""

import pytest
import torch

from esp_cli.networks.exploration import EpsilonGreedy
from esp_cli.networks.plain import MlpConfig
from esp_cli.networks.policy import HistoryPolicy
from esp_cli.networks.symmetrised import action_parts
from esp_cli.symmetry import mirror
from esp_cli.symmetry.transforms import build_transform
from esp_envs.registry import make
from esp_envs.spec import Discrete, Kind

PAIRS = Discrete(Kind.WHEELS, ((-1.0, 0.5), (-1.0, 1.0), (1.0, 0.5), (1.0, 1.0)), ("a", "b", "c", "d"))


def generators():
    return [torch.Generator().manual_seed(seed) for seed in (0, 1)]


def formation():
    return make("formation", 2, [0], {"actions": "discrete", "num_agents": 2}).spec


def test_parts_by_hand():
    """Left -1, left 1, right 0.5, right 1 in rows; the four pairs in columns."""
    expected = [[1, 1, 0, 0], [0, 0, 1, 1], [1, 0, 1, 0], [0, 1, 0, 1]]
    torch.testing.assert_close(action_parts(PAIRS), torch.tensor(expected, dtype=torch.float32))


def test_a_pair_is_worth_the_sum_of_its_wheels():
    spec = formation()
    config = MlpConfig(hidden=(8,), separate_parts=True)
    policy = HistoryPolicy(spec, config, generators(), EpsilonGreedy(spec.action, 2), 1.0)
    assert policy.actor.network.layers[-1].weight.shape == (2, 8, 22), "eleven speeds of each wheel"
    obs = torch.randn(2, 3, 2, spec.observation.width)
    values, _ = policy.step(obs, policy.initial_memory(3, obs))
    table = values.unflatten(-1, (11, 11))  # [..., left, right]
    mixed = table[..., 3, 7] + table[..., 0, 0] - table[..., 3, 0] - table[..., 0, 7]
    torch.testing.assert_close(mixed, torch.zeros_like(mixed), rtol=0, atol=1e-5)
    assert table.std() > 0.1


def test_a_mirror_swaps_the_wheels_of_the_sums_too():
    """What the transform makes of the sums is again a sum of parts; of any table of 121 values it is not."""
    spec = formation()
    across = build_transform([mirror()], spec)
    parts = action_parts(spec.action)
    moved = across.pull_back(parts.view(1, 22, 1, 121).expand(-1, -1, 2, -1))[0, :, 0]
    swapped = torch.cat([parts[11:], parts[:11]])
    torch.testing.assert_close(moved, swapped)


def test_actions_without_parts_are_refused():
    spec = make("navigation", 2, [0]).spec
    with pytest.raises(ValueError, match="separate_parts is for discrete actions that are all combinations"):
        action_parts(spec.action)
    continuous = make("formation", 2, [0]).spec
    with pytest.raises(ValueError, match="separate_parts is for discrete actions"):
        action_parts(continuous.action)
    with pytest.raises(ValueError, match="separate_parts and symmetrise exclude each other"):
        MlpConfig(separate_parts=True, symmetrise="c4")
