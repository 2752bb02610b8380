"""JaxMARL's MAPPO on its simple_spread, with JaxMARL's own settings and 25 steps an episode.

The packages need an environment of their own; the learner is in JaxMARL's repository, not in its package:

    python3 -m venv jax && jax/bin/pip install jaxmarl==0.2.0 jax==0.10.2 jaxlib==0.10.2 flax==0.12.8 optax==0.2.8 \
        distrax==0.1.9 gymnax==1.0.1 numpy==2.4.6 hydra-core==1.3.8
    git clone https://github.com/FLAIROx/JaxMARL && git -C JaxMARL checkout c793d095618c6d3edfb5632802348f57b70a4b94
    OMP_NUM_THREADS=1 jax/bin/python tests/benchmarks/peers/jaxmarl_spread.py --checkout JaxMARL --frames 300000 \
        --seeds 0 --json spread.json

The settings are those of baselines/MAPPO/config/mappo_homogenous_rnn_mpe.yaml, except for the number of frames, over
which the learning rate falls to zero. Seconds include compilation. spread.py says what the file holds. Goes on where it
was when started again.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

os.environ["JAX_PLATFORMS"] = "cpu"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import jax.experimental
import numpy as np
from omegaconf import OmegaConf
from spread import Row, add_missing, summarise

NUM_STEPS = 25


def run(checkout: Path, seed: int, frames: int) -> list[Row]:
    """Train once; return the rows."""
    begun, rows = time.perf_counter(), list[Row]()
    folder = checkout / "baselines" / "MAPPO"
    sys.path.insert(0, str(folder))
    sys.modules.setdefault("wandb", mock.MagicMock())  # the learner logs there
    learner: ModuleType = importlib.import_module("mappo_rnn_mpe")
    config: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(folder / "config/mappo_homogenous_rnn_mpe.yaml"))
    # an episode of JaxMARL takes one step more than its setting says
    config |= {"TOTAL_TIMESTEPS": frames, "ENV_KWARGS": {"max_steps": NUM_STEPS - 1}}
    train = learner.make_train(config)

    def keep(metric: dict[str, Any]) -> None:
        ended = np.asarray(metric["returned_episode"], bool)
        lengths = np.asarray(metric["returned_episode_lengths"])[ended]
        assert (lengths == NUM_STEPS).all(), lengths
        # JaxMARL logs the reward of each agent times the number of agents
        agents = config["NUM_ACTORS"] // config["NUM_ENVS"]
        returns = np.asarray(metric["returned_episode_returns"])[ended].mean() / agents
        done = (int(metric["update_steps"]) + 1) * config["NUM_ENVS"] * config["NUM_STEPS"]
        rows.append((done, time.perf_counter() - begun, float(returns)))

    log = jax.experimental.io_callback
    with mock.patch.object(jax.experimental, "io_callback", lambda _, shapes, metric: log(keep, shapes, metric)):
        compiled = jax.jit(train).lower(jax.random.PRNGKey(seed)).compile()
    print(f"compiled after {time.perf_counter() - begun:.1f} s", flush=True)
    jax.block_until_ready(compiled(jax.random.PRNGKey(seed)))
    jax.effects_barrier()
    return sorted(rows)


def main() -> None:
    """Run the seeds that are missing in the file, and print how each run ends."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkout", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=300_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--json", type=Path, default=Path("spread.json"))
    given = parser.parse_args()
    wanted = {f"JaxMARL, seed {k}": partial(run, given.checkout, k, given.frames) for k in given.seeds}
    add_missing(given.json, wanted)
    summarise(given.json)


if __name__ == "__main__":
    main()
