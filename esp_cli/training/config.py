"""The resolved configuration of a run: task, algorithm, network and prior are independent choices."""

from __future__ import annotations

import contextlib
import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationInfo, field_validator

from esp_cli.algorithms.presets import ALGORITHMS, preset_layers
from esp_cli.defaults import MAX_SEEDS, MAX_STEPS, STEPS
from esp_cli.files.documents import Strict, parse_value, validate, validated, without_gone
from esp_cli.files.formatting import nearest, shortened
from esp_cli.networks.build import AnyNetworkConfig, network_class
from esp_cli.networks.plain import MlpConfig
from esp_cli.prior.config import PriorConfig
from esp_cli.symmetry import default_transforms
from esp_cli.symmetry.admission import carries
from esp_envs.errors import UserError
from esp_envs.registry import TASKS, make, task_class

SECTIONS = {"task": "task_settings", "network": "network", "prior": "prior", "evaluation": "evaluation"}
"""The sections that settings of every run have, and where its configuration holds them."""
_OPTIONS = {"prior.kind": "--prior", "network.name": "--network"}


class EvaluationConfig(Strict):
    """How a run is evaluated while it trains (the field's protocol: 32 episodes every 10k steps)."""

    every_steps: int = Field(10_000, ge=1, description="environment steps per seed between evaluations")
    episodes: int = Field(32, ge=1, description="per seed, greedy and stochastic each")


class InitialPolicy(Strict):
    """The policy that a run started from; the run's folder holds a copy of it."""

    source: str = Field(max_length=4096, description="where it was found: a run folder, a file, a bundled policy")
    sha256: str = Field(pattern="^[0-9a-f]{64}$", description="of its weights")


class RunConfig(Strict):
    """Everything that decides a run's numbers. Two runs of one config on one machine are equal bit for bit."""

    task: str = Field(max_length=100)
    algorithm: str = Field(max_length=100)
    preset: str = Field("default", max_length=100)
    steps: int = Field(ge=1, le=MAX_STEPS, description="environment steps per seed")
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        (0,), min_length=1, max_length=MAX_SEEDS, description="as many as --seeds takes"
    )
    task_settings: dict[str, Any] = Field(default_factory=dict)
    algorithm_settings: dict[str, Any] = Field(default_factory=dict)
    network: AnyNetworkConfig = MlpConfig()
    prior: PriorConfig = PriorConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    device: Literal["cpu", "cuda"] = "cpu"
    init_from: InitialPolicy | None = Field(None, description="the policy that it started from")

    @field_validator("seeds")
    @classmethod
    def _once(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds):
            raise UserError("a seed stands there twice")
        return seeds

    @field_validator("task_settings", "prior", mode="before")
    @classmethod
    def _without_what_went(cls, stored: object, info: ValidationInfo) -> object:
        return without_gone(info.data.get("task", "") if info.field_name == "task_settings" else "prior", stored)

    def of_one_seed(self) -> RunConfig:
        """Return the configuration of the first seed alone, on the CPU, for what all seeds and devices share."""
        return self.model_copy(update={"seeds": self.seeds[:1], "device": "cpu"})

    def without_effect(self) -> frozenset[str]:
        """Return settings that change nothing beside the others, as "prior.weights"."""
        learner = ALGORITHMS[self.algorithm]
        of_others = {"old_log_prob" if learner.replays else "replay"}
        settings = learner.config_class(**self.algorithm_settings)
        task = task_class(self.task).Settings(**self.task_settings)
        idle = {
            "task": task.without_effect(),
            "prior": self.prior.without_effect() | of_others,
            "network": self.network.without_effect() | ({"compiled"} if self.device == "cuda" else set()),
            self.algorithm: settings.without_effect(
                self.network, lambda: make(self.task, 1, (0,), self.task_settings).spec
            ),
        }
        return frozenset(f"{section}.{name}" for section, names in idle.items() for name in names)

    def by_name(self) -> dict[str, Any]:
        """Return all settings by their dotted names, as `--set` takes them."""
        stored, sections = self.model_dump(mode="json"), {self.algorithm: "algorithm_settings"} | SECTIONS
        return {f"{section}.{name}": value for section, key in sections.items() for name, value in stored[key].items()}

    def own_words(self, *others: RunConfig) -> list[str]:
        """Return the options that name code of the user in a command about runs, each once: ["--task", "mine:Task"]."""
        runs = (self, *others)
        chosen = [(("--task", run.task), ("--algo", run.algorithm), ("--network", run.network.name)) for run in runs]
        named = dict.fromkeys((option, name) for pairs in chosen for option, name in pairs if ":" in name)
        return [word for pair in named for word in pair]

    def command(self) -> str:
        """Return the `esp train` command line that resolves to this configuration, without what is the default."""
        # so that no world is made with other settings than the user's: what another task declares is said
        declared = {} if TASKS.ships(self.task) else {"prior.transforms": PriorConfig().transforms}
        presets = _preset_sections(self.task, self.algorithm, self.preset, None)["network"].get("name", "mlp")
        named = {} if self.network.name == presets else {"network.name": self.network.name}
        plain = resolve_config(
            self.task, self.algorithm, self.preset, self.steps, self.seeds, self.device, declared | named
        )
        known, own = plain.model_dump(mode="json"), self.model_dump(mode="json")
        by_itself = self.network.model_copy(update={"compiled": "auto"}).decided(self.steps, self.device)
        known["network"]["compiled"] = getattr(by_itself, "compiled", None)  # what auto decides beside these settings
        words = ["esp", "train", "--task", self.task, "--algo", self.algorithm]
        words += ["--preset", self.preset] if self.preset != "default" else []
        words += [*seed_words(self.seeds), "--steps", str(self.steps)]
        words += ["--device", self.device] if self.device != "cpu" else []
        words += ["--network", self.network.name] if named else []
        words += ["--init-from", self.init_from.source] if self.init_from else []
        for section, key in ({self.algorithm: "algorithm_settings"} | SECTIONS).items():
            for name, value in own[key].items():
                if known[key].get(name, ...) != value:
                    words += _assignment(f"{section}.{name}", value)
        return shlex.join(words)


