"""`esp compare-homomorphic`: symmetry in the network against symmetry in the data and the loss."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from esp_cli import console
from esp_cli.commands.options import SeedsOption, SetOption, StepsOption, parse_assignments
from esp_cli.commands.train import train_folder

EPILOG = """Examples:\n
    esp compare-homomorphic\n
    esp compare-homomorphic --contestants mpn,empn --steps 100k --seeds 3 --out runs/quick\n
    esp compare-homomorphic --grid 9 --drones 4 --group d4"""

DEFAULT_STEPS = 200_000
DEFAULT_SEEDS = tuple(range(10))


def compare_homomorphic(
    steps: StepsOption = DEFAULT_STEPS,
    seeds: SeedsOption = DEFAULT_SEEDS,
    drones: Annotated[int, typer.Option("--drones", min=2, help="N, drones.")] = 3,
    grid: Annotated[int, typer.Option("--grid", min=3, help="Cells along each side, an odd number.")] = 7,
    contestants: Annotated[
        str, typer.Option("--contestants", help="Which of mpn, mpn-esp, empn, mpn-ensemble, in this order.")
    ] = "mpn,mpn-esp,empn,mpn-ensemble",
    group: Annotated[str, typer.Option("--group", help="The symmetry in question: c4 or d4.")] = "c4",
    mode: Annotated[
        Literal["greedy", "stochastic"], typer.Option("--mode", help="Which evaluations to compare.")
    ] = "stochastic",
    threshold: Annotated[float, typer.Option("--threshold", help="State when this return is first reached.")] = 2.0,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder of runs, picture and JSON; an unfinished one is continued.")
    ] = Path("runs/homomorphic"),
    settings: SetOption = None,
) -> None:
    """Train standard, ESP, equivariant and averaged message passing networks on wildlife, and compare them (Fig. 6b).

    The same command goes on where it was stopped.
    """
    from esp_cli.reporting import homomorphic

    names = [name.strip() for name in contestants.split(",") if name.strip()]
    configs = homomorphic.plan(names, steps, seeds, drones, grid, group, parse_assignments(settings or []))
    folders = {name: homomorphic.prepare(out / name, config) for name, config in configs.items()}
    for folder in folders.values():
        train_folder(folder, tensorboard=False)
    result, files = homomorphic.report(folders, mode, threshold, out / "curves")
    _print(result)
    console.write_json(out / "comparison.json", result)
    console.note(f"curves -> {files[0]}, {files[1]}; numbers -> {out / 'comparison.json'}")


def _print(result: dict[str, Any]) -> None:
    rows = []
    for run in result["runs"]:
        ((step, final),) = run["returns"].items()
        area = run["area_under_curve"]
        passed = run["steps_to"][str(result["threshold"])]["mean"]
        rows.append(
            (
                run["label"],
                *_cells(final),
                *_cells(area),
                console.format_count(passed) if passed is not None else "-",
                console.format_count(run["parameters"]["policy"]),
                console.format_count(run["flops_per_action"]),
                console.format_duration(run["seconds"]),
                run["paper"] if run["paper"] is not None else "-",
            )
        )
    returns = ("contestant", "return>", "95 % interval>", "mean over the run>", "95 % interval>")
    costs = (f"steps to {result['threshold']:g}>", "weights>", "FLOPs an action>", "time>", "paper>")
    title = (
        f"{result['task']} version {result['task_version']} after {console.format_count(int(step))} steps, "
        f"{len(result['runs'][0]['seeds'])} seed(s), {result['mode']} policy"
    )
    caption = f"convention {result['convention']}; mean ± s.e.m. over seeds; weights and FLOPs of the policy"
    console.table((*returns, *costs), rows, title=title, caption=caption)


def _cells(verdict: dict[str, Any] | None) -> tuple[str, str]:
    """Return mean and interval as text."""
    if verdict is None or verdict["mean"] is None:
        return "-", "-"
    interval = console.format_interval(verdict["ci95"]) if verdict["ci95"] else "-"
    return console.format_mean(verdict["mean"], verdict["sem"]), interval
