"""Tiny runs of everything that can be trained, how they are trained, and what they leave."""

import hashlib
import itertools
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from esp_cli import app
from esp_cli.training import trainer
from esp_cli.training.checkpoint import load_checkpoint
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.metrics import read_metrics
from esp_cli.training.run_folder import RunFolder
from esp_envs.registry import register

OWN_TASK = "tests.envs.test_parallel_task:Walking"
"""A PettingZoo environment; its copies are stepped here or in worker processes."""
Choice = tuple[str, str, str, dict[str, object]]
"""Algorithm, network, task and settings of the task."""


def all_configs() -> dict[str, RunConfig]:
    """Return tiny runs of every learner, network, task, engine and kind of action that go together."""
    found: dict[str, RunConfig] = {}
    for algorithm, network, task, chosen in _choices():
        settings: dict[str, object] = {"network.name": network, "network.hidden": [8], "evaluation.episodes": 2}
        settings |= {"evaluation.every_steps": 20, "task.horizon": 5, f"{algorithm}.num_envs": 2}
        if algorithm == "mappo":
            settings |= {"mappo.num_steps": 5, "mappo.num_epochs": 1, "mappo.num_minibatches": 1}
        else:
            settings |= {f"{algorithm}.warmup_episodes": 2, f"{algorithm}.replay_episodes": 64}
            settings |= {f"{algorithm}.batch_episodes": 2}
        settings |= {f"task.{name}": value for name, value in chosen.items()}
        settings |= {"network.width": 8} if network.startswith("set") else {}
        try:
            config = resolve_config(task, algorithm, steps=60, seeds=(0, 1), overrides=settings)
            trainer.build_learner(config)
        except ValueError:
            continue  # they do not go together
        if config not in found.values():
            found[f"{algorithm} {network} {task} {' '.join(map(str, chosen.values()))}"] = config
    return found


def _choices() -> Iterator[Choice]:
    learners = list(itertools.product(("mappo", "maddpg", "qmix"), ("mlp", "gru")))
    for algorithm, network in learners:
        for task in ("navigation", "predator-prey", "formation", "wildlife"):
            for actions in ({}, {"actions": "discrete"}, {"actions": "continuous"}):
                yield algorithm, network, task, dict(actions)
                if task == "formation":
                    for physics in ("mujoco", "mujoco-3d", "pymunk"):
                        yield algorithm, network, task, {**actions, "physics": physics}
    for algorithm, network in itertools.product(("mappo", "maddpg", "qmix"), ("set", "set-equivariant")):
        yield algorithm, network, "navigation", {}
        yield algorithm, network, "navigation", {"num_agents": 20, "sees": 3, "density": 8.0}
    for algorithm, network in learners:
        yield algorithm, network, "predator-prey", {"control": "both"}
    for network in ("mpn", "empn", "equivariant"):
        yield "mappo", network, "navigation", {}
    if find_spec("gymnasium"):
        register(OWN_TASK)
        for (algorithm, network), workers in itertools.product(learners, (0, 2)):
            if algorithm != "mappo":  # resumed, its rollouts begin new episodes
                yield algorithm, network, OWN_TASK, {"workers": workers}


def run_job(path: Path, config: RunConfig) -> None:
    trainer.CHECKPOINT_SECONDS = trainer.CHECKPOINT_SPACING = 0
    if not (path / "config.json").exists():
        RunFolder.create(path, config.model_dump(mode="json"))
    app.app(["train", "--resume", str(path)])


def newest_step(path: Path) -> int:
    names = [file.name for file in (path / "checkpoints").glob("step-*.safetensors")]
    return max((int(name[5:17]) for name in names), default=-1)


def run_state(path: Path) -> str:
    """Return a digest of what a run leaves: policy, last checkpoint, and metrics without times."""
    digest = hashlib.sha256((path / "policy.safetensors").read_bytes())
    files = sorted((path / "checkpoints").iterdir())
    digest.update(str([file.name for file in files]).encode())
    for file in files:
        tensors, meta = load_checkpoint(file)
        for name in sorted(tensors):
            digest.update(name.encode() + tensors[name].numpy().tobytes())
        told = sorted((key, value) for key, value in meta.items() if key not in ("elapsed_s", "run_id"))
        digest.update(str(told).encode())
    for row in read_metrics(path / "metrics.jsonl"):
        digest.update(repr([(key, value) for key, value in row.items() if not key.startswith("time/")]).encode())
    digest.update(str(sorted(entry.name for entry in path.iterdir() if entry.name not in ("log.txt",))).encode())
    return digest.hexdigest()
