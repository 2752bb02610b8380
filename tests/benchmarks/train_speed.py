"""Measure how fast MAPPO trains, and what share of the machine's own matrix rate that is.

    python tests/benchmarks/train_speed.py [--seeds 10 --seeds 1] [--threads 2] [--device cuda] [--json speed.json]

A seed-step is one environment step of one seed. The floating-point work is counted, not guessed: the matrix products of
actor and critic, forward and backward, in the rollout and in all epochs (a product with an [in, out] matrix is
2 in out operations a row; backward costs it once more for the weight and, behind the first layer, once for the input).
The machine's matrix rate is measured in the same process on the largest product of an update. Each figure is the median
of several iterations (collect and update) after a warm-up; where other programs use the machine, look at the most.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

from esp_cli import machine

machine.prepare()  # as `esp` does, before torch is imported

import torch
from rich.console import Console
from rich.table import Table

from esp_cli.algorithms.mappo import Mappo
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config

PEER_LAYOUT = {
    "mappo.num_envs": 128,
    "mappo.num_minibatches": 1,
    "mappo.num_epochs": 10,
    "network.activation": "relu",
}
"""128 worlds x 25 steps, 10 epochs x 1 minibatch, MLP 64-64: the layout in which MAPPO implementations are compared."""
CASES: dict[str, dict[str, object]] = {
    "128 x 25, 10 x 1, plain": PEER_LAYOUT | {"prior.kind": "none"},
    "128 x 25, 10 x 1, plain, bfloat16": PEER_LAYOUT | {"prior.kind": "none", "network.precision": "bfloat16"},
    "default, plain": {"prior.kind": "none"},
    "default, esp": {},
    "default, esp, bfloat16": {"network.precision": "bfloat16"},
}


def flops_per_step(learner: Mappo) -> float:
    """Count the operations of actor and critic per environment step of one seed."""
    config, agents = learner.config, learner.spec.num_agents
    work = 0.0
    for network, rows in ((learner.policy.actor, agents), (learner.critic.network, 1)):
        shapes = [layer.weight.shape[1:] for layer in network.layers]  # type: ignore[union-attr]
        products = [2.0 * shape[0] * shape[1] * rows for shape in shapes]
        backward = 2 * sum(products) - products[0]
        copies = 1 + learner.prior.num_copies
        work += sum(products) + config.num_epochs * copies * (sum(products) + backward)
    return work


def matrix_rate(seeds: int, rows: int, precision: str, device: str, repeats: int = 20) -> float:
    """Measure the operations per second of [seeds, rows, 64] x [seeds, 64, 64]."""
    kind = {"dtype": getattr(torch, precision), "device": device}
    a, b = torch.randn(seeds, rows, 64, **kind), torch.randn(seeds, 64, 64, **kind)
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        torch.bmm(a, b)
        if device == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - begin)
    return 2.0 * seeds * rows * 64 * 64 / min(times)


def measure(name: str, seeds: int, iterations: int, device: str) -> dict[str, object]:
    """Time `iterations` iterations of one case."""
    learner = build_learner(resolve_config("navigation", seeds=range(seeds), overrides=CASES[name], device=device))
    assert isinstance(learner, Mappo)
    learner.iterate(0.0).finite.tolist()
    times = []
    for _ in range(iterations):
        begin = time.perf_counter()
        learner.iterate(0.0).finite.tolist()  # until a GPU has computed it
        times.append(time.perf_counter() - begin)
    steps = seeds * learner.steps_per_iteration
    rates = [steps / seconds for seconds in times]
    work = flops_per_step(learner)
    precision = CASES[name].get("network.precision", "float32")
    rows = learner.config.chunk_steps // seeds * learner.spec.num_agents
    machine = matrix_rate(seeds, rows, str(precision), device)
    return {
        "case": name,
        "seeds": seeds,
        "seed_steps_per_second": statistics.median(rates),
        "most": max(rates),
        "mflop_per_step": work / 1e6,
        "machine_gflops": machine / 1e9,
        "share_of_matrix_rate": statistics.median(rates) * work / machine,
    }


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", action="append", choices=list(CASES), help="what to measure; by default all")
    parser.add_argument("--seeds", action="append", type=int, help="number of seeds; may be given several times")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--iterations", type=int, default=7)
    parser.add_argument("--json", type=Path, help="also write the records to this file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    where = f"{args.threads} thread(s)" if args.device == "cpu" else args.device
    table = Table(title=f"MAPPO on navigation, {where}")
    for heading in ("case", "seeds", "seed-steps/s (median)", "most", "MFLOP/step", "machine GFLOP/s", "share"):
        table.add_column(heading, justify="left" if heading == "case" else "right")
    records = []
    for name in args.case or CASES:
        for seeds in args.seeds or (10, 1):
            records.append(record := measure(name, seeds, args.iterations, args.device))
            numbers = [f"{float(str(record[key])):,.{digits}f}" for key, digits in COLUMNS]
            table.add_row(name, str(seeds), *numbers, f"{float(str(record['share_of_matrix_rate'])):.0%}")
    Console(width=140).print(table)
    if args.json:
        content = {"device": args.device, "threads": args.threads, "records": records}
        args.json.write_text(json.dumps(content, indent=2) + "\n")


COLUMNS = (("seed_steps_per_second", 0), ("most", 0), ("mflop_per_step", 2), ("machine_gflops", 0))

if __name__ == "__main__":
    main()
