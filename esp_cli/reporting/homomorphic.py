"""Figure 6b: symmetry built into the network, learned by the prior, or averaged in, on wildlife monitoring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from esp_cli.reporting.curves import Mode, RunCurve, compare, plot, read_curve
from esp_cli.training.build import build_environment, build_learner
from esp_cli.training.config import RunConfig, resolve_config
from esp_cli.training.run_folder import RunFolder

TASK = "wildlife"
CONTESTANTS: dict[str, dict[str, object]] = {
    "mpn": {"network.name": "mpn", "prior.kind": "none"},
    "mpn-esp": {"network.name": "mpn", "prior.kind": "esp"},
    "empn": {"network.name": "empn", "prior.kind": "none"},
    "mpn-ensemble": {"network.name": "mpn", "prior.kind": "none"},
}
"""The standard network, the same with the prior, the equivariant one, and the standard one averaged over the group."""
PAPER = {"mpn": 2.1, "empn": 2.25, "mpn-esp": 2.4}
"""Where the curves of the paper's figure 6b end, read off."""
_GROUP = {"mpn-esp": "prior.transforms", "empn": "network.group", "mpn-ensemble": "network.symmetrise"}
"""The setting by which a contestant is told the group."""


def plan(
    contestants: Sequence[str],
    steps: int,
    seeds: Sequence[int],
    drones: int,
    grid: int,
    group: str,
    overrides: Mapping[str, object],
) -> dict[str, RunConfig]:
    """Return what each contestant runs; they differ in network and prior alone.

    Args:
        contestants: of `CONTESTANTS`.
        steps: environment steps per seed.
        seeds: run seeds, the same for all.
        drones: N.
        grid: cells along each side.
        group: whose symmetry is built in, learned or averaged.
        overrides: dotted names to values, for all contestants.

    Raises:
        ValueError: an unknown or repeated contestant, a setting that tells them apart, or settings that do not fit.
    """
    unknown = [name for name in contestants if name not in CONTESTANTS]
    if unknown or len(set(contestants)) < len(contestants) or not contestants:
        raise ValueError(f"name each contestant once; they are {', '.join(CONTESTANTS)}")
    own = {name for settings in CONTESTANTS.values() for name in settings} | set(_GROUP.values())
    for name in overrides:
        if name in own:
            raise ValueError(f"--set {name} is what tells the contestants apart; leave it out")
    common = {"task.num_agents": drones, "task.width": grid, "task.height": grid, **overrides}
    configs = {}
    for name in contestants:
        told = {_GROUP[name]: group} if name in _GROUP else {}
        configs[name] = resolve_config(
            TASK, steps=steps, seeds=seeds, overrides={**common, **CONTESTANTS[name], **told}
        )
        build_learner(configs[name].model_copy(update={"seeds": configs[name].seeds[:1]}))
    return configs


def prepare(path: Path, config: RunConfig) -> RunFolder:
    """Make the run folder of a contestant, or open the one that is there to go on with.

    Raises:
        ValueError: it holds another run.
    """
    if not (path / "config.json").is_file():
        return RunFolder.create(path, config.model_dump(mode="json"))
    folder = RunFolder.open(path)
    if RunConfig.model_validate(folder.config) != config:
        raise ValueError(f"{path} holds a run of other settings; repeat them to go on, or choose another --out")
    return folder


def report(
    folders: Mapping[str, RunFolder], mode: Mode, threshold: float, picture: Path
) -> tuple[dict[str, Any], tuple[Path, Path]]:
    """Compare what the contestants have learned, and draw their curves beside the ends of the paper's.

    Args:
        folders: of the runs, by contestant; the others are held against the first.
        mode: which evaluations.
        threshold: return whose first passing is stated.
        picture: where to.

    Returns:
        A JSON-able dict, that of `compare` with parameters, work and the paper's number of each contestant; and the
        PNG and the SVG file.
    """
    curves = [read_curve(folder.path, name, mode) for name, folder in folders.items()]
    result = compare(curves, [], [threshold])
    for entry, curve in zip(result["runs"], curves, strict=True):
        entry |= {"paper": PAPER.get(curve.label), **_size(curve)}
    lines = {f"paper {name}": value for name, value in PAPER.items() if name in folders}
    files = plot(curves, picture, result["convention"], mode, lines)
    return {"mode": mode, "threshold": threshold, **result}, files


def _size(curve: RunCurve) -> dict[str, Any]:
    learner = build_learner(curve.config.model_copy(update={"seeds": curve.config.seeds[:1], "device": "cpu"}))
    counts = {name: sum(p.numel() for p in learner.modules[name].parameters()) for name in ("policy", "critic")}
    return {"parameters": counts, "flops_per_action": flops_per_action(curve.config)}


@torch.no_grad()
def flops_per_action(config: RunConfig) -> float:
    """Count the floating-point operations of matrix products by which a trained policy chooses one agent's action.

    What is done once for any number of observations, as putting constrained weights together, does not count; nor
    that equal pictures need to be encoded only once.
    """
    config = config.model_copy(update={"seeds": config.seeds[:1], "device": "cpu"})
    policy = build_learner(config).policy
    worlds = 16  # lots of pictures, so that no odd number is rounded up
    counts = []
    for number in (worlds, 2 * worlds):
        obs = torch.randn_like(build_environment(config, number, "shape").reset().obs)
        with FlopCounterMode(display=False) as counter:
            policy.act(obs, policy.initial_memory(number, obs))
        counts.append(counter.get_total_flops())
    return (counts[1] - counts[0]) / (worlds * policy.num_agents)
