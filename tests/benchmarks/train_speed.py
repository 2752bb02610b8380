"""Measure how fast learners train on navigation, and what share of the machine's own matrix rate MAPPO has.

    python tests/benchmarks/train_speed.py [--cases 'qmix*' ...] [--seeds 10 1] [--threads 2] [--device cuda]
                                           [--json speed.json]

A seed-step is one environment step of one seed. MADDPG and QMIX take one gradient step on 32 episodes per collected
episode. MAPPO's floating-point work is counted, not guessed: the matrix products of actor and critic, forward and
backward, in the rollout and in all epochs (a product with an [in, out] matrix is 2 in out operations a row; backward
costs it once more for the weight and, behind the first layer, once for the input). The machine's matrix rate is
measured in the same process on the largest product of an update. Each figure is the median of several iterations
(collect and update) after a warm-up; where other programs use the machine, look at the most.
"""

import argparse
import json
import statistics
import time
from fnmatch import fnmatch
from pathlib import Path

from esp_cli import machine

machine.prepare()  # as `esp` does, before torch is imported

import torch
from rich.console import Console
from rich.table import Table

from esp_cli.algorithms.learner import Learner
from esp_cli.algorithms.mappo import Mappo
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config

PEER_LAYOUT: dict[str, object] = {
    "mappo.num_envs": 128,
    "mappo.num_minibatches": 1,
    "mappo.num_epochs": 10,
    "network.activation": "relu",
}
"""128 worlds x 25 steps, 10 epochs x 1 minibatch, MLP 64-64: the layout in which MAPPO implementations are compared."""
MLP: dict[str, object] = {"network.name": "mlp"}
PLAIN: dict[str, object] = MLP | {"prior.kind": "none"}
BFLOAT16: dict[str, object] = MLP | {"network.precision": "bfloat16"}
GRU: dict[str, object] = {"network.name": "gru"}
STATE: dict[str, object] = PLAIN | {"mappo.critic_input": "state", "network.compiled": True}
SET: dict[str, object] = STATE | {"network.name": "set"}
EIGHT: dict[str, object] = {"task.num_agents": 8}
NEAR: dict[str, object] = SET | {"mappo.critic_input": "own", "task.density": 8, "task.sees": 8}
"""Agents that see the eight nearest; CROWDS of them are as many agents in all worlds together."""
CROWDS = (16, 100, 1000)
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "mappo 128 x 25, 10 x 1, plain": ("mappo", PEER_LAYOUT | PLAIN),
    "mappo 128 x 25, 10 x 1, plain, bfloat16": ("mappo", PEER_LAYOUT | PLAIN | BFLOAT16),
    "mappo default, plain": ("mappo", PLAIN),
    "mappo default, esp": ("mappo", MLP),
    "mappo default, esp, bfloat16": ("mappo", BFLOAT16),
    "mappo compiled, 3 agents": ("mappo", STATE),
    "mappo set, 3 agents": ("mappo", SET),
    "mappo compiled, 8 agents": ("mappo", STATE | EIGHT),
    "mappo set, 8 agents": ("mappo", SET | EIGHT),
    **{
        f"mappo set, nearest 8 of {agents} agents": (
            "mappo",
            NEAR | {"task.num_agents": agents, "mappo.num_envs": round(1000 / agents)},
        )
        for agents in CROWDS
    },
    "maddpg, plain": ("maddpg", PLAIN),
    "maddpg, esp": ("maddpg", MLP),
    "qmix, plain": ("qmix", PLAIN),
    "qmix, esp": ("qmix", MLP),
    "qmix gru, plain": ("qmix", PLAIN | GRU),
    "qmix gru, esp": ("qmix", GRU),
}
WARM_UP = 2
"""Iterations that do not count; MADDPG and QMIX explore at random in a part of the first."""


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


def timed(
    algorithm: str, overrides: dict[str, object], seeds: int, iterations: int, device: str
) -> tuple[Learner, list[float]]:
    config = resolve_config("navigation", algorithm, seeds=range(seeds), overrides=overrides, device=device)
    learner = build_learner(config)
    for _ in range(WARM_UP):
        learner.iterate(0.0).finite.tolist()
    times = []
    for _ in range(iterations):
        begin = time.perf_counter()
        learner.iterate(0.0).finite.tolist()  # until a GPU has computed it
        times.append(time.perf_counter() - begin)
    return learner, [seeds * learner.steps_per_iteration / seconds for seconds in times]


def measure(name: str, seeds: int, iterations: int, device: str) -> dict[str, object]:
    algorithm, overrides = CASES[name]
    learner, rates = timed(algorithm, overrides, seeds, iterations, device)
    record: dict[str, object] = {
        "case": name,
        "seeds": seeds,
        "seed_steps_per_second": statistics.median(rates),
        "microseconds_per_agent_step": 1e6 / statistics.median(rates) / learner.spec.num_agents,
        "most": max(rates),
    }
    if isinstance(learner, Mappo) and hasattr(learner.policy.actor, "layers"):
        work = flops_per_step(learner)
        rows = learner.config.chunk_steps // seeds * learner.spec.num_agents
        rate = matrix_rate(seeds, rows, str(overrides.get("network.precision", "float32")), device)
        record |= {
            "mflop_per_step": work / 1e6,
            "machine_gflops": rate / 1e9,
            "share_of_matrix_rate": statistics.median(rates) * work / rate,
        }
    return record


COLUMNS = {
    "seeds": ("seeds", ",d"),
    "seed_steps_per_second": ("seed-steps/s (median)", ",.0f"),
    "most": ("most", ",.0f"),
    "microseconds_per_agent_step": ("us/agent-step", ",.1f"),
    "mflop_per_step": ("MFLOP/step", ".2f"),
    "machine_gflops": ("machine GFLOP/s", ",.0f"),
    "share_of_matrix_rate": ("share", ".0%"),
}


def main() -> None:
    """Parse the command line, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", default=["*"], metavar="PATTERN", help="names, or patterns as 'qmix*'")
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 1], help="numbers of seeds")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--iterations", type=int, default=7)
    parser.add_argument("--json", type=Path, help="also write the records to this file")
    args = parser.parse_args()
    names = [name for name in CASES if any(fnmatch(name, pattern) for pattern in args.cases)]
    if not names:
        parser.error(f"no case has such a name; the cases are: {'; '.join(CASES)}")
    torch.set_num_threads(args.threads)
    where = f"{args.threads} thread(s)" if args.device == "cpu" else args.device
    table = Table("case", title=f"Training on navigation, {where}")
    for heading, _ in COLUMNS.values():
        table.add_column(heading, justify="right")
    records = [measure(name, seeds, args.iterations, args.device) for name in names for seeds in args.seeds]
    for record in records:
        shown = [format(record[key], form) if key in record else "" for key, (_, form) in COLUMNS.items()]
        table.add_row(str(record["case"]), *shown)
    Console(width=140).print(table)
    if args.json:
        content = {"device": args.device, "threads": args.threads, "records": records}
        args.json.write_text(json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
