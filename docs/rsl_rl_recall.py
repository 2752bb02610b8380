"""Does a recurrent policy of rsl_rl learn faster with mirrored histories?

    python docs/rsl_rl_recall.py  # writes docs/measured/rsl-rl-recall.json

A body of two joints sees a cue in the first of 8 steps, and is paid in the last 4 for joints at a function of it. The
mirror changes the cue's sign and exchanges the joints with a sign. Needs rsl-rl-lib.
"""

from __future__ import annotations

import json
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import RNNModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from esp_cli import Body, Field, Kind, layout
from esp_cli.bodies.emitting import mirror_of
from esp_cli.loop.rsl_rl import MirroredPPO

RECORD = Path(__file__).parent / "measured" / "rsl-rl-recall.json"
ENVS, STEPS, HORIZON, UPDATES, SEEDS = 16, 24, 8, 80, 5
GROUPS = {"actor": ["policy"], "critic": ["policy"]}
SETTINGS = {"num_learning_epochs": 4, "num_mini_batches": 2, "learning_rate": 1e-3, "entropy_coef": 0.002}
SETTINGS |= {"gamma": 0.9, "lam": 0.9}


def recall_mirror() -> ModuleType:
    """Return the mirror of the observations and actions."""
    body = Body(["left", "right"], {"left": "-right"})
    seen = layout(Field("cue", Kind.PSEUDOSCALAR), Field("clock", Kind.SCALAR), body.positions())
    return mirror_of(body, {"policy": seen, "action": layout(body.positions())})


def target(cue: torch.Tensor) -> torch.Tensor:
    """Return where the joints should be, [envs, 2]."""
    return torch.stack([torch.sin(3 * cue + 0.6), -torch.sin(-3 * cue + 0.6)], -1)


def learner(mirror: ModuleType | None) -> PPO:
    """Return PPO with a GRU, and with a mirror where one is given."""
    obs = TensorDict({"policy": torch.zeros(ENVS, 4)}, batch_size=[ENVS])
    shape = {"hidden_dims": [32], "rnn_type": "gru", "rnn_hidden_dim": 32}
    gauss = {"class_name": "GaussianDistribution", "init_std": 0.5}
    models = (
        RNNModel(obs, GROUPS, "actor", 2, distribution_cfg=gauss, **shape),
        RNNModel(obs, GROUPS, "critic", 1, **shape),
    )
    storage = RolloutStorage("rl", ENVS, STEPS, obs, [2])
    return (
        PPO(*models, storage, **SETTINGS)
        if mirror is None
        else MirroredPPO(*models, storage, mirror=mirror, **SETTINGS)
    )


def returns(mirror: ModuleType | None, seed: int) -> list[float]:
    """Train; return the mean return of the episodes of each rollout, with the noise of exploration."""
    torch.manual_seed(seed)
    ppo, noise = learner(mirror), torch.Generator().manual_seed(1000 + seed)
    cue, step, curve = torch.rand(ENVS, generator=noise) * 2 - 1, 0, []

    def obs() -> TensorDict:
        row = torch.randn(ENVS, 4, generator=noise) * 0.1
        row[:, 0], row[:, 1] = cue * (step == 0), step / HORIZON
        return TensorDict({"policy": row}, batch_size=[ENVS])

    for _ in range(UPDATES):
        paid = 0.0
        for _ in range(STEPS):
            with torch.inference_mode():
                reward = -(ppo.act(obs()) - target(cue)).square().sum(-1) * (step >= HORIZON // 2)
                paid += reward.mean().item()
                step = (step + 1) % HORIZON
                if step == 0:
                    cue = torch.rand(ENVS, generator=noise) * 2 - 1
                ppo.process_env_step(obs(), reward, torch.full((ENVS,), step == 0), {})
        with torch.inference_mode():
            ppo.compute_returns(obs())
        ppo.update()
        curve.append(paid * HORIZON / STEPS)
    return curve


def main() -> None:
    """Write the mean return of the last ten rollouts, and of rollouts 11 to 20, by seed."""
    found = {}
    for name, mirror in (("plain", None), ("mirrored", recall_mirror())):
        curves = [returns(mirror, seed) for seed in range(SEEDS)]
        found[name] = {"early": [sum(c[10:20]) / 10 for c in curves], "late": [sum(c[-10:]) / 10 for c in curves]}
        print(name, {when: [round(x, 3) for x in values] for when, values in found[name].items()}, flush=True)
    sizes = {"envs": ENVS, "steps": STEPS, "updates": UPDATES, "seeds": SEEDS}
    written = {"command": "python docs/rsl_rl_recall.py", "rsl-rl-lib": version("rsl-rl-lib"), **sizes, **found}
    RECORD.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