def seed_words(seeds: Sequence[int]) -> list[str]:
    """Return seeds as a command line says them: (0, 1, 2) -> --seeds 3, (3, 7) -> --seed-list 3,7."""
    counted = tuple(seeds) == tuple(range(len(seeds)))
    return ["--seeds", str(len(seeds))] if counted else ["--seed-list", ",".join(map(str, seeds))]


def _assignment(name: str, value: object) -> list[str]:
    """Return the words that set one setting; a text stands as it is unless it would be read as JSON."""
    text = value if isinstance(value, str) and _read(value) == value else json.dumps(value, separators=(",", ":"))
    return [_OPTIONS[name], text] if name in _OPTIONS else ["--set", f"{name}={text}"]


def resolve_config(
    task: str,
    algorithm: str = "mappo",
    preset: str = "default",
    steps: int = STEPS,
    seeds: Sequence[int] = (0,),
    device: str = "cpu",
    overrides: Mapping[str, object] | None = None,
) -> RunConfig:
    """Resolve a preset and overrides into a full configuration.

    The preset "default" takes what measured best on the task, where that is known, "fast" what reaches the same return
    in fewer seconds. Steps are environment steps per seed. Overrides are by dotted names, such as
    "mappo.learning_rate"; text is read as JSON where that is possible. Where the task carries no transform and nobody
    chose a setting of the prior, there is none. An unknown name or a value out of range is a UserError.
    """
    sections = _preset_sections(task, algorithm, preset, (overrides or {}).get("network.name"))
    _override(sections, overrides or {}, task, algorithm)
    task_settings = resolve_task_settings(task, sections["task"])
    prior = validated(PriorConfig, sections["prior"], "prior")
    if prior.kind != "none" and "transforms" not in sections["prior"] and not TASKS.ships(task):
        spec = make(task, 1, (0,), task_settings).spec
        chosen = default_transforms(spec, not prior.needs_declaration)
        changes = {"transforms": chosen}
        if not spec.roles and not carries(chosen, spec) and not is_prior_chosen(overrides or {}):
            changes = {"kind": "none"}
        prior = prior.model_copy(update=changes)
    learner = ALGORITHMS[algorithm]
    name = sections["network"].get("name", "mlp")
    network = validated(network_class(name), sections["network"], "network", f"the network {name}")
    values = {
        "task": task,
        "algorithm": algorithm,
        "preset": preset,
        "steps": steps,
        "seeds": tuple(seeds),
        "task_settings": task_settings,
        "algorithm_settings": validated(learner.config_class, sections[algorithm], algorithm).model_dump(mode="json"),
        "network": network.decided(steps, device),
        "prior": prior,
        "evaluation": validated(EvaluationConfig, sections["evaluation"], "evaluation"),
        "device": device,
    }
    return validated(RunConfig, values, "run")


