"""What the prior costs inside TorchRL: `SymmetricLoss` against the plain loss on as many rows, in alternating pairs.

python tests/benchmarks/symmetric_loss.py
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from esp_cli import Continuous, Field, Kind, Symmetry, layout
from esp_cli.loop.torchrl import SymmetricLoss

SEEN = layout(Field("vectors", Kind.VECTOR, 3), Field("lidar", Kind.RING, rays=12))
FORCE = Continuous(layout(Field("force", Kind.VECTOR)))
AGENTS, ROWS, HIDDEN, PAIRS = 3, 400, 256, 40
"""The agents, minibatch and hidden widths of BenchMARL's MAPPO on VMAS navigation."""


def perceptron(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, HIDDEN), nn.Tanh(), nn.Linear(HIDDEN, outputs)
    )


def build() -> ClipPPOLoss:
    keys = {"loc": ("agents", "loc"), "scale": ("agents", "scale")}
    body = nn.Sequential(perceptron(SEEN.width, 4), NormalParamExtractor())
    net = TensorDictModule(body, [("agents", "observation")], list(keys.values()))
    actor = ProbabilisticActor(net, keys, [("agents", "action")], distribution_class=TanhNormal, return_log_prob=True)
    critic = TensorDictModule(perceptron(SEEN.width, 1), [("agents", "observation")], [("agents", "state_value")])
    loss = ClipPPOLoss(actor, critic, normalize_advantage=False)
    named = {name: ("agents", name) for name in ("action", "advantage", "value_target")}
    loss.set_keys(**named, value=("agents", "state_value"), sample_log_prob=("agents", "log_prob"))
    return loss


def rows(count: int) -> TensorDict:
    lead = (count, AGENTS)
    agents = {"observation": torch.randn(*lead, SEEN.width), "action": torch.rand(*lead, 2) - 0.5}
    agents |= {
        "log_prob": torch.randn(*lead),
        "advantage": torch.randn(*lead, 1),
        "value_target": torch.randn(*lead, 1),
    }
    return TensorDict({"agents": agents}, [count])


def seconds(loss: Any, data: TensorDict) -> float:
    begun = time.process_time()
    losses = loss(data.clone(False))
    (losses["loss_objective"] + losses["loss_critic"]).backward()
    return time.process_time() - begun


def main() -> None:
    """Print the overhead beyond the extra rows."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    plain = build()
    symmetry = Symmetry(observation=SEEN, action=FORCE, group="d4", num_agents=AGENTS)
    prior, single, double = SymmetricLoss(plain, symmetry), rows(ROWS), rows(2 * ROWS)
    ratios, growth = [], []
    for pair in range(PAIRS):
        with_prior, on_double, on_single = seconds(prior, single), seconds(plain, double), seconds(plain, single)
        if pair >= 5:  # warm
            ratios.append(with_prior / on_double)
            growth.append(with_prior / on_single)
    overhead = statistics.median(ratios) - 1
    print(f"prior on {ROWS} rows / plain loss on {2 * ROWS} rows: {1 + overhead:.3f} ({overhead:+.1%})")
    print(f"prior on {ROWS} rows / plain loss on {ROWS} rows: {statistics.median(growth):.2f}")


if __name__ == "__main__":
    main()
