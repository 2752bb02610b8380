"""`esp mirror`: which turns and mirrors is a robot's model symmetric under, and where do its joints go?"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from esp_cli import console
from esp_cli.commands.options import ForceOption, JsonOption
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.bodies import Body
    from esp_cli.bodies.asymmetry import Difference
    from esp_cli.bodies.auditing import Copy

EPILOG = """Examples:\n
    esp mirror robot.xml\n
    esp mirror robot.urdf --json mirror.json\n
    esp mirror robot.xml --order order.json --emit rsl_rl -o mirror.py\n
    esp mirror robot.xml --check symmetry:compute_symmetric_states"""

_SHOWN = 4
"""Elements that have a column in the table; the others are in the JSON."""


def mirror(
    model: Annotated[Path, typer.Argument(help="An MJCF or URDF file.", metavar="MODEL")],
    root: Annotated[
        Path | None, typer.Option("--root", help="Folder that holds all its files; by default its own.", metavar="DIR")
    ] = None,
    order: Annotated[
        Path | None,
        typer.Option("--order", help="JSON of joints, actions and observations, for the next two.", metavar="FILE"),
    ] = None,
    emit: Annotated[
        Literal["rsl_rl", "isaaclab", "mjlab", "skrl", "sb3", "numpy"] | None,
        typer.Option("--emit", help="Write the mirror as a file for this loop.", metavar="HOST"),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Path of that file.", metavar="FILE")] = None,
    check: Annotated[
        str | None, typer.Option("--check", help="Audit a mirror that you wrote.", metavar="module:function")
    ] = None,
    force: ForceOption = False,
    json: JsonOption = None,
) -> None:
    """Find the mirrors and turns of a robot from its model, and prove them in MuJoCo.

    The robot faces x: flip-x is its left-right mirror, flip-y front-back. An element holds where accelerations of
    mirrored states are the mirrored accelerations. Exit code 0: it has a symmetry, and what is checked is right; 1: it
    has none, or something is wrong.
    """
    from esp_cli.bodies import Body

    if (emit is None) != (out is None):
        raise UserError("--emit and -o belong together: esp mirror robot.xml --emit rsl_rl -o mirror.py")
    if out is not None and out.exists() and not force:
        raise UserError(f"{out} exists; choose another path, or add --force")
    body = Body.from_file(model, root)
    found, failed = described(body, model), not body.found
    if emit is not None and out is not None:
        _write(body, model, order, emit, out)
    elif check is not None:
        from esp_cli.bodies.auditing import audit, named_function
        from esp_cli.bodies.terms import read_numbers

        copies = audit(named_function(check), body, read_numbers(body, order))
        failed = any(copy.wrong for copy in copies)
        console.result(json, {**found, "check": copies}, lambda: _print_audit(check, copies))
    else:
        console.result(json, found, lambda: _print(body, model))
    if failed:
        raise typer.Exit(1)


def _write(body: Body, model: Path, order: Path | None, host: str, out: Path) -> None:
    from esp_cli.bodies.emitting import HOSTS, emitted
    from esp_cli.bodies.terms import read_numbers
    from esp_cli.files.writing import write_file

    numbers = read_numbers(body, order)
    write_file(out, emitted(body, numbers, model.name).encode())
    groups = ", ".join(f"{group} ({layout.summary})" for group, layout in numbers.groups.items())
    console.say(f"{out} has {HOSTS[host]} for {', '.join(body.found)}: {groups}; actions ({numbers.action.summary})")
    if order is None:
        console.note("the observations are those of Isaac Lab's velocity tasks; --order FILE names yours")


def _print_audit(name: str, copies: Sequence[Copy]) -> None:
    wrong = [(copy.element, *row) for copy in copies for row in copy.wrong]
    if wrong:
        console.say(f"{name} is wrong in {len(wrong)} numbers")
    else:
        console.say(f"{name} is right: its copies are {', '.join(copy.element for copy in copies)}")
    for k, copy in enumerate(copies):
        if not copy.is_involution and copy.wrong:
            console.say(f"copy {k} ({copy.element}) does not undo itself")
    if wrong:
        console.table(("element", "number", "takes", "right is"), wrong)


def described(body: Body, model: Path) -> dict[str, Any]:
    """Return what is known of a body as JSON takes it."""
    elements = {
        name: {
            "verdict": one.proof.verdict,
            "gap": one.proof.gap,
            "median": one.proof.median,
            "constraints": one.proof.constraints,
            "contacts": one.proof.contacts,
            "smallest_planted": float(one.proof.planted.min()),
            "joints": {
                joint: {"image": image, "sign": sign, "gap": gap, "planted": planted, "differs": d.what, "by": d.share}
                for joint, image, sign, gap, planted, d in body.rows(name)
            },
        }
        for name, one in body.found.items()
    }
    return {"model": str(model), "group": body.group, "elements": elements, "refused": body.refused}


def _print(body: Body, model: Path) -> None:
    console.say(_answer(body, model))
    for name, one in body.found.items():
        console.say(f"{_called(name)}: {_proven(one.proof)}")
        if one.base is not None and _differs(one.base):
            console.say(f"  the base differs from its image: {_differs(one.base)}")
        unseen = [joint for joint, _, _, _, planted, _ in body.rows(name) if not one.proof.would_show(planted)]
        if unseen:
            console.say(f"  not covered: a mistake at {', '.join(unseen)} would not show in accelerations")
    for name, reason in body.refused.items():
        console.say(f"{_called(name)} does not hold: {reason}")
    if not body.found:
        return
    shown = list(body.found)[:_SHOWN]
    tables = {name: body.rows(name) for name in shown}
    rows = []
    for k, (joint, *_) in enumerate(tables[shown[0]]):
        images = [("-" if tables[name][k][2] == -1 else "") + tables[name][k][1] for name in shown]
        worst = max((tables[name][k] for name in shown), key=lambda row: row[3])
        rows.append((joint, *images, f"{worst[3]:.1g}", _differs(worst[5])))
    caption = "gap: of the joint's accelerations, as a share of them; differs: what of the model is not its own image"
    console.table(("joint", *shown, "gap>", "differs"), rows, caption=caption)
    if len(body.found) > _SHOWN:
        console.note(f"--json has the tables of {', '.join(list(body.found)[_SHOWN:])} too")


def _differs(difference: Difference) -> str:
    return f"{difference.what} {difference.share:.2%}" if difference.share >= 1e-4 else ""


def _answer(body: Body, model: Path) -> str:
    if not body.found:
        return f"{model.name} has no mirror or turn that its accelerations show"
    nearly = [name for name, one in body.found.items() if one.proof.verdict != "exact"]
    rest = "exactly" if not nearly else f"but for asymmetries of the model itself ({', '.join(nearly)})"
    return f"{model.name} is symmetric under {body.group}, {rest}; {len(body.joints)} joints"


def _called(name: str) -> str:
    from esp_cli.bodies.tables import NAMES

    word = next((word for word, plain in NAMES.items() if plain == name), None)
    return f"{name} ({word})" if word else name


def _proven(proof: Any) -> str:
    parts = [f"accelerations agree to {proof.gap:.2g} at the worst joint, {proof.median:.2g} in the median"]
    parts.append(f"with limits and friction to {proof.constraints:.2g}")
    parts += [] if proof.contacts is None else [f"in contact to {proof.contacts:.2g}"]
    return f"{', '.join(parts)}; the least planted mistake is off by {proof.planted.min():.2g}"
