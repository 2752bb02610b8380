"""`esp check`: does a task keep what every task promises, and is it as symmetric as it declares?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from esp_cli import console
from esp_cli.commands.options import (
    JsonOption,
    OwnAlgoOption,
    OwnNetworkOption,
    TaskSetOption,
    parse_task_settings,
    register_named,
)
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.checking import PolicyVerdict, SymmetryReport
    from esp_envs import Environment
    from esp_envs.conformance import Finding
    from esp_envs.conformance.subject import MakeWorlds
    from esp_envs.spec import TaskSpec

EPILOG = """Examples:\n
    esp check task rendezvous:Rendezvous\n
    esp check symmetry navigation --set task.actions=continuous\n
    esp check symmetry rendezvous:Rendezvous --transforms d8*agents --json symmetry.json"""

_SYMMETRY = "actions and layouts can carry the declared symmetry"
_ROUNDING = 1e-4
"""How far a step from a restored state may differ: physics may be finer than the float32 of states."""


def check(
    what: Annotated[Literal["task", "symmetry"], typer.Argument(help="What to check.", metavar="task|symmetry")],
    task: Annotated[str, typer.Argument(help="Task: one that `esp tasks` lists, or module:Class.", metavar="TASK")],
    transforms: Annotated[
        str | None,
        typer.Option("--transforms", help="Elements to try, as d8*agents; by default many.", metavar="LIST"),
    ] = None,
    settings: TaskSetOption = None,
    policy: Annotated[
        Path | None, typer.Option("--policy", help="Also measure how symmetric this policy is.", metavar="RUN|POLICY")
    ] = None,
    algo: OwnAlgoOption = None,
    network: OwnNetworkOption = None,
    json: JsonOption = None,
) -> None:
    """Check what every task promises, or a task's declared symmetry; exit code 1 where something is broken.

    Symmetry is judged per element and field: it holds, it is broken, or the data does not cover it.
    """
    from esp_cli.training.config import resolve_task_settings
    from esp_envs.registry import make

    if what == "task" and any((transforms, policy, algo, network)):
        names = "--transforms, --policy, --algo and --network"
        raise UserError(f"{names} belong to 'esp check symmetry'; leave them out")
    register_named([task], algo, network)
    chosen = resolve_task_settings(task, parse_task_settings(settings or []))

    def make_worlds(num_envs: int, seeds: Sequence[int]) -> Environment:
        return make(task, num_envs, seeds, chosen)

    spec = make_worlds(1, [0]).spec  # a mistake in task or settings is the user's, not a broken promise
    if what == "task":
        holds = _check_task(task, spec, make_worlds, json)
    else:
        holds = _check_symmetry(make_worlds, transforms, policy, json)
    if not holds:
        raise typer.Exit(1)


def _check_task(task: str, spec: TaskSpec, make_worlds: MakeWorlds, json: str | None) -> bool:
    from esp_envs.conformance import Subject, check

    findings = [_of_the_symmetry(spec), *check(Subject(make_worlds, rounding=_ROUNDING))]
    rows = [(f.promise, "broken" if f.broken else "-" if f.not_asked else "holds", f.broken or f.not_asked or "")
            for f in findings]  # fmt: skip
    title = f"What {task} promises as a task"
    console.result(json, findings, lambda: console.table(("promise", "result", "what happens"), rows, title=title))
    return not any(finding.broken for finding in findings)


def _of_the_symmetry(spec: TaskSpec) -> Finding:
    """Return whether actions and layouts can carry what a task declares; `esp check symmetry` asks whether it holds."""
    from esp_cli.symmetry import admit_declared
    from esp_envs.conformance import Finding

    try:
        admit_declared(spec)
    except ValueError as error:
        return Finding(_SYMMETRY, broken=str(error))
    return Finding(_SYMMETRY, not_asked="none is declared" if spec.symmetry == "c1" and not spec.nearly else None)


def _check_symmetry(make_worlds: MakeWorlds, transforms: str | None, policy: Path | None, json: str | None) -> bool:
    from esp_cli.checking import check_policy, check_symmetry

    report = check_symmetry(make_worlds, transforms)
    measured: list[PolicyVerdict] = []
    if policy is not None:
        from esp_cli.policies.loading import open_policy

        measured = check_policy(open_policy(policy), make_worlds, transforms)
    found = {"report": report, "holds": report.holds, "policy": measured}
    console.result(json, found, lambda: _print(report, measured))
    return report.holds


def _print(report: SymmetryReport, measured: Sequence[PolicyVerdict]) -> None:
    rows: list[tuple[str, str, str, str]] = []
    for element in report.elements:
        worst = [f for f in element.fields if f.outcome == "broken"]
        gaps = ", ".join(f"{f.field} {f.gap:.3f} ± {f.error:.3f}" for f in worst)
        unseen = ", ".join(f.field for f in element.fields if f.outcome == "not covered")
        told = gaps or element.reason or (f"not covered: {unseen}" if unseen else "")
        rows.append((element.element, "yes" if element.declared else "no", element.outcome, told))
    title = f"{report.task} by {report.method}: declared {report.declared}, found {report.found}"
    caption = "gap and standard error in standard deviations of the field; found: as far as the visited states show"
    rows += [(name, "no", "not tried", told) for name, told in report.refused.items()]
    console.table(("element", "declared", "result", "where"), rows, title=title, caption=caption)
    if measured:
        agreeing = [(m.element, f"{m.agreement:.3f}") for m in measured]
        console.table(("element", "same greedy action>"), agreeing, title="Symmetry of the policy")
