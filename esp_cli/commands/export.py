"""`esp export`: write a trained policy in other formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from esp_cli import console
from esp_cli.commands import options
from esp_cli.defaults import EPISODES
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.export.export import Exported
    from esp_cli.policies.loading import TrainedPolicy

EPILOG = """Examples:\n
    esp export formation -f c -o formation-c\n
    esp export runs/cn-mappo -f onnx -f numpy -o cn-export"""

FORMATS = ("onnx", "torch", "c", "numpy")


def export(
    policy: options.PolicyArgument,
    formats: Annotated[list[str], Option("--format", "-f", help=f"What to write: {', '.join(FORMATS)}; repeatable.")],
    out: options.OutOption,
    task: options.OwnTaskOption = None,
    seed: Annotated[
        int | None, Option("--seed", help="Which seed of a run; by default the best over --episodes.")
    ] = None,
    algo: options.BundledAlgoOption = None,
    network: options.OwnNetworkOption = None,
    prior: options.BundledPriorOption = None,
    episodes: Annotated[
        int | None,
        Option(
            "--episodes", "-e", min=2, max=1_000_000, help="Per seed, to find the best.", show_default=str(EPISODES)
        ),
    ] = None,
    force: options.ForceOption = False,
    json: options.JsonOption = None,
) -> None:
    """Write a policy for other programs (ONNX, torch.export, C99, numpy), checked against the policy itself.

    Every export has the layout and the units of its observation, the meaning of its actions, and a worked example.
    If the agents of a task have roles, each role's policy gets a folder.
    """
    for unknown in set(formats) - set(FORMATS):
        raise UserError(f"there is no format '{unknown}'; the formats are {', '.join(FORMATS)}")
    if seed is not None and episodes is not None:
        raise UserError("--episodes finds the best seed, and --seed names one; leave one of them out")
    from esp_cli.export.export import export_all, refuse_taken
    from esp_cli.policies.loading import open_policy

    options.register_named(task, [algo], network)
    trained = open_policy(policy, algo, prior)
    options.refuse_unused([trained.config], task, [algo], network)
    for text in trained.notes:
        console.note(text)
    parts = {role.name: trained.of_role(role.name) for role in trained.spec.roles} or {"": trained}
    refuse_taken([out / role for role in parts], formats, force)  # before the work
    chosen = _best(trained, episodes or EPISODES) if seed is None else seed
    exported = export_all({out / role: part.single_seed(chosen) for role, part in parts.items()}, formats, force)
    written = {role: exported[out / role] for role in parts}

    def show() -> None:
        for role, one in written.items():
            _print(one, f"{policy}{f', {role}' if role else ''}, seed {chosen}", out / role)

    console.result(json, written if trained.spec.roles else written[""], show)


def _best(trained: TrainedPolicy, episodes: int) -> int:
    from esp_cli.policies.evaluation import best_seed

    seeds = trained.config.seeds
    best = best_seed(trained, episodes)
    if len(seeds) > 1:
        console.note(f"seed {best} is the best of {len(seeds)} over {episodes} episodes each; --seed names another")
    return best


def _print(exported: Exported, title: str, out: Path) -> None:
    rows = []
    for result in exported.formats:
        numbers = ("-", "-", "-")
        if (agreement := result.agreement) is not None:
            others = "-" if agreement.other_actions is None else str(agreement.other_actions)
            numbers = (str(agreement.observations), f"{agreement.max_difference:.1e}", others)
        rows.append((result.name, ", ".join(result.files), result.size, *numbers))
        if result.note:
            console.note(result.note)
    headings = ("format", "files", "bytes>", "observations>", "largest difference>", "other choices>")
    console.table(headings, rows, title=title, caption="compared with the policy itself, in float32")
    console.note(f"{out} has a README, and the worked example in policy.json; parameters: {exported.parameters}")
