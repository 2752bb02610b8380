"""`esp mirror`: which turns and mirrors is a robot's model symmetric under, and where do its joints go?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from esp_cli import console
from esp_cli.commands.options import ForceOption, JsonOption, OrderOption, RootOption, SecondsOption
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.bodies import Body
    from esp_cli.bodies.auditing import Copy
    from esp_cli.bodies.finding import Difference
    from esp_cli.bodies.numbers import Numbers
    from esp_cli.bodies.turning import Turning

EPILOG = """Examples:\n
    esp mirror robot.xml\n
    esp mirror robot.urdf --json mirror.json\n
    esp mirror robot.xml --order joints.txt --emit rsl_rl -o mirror.py\n
    esp check mirror symmetry:compute_symmetric_states robot.xml"""

_OF_A_JOINT = ("joint", "image", "sign", "gap", "planted")  # of `Body.rows`, as JSON has them
_NAMED = 6  # of sensors and others; the others are in the JSON
_SHOWN = 4  # elements that have a column in the table; the others are in the JSON


def mirror(
    model: Annotated[Path, Argument(help="An MJCF or URDF file.", metavar="MODEL")],
    root: RootOption = None,
    order: OrderOption = None,
    emit: Annotated[
        Literal["rsl_rl", "isaaclab", "mjlab", "skrl", "sb3", "numpy"] | None,
        Option("--emit", help="Write the mirror as a file for this loop.", metavar="HOST"),
    ] = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Path of that file.", metavar="FILE")] = None,
    seconds: SecondsOption = 50.0,
    force: ForceOption = False,
    json: JsonOption = None,
) -> None:
    """Find the mirrors and turns of a robot from its model, and prove them in MuJoCo.

    The robot faces x: flip-x is its left-right mirror, flip-y front-back. An element holds where accelerations of
    mirrored states are the mirrored accelerations. Exit code 0: it has a symmetry; 1: it has none.
    """
    from esp_cli.bodies import Body

    if (emit is None) != (out is None):
        raise UserError("--emit and -o belong together: esp mirror robot.xml --emit rsl_rl -o mirror.py")
    if out is not None and out.suffix != ".py":
        raise UserError(f"--emit writes Python, so the name {out} has to end in .py")
    if order is not None and emit is None:
        raise UserError("--order says what is in the file that --emit writes; add --emit, or leave --order out")
    if out is not None and not force and (taken := [path for path in (out, _proof_of(out)) if path.exists()]):
        raise UserError(f"{taken[0]} exists; choose another path, or add --force")
    body = Body.from_mjcf(model, root, seconds=seconds)
    if emit is not None and out is not None:
        _write(body, model, order, emit, out)
    if emit is None or json:
        console.result(json, described(body, model), lambda: _print(body, model))
    if not body.found:
        raise typer.Exit(1)


def described(body: Body, model: Path) -> dict[str, Any]:
    """Return what is known of a body as JSON takes it."""
    elements = {}
    for name, one in body.found.items():
        joints = [
            {**dict(zip(_OF_A_JOINT, row, strict=True)), "differs": d.what, "by": d.share, "differences": d.shares}
            for *row, d in body.rows(name)
        ]
        base = {} if one.base is None else {"base": one.base.shares}
        elements[name] = {**one.proof.summary, **base, "joints": joints}
    return {"model": str(model), "group": body.group, "elements": elements, "refused": body.refused}


def _write(body: Body, model: Path, order: str | None, host: str, out: Path) -> None:
    from esp_cli.bodies.emitting import HOSTS, emitted, proof
    from esp_cli.bodies.numbers import numbers_of
    from esp_cli.files.writing import write_file

    layouts = numbers_of(body, order)
    body = _carried(body, layouts)
    write_file(out, emitted(body, layouts, model.name).encode())
    write_file(_proof_of(out), proof(body, layouts, out.name).encode())
    groups = "; ".join(f"{name}: {layout.summary}" for name, layout in layouts.items())
    console.say(f"{out} has {HOSTS[host]} for {', '.join(body.found)}; {groups}")
    console.note(f"{_proof_of(out)} proves it, with numpy alone")
    for name in body.found:
        if unseen := body.unseen(name):
            console.note(f"{name} is not covered at {', '.join(unseen)}: a mistake would not show in accelerations")
    for name, reason in body.not_covered.items():
        console.note(f"it has no {name}, which is {reason}")
    if order is None:
        console.note(
            "the numbers are those of Isaac Lab's velocity tasks, joints in the model's order; --order says yours"
        )


def _carried(body: Body, numbers: Numbers) -> Body:
    """Return the body with the elements that all numbers carry, and name those that are left out."""
    from esp_cli.bodies.emitting import carried

    own = carried(body, numbers)
    if left := [element.name for element in body.elements if element not in own.elements]:
        console.note(f"left out, as not all numbers carry them: {', '.join(left)}")
    return own


def _proof_of(out: Path) -> Path:
    return out.with_name(f"test_{out.stem}.py")


def check_robot(
    what: str,
    name: str,
    model: Path | None,
    root: Path | None,
    order: str | None,
    rows: Path | None,
    seconds: float,
    json: str | None,
) -> int:
    """Check a mirror that somebody wrote, or how far a policy is from turning with its body."""
    from esp_cli.bodies import Body
    from esp_cli.bodies.auditing import audit
    from esp_cli.bodies.numbers import numbers_of
    from esp_cli.bodies.turning import policy_of, rows_of, turning
    from esp_envs.installed import import_function

    if model is None:
        raise UserError(f"name the robot's model too: esp check {what} {name} robot.xml")
    if rows is not None and what == "mirror":
        raise UserError("--rows are observations that a policy meets; leave them out")
    body = Body.from_mjcf(model, root, seconds=seconds)
    if not body.found:
        why = "".join(f" ({element}: {reason})" for element, reason in list(body.refused.items())[:1])
        raise UserError(f"{model} has no mirror or turn{why}, so {name} cannot be compared with one")
    numbers, found = numbers_of(body, order), {"model": str(model), "group": body.group}
    body = _carried(body, numbers)
    if what == "mirror":
        copies = audit(import_function(name), body, numbers)
        console.result(json, {**found, "copies": copies}, lambda: _print_audit(name, copies))
        return int(any(copy.wrong for copy in copies))
    measured = turning(policy_of(name), body, numbers, None if rows is None else rows_of(rows))
    console.result(json, {**found, "elements": measured}, lambda: _print_turning(name, measured))
    return 0


def _print_audit(name: str, copies: Sequence[Copy]) -> None:
    wrong = [(copy.element, *row) for copy in copies for row in copy.wrong]
    if not wrong:
        elements = [copy.element for copy in copies]
        console.say(f"{name} is right: its copies are {', '.join(elements)}")
        if again := [f"{element} {count} times" for element, count in Counter(elements).items() if count > 1]:
            console.say(f"but it returns {', '.join(again)}; once is enough")
        if copies[0].unseen:
            console.say(f"not compared: {', '.join(copies[0].unseen)}, of which it makes no copies")
        return
    console.say(f"{name} is wrong in {len(wrong)} numbers")
    for k, copy in enumerate(copies):
        if copy.wrong and not copy.is_involution:
            console.say(f"copy {k} ({copy.element}) does not undo itself")
    console.table(("element", "number", "takes", "right is"), wrong)


def _print_turning(name: str, measured: Sequence[Turning]) -> None:
    rows = [(one.element, f"{one.distance:.3g}", one.action, f"{one.worst:.3g}") for one in measured]
    caption = "0: the policy turns with the body; 1: as far apart as actions of unrelated states"
    console.table(("element", "distance>", "worst action", "its distance>"), rows, title=name, caption=caption)


def _print(body: Body, model: Path) -> None:
    from esp_cli.symmetry.plane import BODY_NAMES

    called = {name: name for name in (*body.found, *body.refused)}
    called |= {plain: f"{plain} ({word})" for word, plain in BODY_NAMES.items() if plain in called}
    nearly, blind = (
        ", ".join(name for name, one in body.found.items() if one.proof.verdict == verdict)
        for verdict in ("nearly", "broken sensors")
    )
    rest = f"but for asymmetries of the model itself ({nearly})" if nearly else "exactly" if not blind else ""
    rest += f"{' and ' if nearly else ''}but for its sensors ({blind})" if blind else ""
    holds = f"is symmetric under {body.group}, {rest}; {len(body.joints)} joints"
    none = f"has no mirror or turn that {'was found' if body.not_covered else 'its accelerations show'}"
    console.say(f"{model.name} {holds if body.found else none}")
    for name, one in body.found.items():
        console.say(f"{called[name]}: {one.proof}")
        if one.base is not None and _differs(one.base):
            console.say(f"  the base differs from its image: {_differs(one.base)}")
        if lost := [f"{sensor} ({one.proof.sensors[sensor]:.2g})" for sensor in one.proof.broken_sensors]:
            console.say(
                f"  no sensor is the image of {_some(lost)}; in brackets, how far off, as a share of its spread"
            )
        if one.proof.unlike:
            console.say(f"  differs from its image, though accelerations do not show it: {_some(one.proof.unlike)}")
        if one.proof.unjudged:
            console.say(f"  not judged: sensors of the kinds {', '.join(one.proof.unjudged)}")
        if unseen := body.unseen(name):
            console.say(f"  not covered: a mistake at {', '.join(unseen)} would not show in accelerations")
    for name, reason in body.refused.items():
        console.say(f"{called[name]} " + ("is " if name in body.not_covered else "does not hold: ") + reason)
    if not body.found:
        return
    shown = list(body.found)[:_SHOWN]
    rows = []
    for joints in zip(*(body.rows(name) for name in shown), strict=True):
        images = [("-" if sign < 0 else "") + image for _, image, sign, *_ in joints]
        worst = max(joints, key=lambda row: row[3])
        rows.append((worst[0], *images, f"{worst[3]:.1g}", _differs(worst[5])))
    caption = "gap: of the joint's accelerations, as a share of them; differs: what of the model is not its own image"
    console.table(("joint", *shown, "gap>", "differs"), rows, caption=caption)
    if len(body.found) > _SHOWN:
        console.note(f"--json has the tables of {', '.join(list(body.found)[_SHOWN:])} too")


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")


def _differs(difference: Difference) -> str:
    return f"{difference.what} {difference.share:.2%}" if difference.share >= 1e-4 else ""
