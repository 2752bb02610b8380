"""`esp train`: train a new run, or go on with an old one."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from esp_cli import console
from esp_cli.commands import options
from esp_cli.commands.counts import chosen_seeds
from esp_cli.console.progress import stop_requests
from esp_cli.defaults import STEPS, PriorKind
from esp_envs.errors import UserError

if TYPE_CHECKING:
    from esp_cli.run import Run
    from esp_cli.training.config import RunConfig
    from esp_cli.training.trackers import Guarded, Tracker
    from esp_cli.training.trainer import Progress, Trainer

EPILOG = """Examples:\n
    esp train --algo mappo --task navigation\n
    esp train --task navigation --prior none --seeds 10 --steps 3M --out runs/cn-mappo\n
    esp train --task formation --physics pymunk --set task.num_obstacles=0\n
    esp train --resume runs/cn-mappo"""

DEFAULT_SEEDS = (0,)


def train(
    context: typer.Context,
    task: options.TaskOption = "navigation",
    algo: options.AlgoOption = "mappo",
    preset: options.PresetOption = "default",
    prior: Annotated[
        Literal[PriorKind, "auto"] | None,
        Option(
            "--prior",
            help="esp: both parts; auto: as far as the task is symmetric; augment, consistency: one part; none: plain.",
        ),
    ] = None,
    transforms: options.TransformsOption = None,
    physics: options.PhysicsOption = None,
    network: Annotated[
        str | None,
        Option(
            "--network",
            help="mlp, gru (recurrent), set, set-equivariant, mpn (message passing), empn, equivariant or module:Class",
        ),
    ] = None,
    steps: options.StepsOption = STEPS,
    seeds: Annotated[options.Seeds | None, options.seeds_option(len(DEFAULT_SEEDS))] = None,
    seed_list: options.SeedListOption = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Run folder; by default a new one in runs/.")] = None,
    resume: Annotated[Path | None, Option("--resume", help="Continue this run with its own settings.")] = None,
    device: options.DeviceOption = "cpu",
    settings: options.SetOption = None,
    config: Annotated[
        Path | None,
        Option(
            "--config", help="Read settings from a run, its config.json, or a JSON or TOML file; options override them."
        ),
    ] = None,
    print_config: Annotated[
        bool, Option("--print-config", help="Print the resolved configuration as JSON; train nothing.")
    ] = False,
    init_from: Annotated[
        Path | None,
        Option(
            "--init-from",
            help="Start from this policy where the shapes fit: a run, a file, or bundled.",
            metavar="RUN|POLICY",
        ),
    ] = None,
    track: Annotated[
        list[str] | None,
        Option(
            "--track", help="Also send metrics to tensorboard, wandb or mlflow, offline in the run folder; repeatable."
        ),
    ] = None,
    watch: Annotated[
        bool,
        Option("--watch", help="Draw the curve and the current policy on a page in the run folder, for a browser."),
    ] = False,
    no_check: options.NoCheckOption = False,
) -> None:
    """Train S seeds of one task, algorithm, network and prior at once, with live progress."""
    from esp_cli.networks.kernels.library import WORTH_COMPILING, begin

    named = options.parse_assignments(settings or [])
    compiled = named.get("network.compiled", "auto")
    is_worth_it = steps >= WORTH_COMPILING and device != "cuda" and resume is None and not print_config
    if compiled is True or (compiled == "auto" and is_worth_it):
        begin("perceptron")  # while torch is imported

    from esp_cli import run as runs
    from esp_cli.commands.train_choices import plan_run
    from esp_cli.machine import resolve_device
    from esp_cli.training.config import is_prior_chosen
    from esp_cli.training.run_folder import RUN_FORMAT
    from esp_cli.training.trackers import require

    trackers = tuple(track or ())
    options.register_named([task], [algo], [network, named.get("network.name")])
    if resume is not None:
        given = {"task": task, "algo": algo, "network": network or ""}
        own = {name: value for name, value in given.items() if ":" in value}
        _refuse_beside_resume(context, allowed=[*own])
        run = runs.Run(resume)
        options.refuse_unused([run.config], *([own.get(name, "")] for name in given))
        if options.was_given(context, "device"):
            run.config = run.config.model_copy(update={"device": resolve_device(device)})
        _train(run, trackers, watch, not no_check)
        return
    require(trackers)
    if prior == "none" and transforms is not None:
        raise UserError("--prior none uses no symmetry; leave out --transforms, or --prior none")
    short = {"prior.kind": prior, "prior.transforms": transforms, "network.name": network, "task.physics": physics}
    choices: dict[str, Any] = {
        "task": task,
        "algorithm": algo,
        "preset": preset,
        "steps": steps,
        "seeds": chosen_seeds(seeds, seed_list, DEFAULT_SEEDS),
        "device": device,
        "init_from": init_from,
    }
    overrides = {name: value for name, value in short.items() if value is not None} | named
    resolved, weights, idle = plan_run(context, config, choices, overrides)
    options.note_without_effect(idle)
    if resolved.prior.kind == "none" and config is None and not is_prior_chosen(overrides):
        console.note(f"{task} declares no symmetry, so there is no prior; --prior auto weighs what holds")
    if print_config:
        console.write_json("-", RUN_FORMAT.document(resolved.model_dump(mode="json")))
        return
    _train(runs.begin(resolved, weights, out), trackers, watch, not no_check)


def _refuse_beside_resume(context: typer.Context, allowed: Sequence[str]) -> None:
    """Refuse options that a resumed run would ignore: it keeps its own configuration."""
    given = [
        parameter.opts[0]
        for parameter in context.command.params
        if parameter.name not in ("resume", "track", "watch", "no_check", "device", *allowed)
        and options.was_given(context, parameter.name)
    ]
    if given:
        raise UserError(
            f"--resume continues a run with its own settings; leave out {', '.join(given)}, or start a new run"
        )


def _train(run: Run, trackers: Sequence[str], watch: bool, check: bool) -> None:
    from esp_cli.policies.evaluation import rough_anchors

    with run.trainer(trackers, check) as trainer, stop_requests("stopping after this iteration") as requests:
        if trainer.is_complete and run.is_complete:
            console.note(f"{run.path} is complete at {console.format_count(trainer.step)} steps")
            return
        config = run.config
        _announce(config, run.path, trainer.step)
        page = _watched(trainer) if watch else None
        anchors = rough_anchors(config, 2 * config.evaluation.episodes)
        with console.TrainingProgress(config.steps, len(config.seeds), trainer.step, config.task) as progress:

            def listen(news: Progress) -> bool:
                for text in news.notes:
                    console.note(text)
                progress.update(min(news.step, news.total), _shown(news, anchors))
                if page is not None:
                    page.write(news.step, news.metrics)
                return not requests

            complete = trainer.run(listen)
        for text in trainer.notes:  # of a tracker that could not be closed
            console.note(text)
    if not complete:
        console.note(
            f"stopped at {console.format_count(trainer.step)} steps; continue with: "
            f"{shlex.join(['esp', 'train', '--resume', str(run.path), *config.own_words()])}"
        )
        raise typer.Exit(130)
    _report(trainer, run.path, config, anchors)


def _watched(trainer: Trainer) -> Guarded:
    """Return what draws the page of a run; where it fails the user is told, and the run goes on."""
    from esp_cli.training.trackers import Guarded

    def opened() -> Tracker:
        from esp_cli.reporting.live import LivePage

        page = LivePage(trainer)
        console.note(f"watch it in a browser: {page.path.resolve().as_uri()}")
        return page

    return Guarded("--watch", opened, console.note)


def _announce(config: RunConfig, path: Path, step: int) -> None:
    from esp_cli.symmetry.admission import DISCOVERED

    prior, symmetry = config.prior.effective(), "no prior"
    if prior.kind != "none":
        symmetry = f"prior {prior.kind} ({prior.transforms}, c = {prior.coefficient:g})"
        if unseen := [name for name, weight in prior.weights.items() if weight == 0]:
            symmetry += f", {len(unseen)} of {len(prior.weights)} elements left out, not covered or broken "
            symmetry += f"by an unknown size: {', '.join(unseen[:8])}"
        if broken := [weight for weight in prior.weights.values() if 0 < weight < 1]:
            worth = f"{min(broken):.2g} to {max(broken):.2g}" if min(broken) < max(broken) else f"{broken[0]:.2g}"
            symmetry += f", {len(broken)} of {len(prior.weights)} elements broken and weighed {worth}"
        if prior.fade:
            symmetry += f", fading out over {prior.fade:.0%} of the run"
    elif config.prior.transforms == DISCOVERED:
        symmetry = "no prior (no symmetry was discovered)"
    verb = f"resuming at {console.format_count(step)}" if step else "training"
    console.note(
        f"{verb}: {config.algorithm} on {config.task}, {symmetry}, {len(config.seeds)} seed(s), "
        f"{console.format_count(config.steps)} steps each -> {path}"
    )


def _shown(news: Progress, anchors: Mapping[str, float]) -> dict[str, float]:
    from esp_cli.policies.statistics import normalised

    names = {"greedy": "eval/return_greedy", "return": "train/return", "entropy": "train/entropy"}
    out = {}
    for label, name in names.items():
        values = [x for x in news.metrics.get(name, []) if x is not None and not math.isnan(x)]
        if values:
            out[label] = sum(values) / len(values)
        if label == "greedy" and values and (scaled := normalised(out[label], anchors)) is not None:
            out["normalised"] = float(scaled)
    return out


def _report(trainer: Trainer, path: Path, config: RunConfig, anchors: Mapping[str, float]) -> None:
    import numpy as np

    from esp_cli.policies.statistics import mean_and_sem, normalised

    rows: list[tuple[object, ...]] = []
    columns: tuple[str, ...] = ("policy", "episode return>", "seeds>")
    for mode, values in trainer.final_returns().items():
        good = values[np.isfinite(values)]  # a seed that stopped has none
        mean, sem = mean_and_sem(good)
        scaled = normalised(mean, anchors) if good.size else None
        rows.append((mode, console.format_mean(mean, sem), len(good), "-" if scaled is None else f"{scaled:.2f}"))
    caption = f"convention {trainer.learner.spec.convention}; mean ± s.e.m. over seeds, last evaluation"
    if anchors:
        columns += ("normalised>",)
        caption += "; normalised: 0 random, 1 the best heuristic, both over few episodes"
    console.table(columns, [row[: len(columns)] for row in rows], caption=caption)
    if not trainer.learner.has_learned:
        console.note(
            "nothing was learned: the run ended within its warm-up; take more --steps or fewer warmup_episodes"
        )
    words = shlex.join([str(path), *config.own_words()])
    console.note(
        f"next: esp eval {words}"
        + (f"    esp render {words} -o out.gif" if trainer.evaluation_worlds.has("scene") else "")
    )
