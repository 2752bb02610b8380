"""Does the prior make legged robots learn faster, and walk alike to both sides? Tuned alike, five seeds by default.

    python tests/benchmarks/gaits.py --out runs/gaits [--tasks ant humanoid quadruped]
                                     [--steps 2M ant=500k] [--budget 12] [--seeds 5] [--jobs 2]
                                     [--json gaits.json] [--plot gaits.png]

For each task `esp tune --prior esp,none` searches settings for both on equal steps, and trains the best beside the
default ones on seeds of their own. After any kill, the same command goes on. The gait's left-right difference is that
between the distributions of each joint's position and of the mirrored position of its image, over greedy episodes:
Wasserstein's distance in standard deviations, averaged over the joints. 0 is the same gait to both sides.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import numpy as np
from matplotlib import pyplot as plt
from scipy.stats import wasserstein_distance

from esp_cli import Run, load_policy
from esp_cli.symmetry.parse import parse_elements
from esp_cli.symmetry.transforms import build_transform
from esp_envs import make

EPISODES = 8


def difference(run: Run, seed: int, episodes: int = EPISODES) -> float:
    """Return the gait's left-right difference of one seed's policy."""
    policy, settings = load_policy(run.path, seed=seed), run.config.task_settings
    env = make(run.config.task, episodes, [1000 + seed], settings)
    transform = build_transform(parse_elements("flip-x", 1), env.spec)
    places = env.spec.observation.slices()["positions"]
    rows, seen = [], env.reset()
    for _ in range(env.spec.horizon):
        rows.append(seen.obs[0, :, 0])
        action = policy.act(seen.obs[0].numpy())
        seen = env.step(seen.obs.new_tensor(action)[None]).next
    states = np.stack(rows)
    images = transform.obs(seen.obs.new_tensor(states)[:, :, None])[:, :, 0].numpy()
    own, other = (x[..., places].reshape(-1, places.stop - places.start) for x in (states, images))
    scale = own.std(0).clip(1e-6)
    return float(np.mean([wasserstein_distance(a, b) for a, b in zip((own / scale).T, (other / scale).T, strict=True)]))


def measured(path: Path) -> dict[str, object]:
    """Return what a run came to: its curve [evaluations, seeds] and the gait of each seed."""
    run = Run(path)
    metrics, seeds = run.metrics, run.config.seeds
    returns = np.array(metrics["eval/return_greedy"], float)
    kept = ~np.isnan(returns).all(1)
    return {
        "prior": run.config.prior.kind,
        "steps": np.array(metrics.steps)[kept].tolist(),
        "returns": returns[kept].round(2).tolist(),
        "difference": [round(difference(run, seed), 4) for seed in seeds],
    }


def draw(found: dict[str, dict[str, dict]], path: Path) -> None:
    figure, axes = plt.subplots(2, len(found), figsize=(4 * len(found), 6), squeeze=False, layout="constrained")
    for (task, runs), (above, below) in zip(found.items(), axes.T, strict=True):
        names = [
            ("without" if run["prior"] == "none" else "with the prior") + ", tuned" * ("tuned" in name)
            for name, run in runs.items()
        ]
        for k, (name, run) in enumerate(zip(names, runs.values(), strict=True)):
            returns = np.array(run["returns"])
            mean, half = returns.mean(1), 1.96 * returns.std(1, ddof=1) / returns.shape[1] ** 0.5
            steps = np.array(run["steps"]) / 1000
            (line,) = above.plot(steps, mean, label=name)
            above.fill_between(steps, mean - half, mean + half, alpha=0.2)
            below.plot(run["difference"], [k] * len(run["difference"]), "o", color=line.get_color())
        above.set(title=task, xlabel="thousand environment steps per seed", ylabel="greedy return")
        above.legend()
        below.set(yticks=range(len(runs)), yticklabels=names, xlabel="left-right difference of the gait")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Tune, train, measure and draw."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=["ant", "humanoid", "quadruped"])
    parser.add_argument("--steps", nargs="+", default=["2M"], help="per seed of all tasks, and of one, as ant=500k")
    parser.add_argument("--budget", default="12")
    parser.add_argument("--seeds", default="5")
    parser.add_argument("--jobs", default="1", help="runs side by side")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--set", action="append", default=[])
    chosen = parser.parse_args()
    found: dict[str, dict[str, dict]] = {}
    of_task = dict(one.split("=") for one in chosen.steps if "=" in one)
    of_all = next((one for one in chosen.steps if "=" not in one), "2M")
    for task in chosen.tasks:
        words = ["--task", task, "--algo", "mappo", "--prior", "esp,none", "--steps", of_task.get(task, of_all)]
        words += ["--budget", chosen.budget, "--seeds", chosen.seeds, "--jobs", chosen.jobs]
        words += ["--out", str(chosen.out / task), "--episodes", str(EPISODES)]
        words += [word for one in chosen.set for word in ("--set", one)]
        subprocess.run([sys.executable, "-m", "esp_cli", "tune", *words], check=True)
        found[task] = {path.name: measured(path) for path in sorted((chosen.out / task / "fresh" / "runs").iterdir())}
        for name, run in found[task].items():
            print(f"{task} {name}: {np.mean(run['returns'][-1]):.1f}, difference {np.mean(run['difference']):.3f}")
        if chosen.json:
            chosen.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    if chosen.plot:
        draw(found, chosen.plot)


if __name__ == "__main__":
    main()