def is_prior_chosen(settings: Iterable[str]) -> bool:
    """Return whether a user's settings, by dotted name, say anything of the prior."""
    return any(name.startswith("prior.") for name in settings)


def _override(
    sections: dict[str, dict[str, object]], overrides: Mapping[str, object], task: str, algorithm: str
) -> None:
    """Set what the user chose, and drop what a preset chose for another network or for declared transforms."""
    for dotted, value in overrides.items():
        section, dot, key = dotted.rpartition(".")
        if not dot or section not in sections:
            raise UserError(_no_section(dotted, task, algorithm))
        sections[section][key] = read = _read(value)
        if isinstance(read, float) and not math.isfinite(read):
            raise UserError(f"bad value {read} for '{dotted}': it has to be a finite number")
    network = sections["network"].get("name", "mlp")
    known = network_class(network).model_fields
    for name in set(sections["network"]) - set(known):
        if f"network.{name}" not in overrides:
            del sections["network"][name]
        elif "network.name" not in overrides and name in MlpConfig.model_fields:
            raise UserError(
                f"the network '{network}' that the preset has for {task} has no '{name}'; add --network mlp"
            )
    if sections["prior"].get("kind") == "auto" and "prior.transforms" not in overrides:
        sections["prior"].pop("transforms", None)


def _no_section(dotted: str, task: str, algorithm: str) -> str:
    models: dict[str, type[BaseModel]] = {
        "task": task_class(task).Settings,
        algorithm: ALGORITHMS[algorithm].config_class,
        "network": MlpConfig,
        "prior": PriorConfig,
        "evaluation": EvaluationConfig,
    }
    homes = {name: section for section, model in reversed(models.items()) for name in model.model_fields}
    name = nearest(dotted.rpartition(".")[2], homes)
    hint = f"; did you mean '{homes[name]}.{name}'?" if name else ""
    return f"cannot set '{shortened(dotted)}': a setting is SECTION.NAME with a section of {', '.join(models)}{hint}"


def _preset_sections(task: str, algorithm: str, preset: str, network: object) -> dict[str, dict[str, object]]:
    asked, known = ALGORITHMS[algorithm].task_settings, task_class(task).Settings.model_fields
    sections: dict[str, dict[str, object]] = {"task": {name: asked[name] for name in asked if name in known}}
    sections |= {name: {} for name in (algorithm, "network", "prior", "evaluation")}
    for layer in preset_layers(task, algorithm, preset, network):
        for section, values in layer.items():
            sections[section].update(values)
    return sections


def resolve_task_settings(task: str, settings: Mapping[str, object]) -> dict[str, Any]:
    """Return a task's settings with its defaults; raises a UserError for an unknown one or a value out of range."""
    return validated(task_class(task).Settings, settings, "task").model_dump(mode="json")


def completed(config: RunConfig) -> RunConfig:
    """Return a stored configuration with the defaults of the settings that its task and learner gained since.

    Settings that these do not have, or whose values they do not take, are a UserError.
    """
    task = validate(task_class(config.task).Settings, config.task_settings, "task")
    learner = validate(ALGORITHMS[config.algorithm].config_class, config.algorithm_settings, config.algorithm)
    changes = {"task_settings": task.model_dump(mode="json"), "algorithm_settings": learner.model_dump(mode="json")}
    return config.model_copy(update=changes)


def known_settings(config: RunConfig) -> RunConfig:
    """Return what `completed` does; the configuration as it is where its task is not at hand, or refuses it."""
    with contextlib.suppress(UserError):
        return completed(config)
    return config


def is_same(config: RunConfig, stored: object) -> bool:
    """Return whether a configuration is the one that a file holds, but for settings that came since."""
    with contextlib.suppress(UserError):
        return known_settings(validate(RunConfig, stored, "config")) == config
    return False


def _read(value: object) -> object:
    """Read command-line text as JSON where it is JSON ("64", "[64, 64]", "true"), else as it stands."""
    if not isinstance(value, str):
        return value
    try:
        return parse_value(value)
    except ValueError:
        return value
