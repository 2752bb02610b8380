"""Bundle the best seed of a run: python docs/bundle_policy.py RUN NAME writes it into checkpoints/ and its manifest."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

from esp_cli.defaults import EPISODES, __version__
from esp_cli.policies.bundled import MANIFEST, MANIFEST_FORMAT, Entry, Score, bundled_folder, read_bundled
from esp_cli.policies.evaluation import best_seed, evaluate, play_references
from esp_cli.policies.loading import TrainedPolicy, open_policy
from esp_cli.policies.statistics import normalised
from esp_cli.training.checkpoint import POLICY_FORMAT, describe_policy, save_checkpoint

SCALE = (0,)  # seeds of the episodes of reference policies, the same for all policies of a task


def bundle(trained: TrainedPolicy, name: str, folder: Path, episodes: int = EPISODES) -> Entry:
    """Write the best seed's policy, evaluated on episodes that did not select it; an entry of that name is replaced."""
    config = trained.config
    own = trained.single_seed(best_seed(trained, episodes))
    found = evaluate(own, episodes)
    spread = found.over_episodes["greedy"]
    score = Score.model_validate({"mean": found.greedy.mean, "episodes": episodes, **vars(spread)})
    anchors = play_references(config.model_copy(update={"seeds": SCALE}), found.heuristics, episodes)
    scaled = normalised(score.mean, {key: float(played.returns.mean()) for key, played in anchors.items()})
    file = folder / f"{name}.safetensors"
    folder.mkdir(parents=True, exist_ok=True)
    described = describe_policy(own.config, own.spec, own.step, [score.mean])
    save_checkpoint(file, own.policy.state_dict(), described, POLICY_FORMAT)
    entry = Entry(
        name=name,
        file=file.name,
        sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        task=config.task,
        task_version=own.spec.version,
        convention=own.spec.convention,
        algorithm=config.algorithm,
        prior=config.prior.kind,
        seed=own.config.seeds[0],
        chosen_from=len(config.seeds),
        step=own.step,
        score=score,
        normalised=None if scaled is None else round(float(scaled), 4),
        metrics={name: value for name, value in found.metrics.items() if value is not None},
        command=config.command(),
        esp_version=__version__,
        config=config.model_dump(mode="json"),
    )
    entries = sorted([e for e in read_bundled(folder) if e.name != name] + [entry], key=lambda e: e.name)
    MANIFEST_FORMAT.write(folder / MANIFEST, {"policies": [e.model_dump(mode="json") for e in entries]})
    return entry


if __name__ == "__main__":
    made = bundle(open_policy(Path(sys.argv[1])), sys.argv[2], bundled_folder())
    print(f"{made.name}: seed {made.seed} of {made.chosen_from}, return {made.score.mean:.2f}")
