"""`esp check`: is a task, a mirror of a robot, or a policy as symmetric as it should be?"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from typer import Argument, Option

from esp_cli import console
from esp_cli.commands import options
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.checking import ElementVerdict, PolicyVerdict, SymmetryReport
    from esp_cli.policies.loading import TrainedPolicy
    from esp_envs.conformance import Finding
    from esp_envs.promises import MakeWorlds
    from esp_envs.spec import TaskSpec

EPILOG = """Examples:\n
    esp check task rendezvous:Rendezvous\n
    esp check symmetry navigation --set task.actions=continuous\n
    esp check symmetry rendezvous:Rendezvous --transforms d8*agents --json symmetry.json\n
    esp check mirror my_symmetry:compute_symmetric_states robot.xml --order joints.txt\n
    esp check policy policy.onnx robot.xml --order my_robot:numbers"""

_SYMMETRY = "actions and layouts can carry the declared symmetry"
_ROUNDING = 1e-4  # how far a step from a restored state may differ: physics may be finer than the float32 of states


def check(
    what: Annotated[
        Literal["task", "symmetry", "mirror", "policy"],
        Argument(help="What to check.", metavar="task|symmetry|mirror|policy"),
    ],
    task: Annotated[
        str,
        Argument(
            help="A task that `esp tasks` lists, or module:Class; a mirror as module:function; a policy as ONNX, "
            "TorchScript or module:function.",
            metavar="NAME",
        ),
    ],
    robot: Annotated[
        Path | None, Argument(help="Its MJCF or URDF file, of a mirror or a policy.", metavar="ROBOT.xml")
    ] = None,
    transforms: Annotated[
        str | None, Option("--transforms", help="Elements to try, as d8*agents; by default many.")
    ] = None,
    settings: options.TaskSetOption = None,
    policy: Annotated[
        Path | None, Option("--policy", help="Also measure how symmetric this policy is.", metavar="RUN|POLICY")
    ] = None,
    algo: options.OwnAlgoOption = None,
    network: options.OwnNetworkOption = None,
    order: options.OrderOption = None,
    rows: Annotated[
        Path | None, Option("--rows", help="Observations that a policy meets [M, D].", metavar="FILE.npy")
    ] = None,
    root: options.RootOption = None,
    seconds: options.SecondsOption = 100.0,
    json: options.JsonOption = None,
) -> None:
    """Check a task, its declared symmetry, a robot's mirror that you wrote, or whether a policy turns with its robot.

    Symmetry is tested per element and field: it holds, is broken, or is not covered (no data could have shown a
    breaking). Of a mirror each number is compared with what the model proves. Exit code 0: all that is promised or
    declared holds; 1: something is broken; 2: something is not covered. A policy's distance is measured, not judged.
    """
    if what in ("mirror", "policy"):
        if any((settings, transforms, policy, algo, network)):
            raise UserError("--set, --transforms, --policy, --algo and --network belong to tasks; leave them out")
        from esp_cli.commands.mirror import check_robot

        raise typer.Exit(check_robot(what, task, robot, root, order, rows, seconds, json))
    if any((robot, root, order, rows)):
        raise UserError("a model, --root, --order and --rows belong to 'esp check mirror|policy'; leave them out")
    from esp_cli.training.config import resolve_task_settings
    from esp_envs.registry import make

    if what == "task" and any((transforms, policy, algo, network)):
        names = "--transforms, --policy, --algo and --network"
        raise UserError(f"{names} belong to 'esp check symmetry'; leave them out")
    options.register_named([task], algo, network)
    asked = options.parse_task_settings(settings or [])
    chosen = resolve_task_settings(task, asked)
    options.note_idle_settings(task, asked, chosen)
    make_worlds = partial(make, task, settings=chosen)
    spec = make_worlds(1, [0]).spec  # a mistake in task or settings is the user's, not a broken promise
    if what == "task":
        code = _check_task(task, spec, make_worlds, seconds, json)
    elif spec.roles:
        if policy is not None:
            raise UserError(f"{task} has roles, of whose policies nothing is measured here; leave --policy out")
        options.refuse_unused([], None, algo, network)
        code = _check_roles(spec, make_worlds, transforms, seconds, json)
    else:
        code = _check_symmetry(make_worlds, transforms, _opened(policy, algo, network), seconds, json)
    if code:
        raise typer.Exit(code)


def _check_task(task: str, spec: TaskSpec, make_worlds: MakeWorlds, seconds: float, json: str | None) -> int:
    from esp_envs.conformance import PROMISES, Subject, check

    findings = [_of_the_symmetry(role, bool(spec.roles)) for role, _ in spec.parts]
    subject = Subject(make_worlds, rounding=_ROUNDING, deadline=time.monotonic() + seconds)
    with console.watching("check", "promises") as watch:
        for done, finding in enumerate(check(subject), 1):
            findings.append(finding)
            watch(done, len(PROMISES))
    rows = [(f.promise, *_result(f)) for f in findings]
    late = [f.promise for f in findings if f.not_covered]
    title = f"What {task} promises as a task"
    console.result(json, findings, lambda: console.table(("promise", "result", "what happens"), rows, title=title))
    if late:
        console.note(f"{len(late)} of {len(rows)} promises were not looked at to their end; give more by --seconds")
    return 1 if any(finding.broken for finding in findings) else 2 * bool(late)


def _result(finding: Finding) -> tuple[str, str]:
    results = {"broken": finding.broken, "not covered": finding.not_covered, "-": finding.not_asked, "holds": ""}
    return next((result, told) for result, told in results.items() if told is not None)


def _of_the_symmetry(spec: TaskSpec, of_role: bool = False) -> Finding:
    """Return whether actions and layouts can carry what a task declares; `esp check symmetry` asks whether it holds."""
    from esp_cli.symmetry import admit_declared
    from esp_envs.conformance import Finding

    said = f"{_SYMMETRY}: {spec.name}" if of_role else _SYMMETRY
    try:
        admit_declared(spec)
    except ValueError as error:
        return Finding(said, broken=str(error))
    return Finding(said, not_asked=None if _declares(spec) else "none is declared")


def _declares(spec: TaskSpec) -> bool:
    return spec.symmetry != "c1" or bool(spec.nearly)


def _check_roles(
    spec: TaskSpec, make_worlds: MakeWorlds, transforms: str | None, seconds: float, json: str | None
) -> int:
    """Check the symmetry of each role, while all others act at random."""
    from esp_cli.checking import check_symmetry
    from esp_cli.checking.candidates import NothingToTry
    from esp_envs.roles import without_agents
    from esp_envs.views import worlds_of_role

    reports, until = {}, time.monotonic() + seconds
    for left, role in zip(range(len(spec.roles), 0, -1), spec.roles, strict=True):
        asked = transforms if transforms is None or role.num_agents > 1 else without_agents(transforms)
        if asked == "":
            continue
        try:
            with console.watching("check", "elements") as watch:
                make = worlds_of_role(make_worlds, role.name)
                rest = until - time.monotonic()
                reports[role.name] = check_symmetry(make, asked, watch=watch, seconds=rest, spare=rest / (2 * left - 1))
        except NothingToTry as told:
            if asked is not None or _declares(role):
                raise
            console.note(str(told))
    if transforms is not None and not reports:
        raise NothingToTry(f"no transform can be tried on {spec.name}: '{transforms}' moves no agent of any role")

    def show() -> None:
        for report in reports.values():
            _print(report, [])

    console.result(json, {name: {"report": report, "holds": report.holds} for name, report in reports.items()}, show)
    return 1 if any(r.broken for r in reports.values()) else 2 * any(r.uncovered for r in reports.values())


def _opened(where: Path | None, algo: list[str] | None, network: list[str] | None) -> TrainedPolicy | None:
    from esp_cli.policies.loading import open_policy

    policy = None if where is None else open_policy(where)
    options.refuse_unused([] if policy is None else [policy.config], None, algo, network)
    return policy


def _check_symmetry(
    make_worlds: MakeWorlds, transforms: str | None, policy: TrainedPolicy | None, seconds: float, json: str | None
) -> int:
    from esp_cli.checking import check_policy, check_symmetry
    from esp_cli.checking.candidates import NothingToTry

    measured = [] if policy is None else check_policy(policy, make_worlds, transforms)
    try:
        with console.watching("check", "elements") as watch:
            report = check_symmetry(make_worlds, transforms, watch=watch, seconds=seconds)
    except NothingToTry as told:
        spec, why = make_worlds(1, [0]).spec, str(told)
        if policy is not None or transforms is not None or _declares(spec):
            raise
        said = f"{why}; the task declares no symmetry either, so all that is declared holds"
        console.result(json, {"report": None, "holds": True, "policy": []}, lambda: console.say(said))
        return 0
    found = {"report": report, "holds": report.holds, "policy": measured}
    console.result(json, found, lambda: _print(report, measured))
    return 1 if report.broken else 2 if report.uncovered else 0


def _print(report: SymmetryReport, measured: Sequence[PolicyVerdict]) -> None:
    print_elements(report, f"declared {report.declared}, found {report.found}")
    if unseen := [e.element for e in report.elements if e.element in report.uncovered and not e.reason]:
        missing = (
            "more episodes, or a task that can be set to a state" if report.method == "transitions" else "other states"
        )
        console.note(
            f"declared, but not covered: {', '.join(unseen)}; what was seen could not have shown a breaking "
            f"of them, {missing} might"
        )
    if measured:
        _print_policy(measured)


def _print_policy(measured: Sequence[PolicyVerdict]) -> None:
    from esp_cli.checking.policy import CLOSE

    columns: tuple[str, ...] = ("element", "same greedy action>")
    caption = "share of agents and states in which the greedy action is the transformed one"
    if any(m.distance is not None for m in measured):
        columns = ("element", f"greedy action within {CLOSE:g}>", "distance>")
        caption += f" within {CLOSE:g} in every number; distance: 0 where it is that, 1 as of unrelated states"
    rows = [(m.element, f"{m.agreement:.3f}", f"{m.distance or 0:.3g}")[: len(columns)] for m in measured]
    console.table(columns, rows, title="Symmetry of the policy", caption=caption)


def print_elements(report: SymmetryReport, found: str) -> None:
    """Print what was found of each element."""
    from esp_cli.checking.task import TOLERATED
    from esp_cli.checking.verdicts import LATE

    tried = [(e, str(e.outcome), f"{e.p_value:.1g}") for e in report.elements]
    told = [*tried, *((e, "not tried", "") for e in report.refused)]
    rows = [(e.element, "yes" if e.declared else "no", result, p, _where(e)) for e, result, p in told]
    caption = (
        "gaps and standard errors in standard deviations of the field; p: how likely so small a gap is where a field "
        f"is off by {TOLERATED[report.method]} or more"
    )
    if late := sum(element.reason == LATE for element in report.elements):
        console.note(f"{late} of {len(rows)} elements were not tried, as the time was over; give more by --seconds")
    title = f"{report.task} by {report.method}: {found}"
    console.table(("element", "declared", "result", "p>", "where"), rows, title=title, caption=caption)


def _where(element: ElementVerdict) -> str:
    if element.reason:
        return element.reason
    fields = [field for field in element.fields if field.outcome == element.outcome]
    if element.outcome == "not covered":
        return ", ".join(field.field for field in fields)
    shown = fields if element.outcome == "broken" else [field for field in (element.worst,) if field]
    return ", ".join(
        f"{f.field} {f.gap:.3f} ± {f.error:.3f}" + (f" (in {f.share:.2%} of the states)" if f.share > 0 else "")
        for f in shown
    )
