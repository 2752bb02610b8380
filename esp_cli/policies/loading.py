"""Trained policies, read from a run folder or a policy file or by a bundled one's name, and runs that start from them.

Loading never runs code. What is missing, foreign, damaged or of another version of the task is a UserError.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import Any

import torch
from torch import Tensor

from esp_cli.algorithms.learner import Learner, below
from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.algorithms.roles import new_policy
from esp_cli.defaults import __version__
from esp_cli.files.formatting import did_you_mean, shortened
from esp_cli.networks.contract import NetworkConfig
from esp_cli.networks.policy import Policy
from esp_cli.networks.roles import RolesPolicy
from esp_cli.policies import bundled
from esp_cli.training.build import build_environment, generators, spec_of
from esp_cli.training.checkpoint import POLICY_FORMAT, digest, load_checkpoint
from esp_cli.training.config import InitialPolicy, RunConfig, resolve_task_settings
from esp_cli.training.run_folder import RunFolder
from esp_cli.training.settings import parse_config
from esp_envs.base import Environment
from esp_envs.errors import UserError
from esp_envs.registry import task_names
from esp_envs.spec import TaskSpec
from esp_envs.views import OthersAtRandom, RoleView

# modules beside the policy that a run may start from
_FURTHER = ("critic.", "target_critic.", "mixer.", "target_mixer.", "normaliser.", "reward_scale.")


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy and what it was trained for."""

    config: RunConfig  # of the run; its device is the CPU where there is no GPU
    policy: Policy  # S policies, in evaluation mode
    spec: TaskSpec  # of the task it was trained on
    step: int  # environment steps per seed behind it
    source: Path  # the run folder or file
    notes: tuple[str, ...] = ()  # sentences for the user (a damaged checkpoint was passed over)
    stopped: tuple[int, ...] = ()  # places of seeds that stopped on a number that is not finite; theirs are early ones
    role: str = ""  # whose policy it is, where it is that of one role alone
    further: Mapping[str, Tensor] = field(default_factory=dict)  # weights beside it: "critic...."

    @classmethod
    def read(cls, path: Path, sha256: str | None = None) -> TrainedPolicy:
        """Read a run folder (its newest checkpoint, else its policy file), or a file, whose SHA-256 may be stated."""
        if sha256 is not None or path.is_file():
            tensors, meta = load_checkpoint(path, POLICY_FORMAT, sha256)
            writer = meta.get("esp_version", __version__)
            return _build(path, parse_config(meta.get("config"), path, writer), tensors, meta)
        folder, notes = RunFolder.open(path), list[str]()
        config, checkpoint = parse_config(folder.config, path), folder.latest_checkpoint(notes.append)
        if checkpoint is not None:
            tensors, meta = checkpoint
            found = _build(path, config, below(tensors, "policy"), meta, tuple(notes))
            further = _FURTHER if config.network.free_of_counts else ()
            return replace(found, further={name: t for name, t in tensors.items() if name.startswith(further)})
        if folder.policy_path.is_file():  # somebody may have removed its checkpoints
            return _build(path, config, *load_checkpoint(folder.policy_path, POLICY_FORMAT), tuple(notes))
        raise UserError(f"{path} holds no checkpoint yet; train on with esp train --resume {quote(str(path))}")

    def transfer(self, settings: Mapping[str, object]) -> TrainedPolicy:
        """Return the policy for its task under changed settings, other numbers too where each role's weights fit."""
        if not settings:
            return self
        changed = resolve_task_settings(self.config.task, {**self.config.task_settings, **settings})
        config = self.config.model_copy(update={"task_settings": changed})
        spec, free = spec_of(config), config.network.free_of_counts
        was, now = ([role for role, _ in one.parts] for one in (self.spec, spec))

        def differ(what: Callable[[TaskSpec], object]) -> bool:
            return [what(role) for role in was] != [what(role) for role in now]

        numbers, rows = differ(lambda role: role.num_agents), differ(lambda role: role.observation)
        seen = differ(lambda role: role.observation.without_counts) if free else rows
        differs = {
            "roles": [role.name for role in spec.roles] != [role.name for role in self.spec.roles],
            "agents": numbers and seen,
            "observation": seen,
            "action": differ(lambda role: role.action),
            "masks": differ(lambda role: role.masks),
        }
        names = ", ".join(f"task.{name}" for name in settings)
        if part := next((part for part, other in differs.items() if other), None):
            hint = "change only what a policy neither sees nor does"
            if part == "agents" and not free:
                hint += "; the weights of its network are made for a number of agents, of set for any"
            elif part in ("agents", "observation") and (lost := _seen_in_one(was, now)) and free:
                hint = f"weights for {', '.join(lost)} are missing where none are seen, so keep one or more, or none"
            raise UserError(
                f"{self.source} was trained with other {part} than the task has with {names} changed; {hint}"
            )
        if not (numbers or rows):  # whatever the task declares of itself now
            return replace(self, config=config, spec=spec)
        policy = _untrained(config, spec)
        misfit = f"{self.source}: the weights do not fit the task with {names} changed"
        _fill(policy, self.policy.state_dict(), self.source, misfit)
        return replace(self, config=config, spec=spec, policy=policy)

    def of_role(self, role: str | None) -> TrainedPolicy:
        """Return the policy of one role of its task; of a task without roles, which has none, the policy itself."""
        names = [one.name for one in self.spec.roles]
        if role not in names if names else role is not None:
            has = f"has the roles {', '.join(names)}; name one of them" if names else "has no roles; leave role out"
            raise UserError(f"{self.source} {has}")
        if role is None or not isinstance(self.policy, RolesPolicy):
            return self
        return replace(self, spec=self.spec.roles[names.index(role)], policy=self.policy.of(role), role=role)

    def worlds(self, num_envs: int, *stream: object) -> Environment:
        """Make worlds as this policy meets them; agents of other roles act at random."""
        env = build_environment(self.config, num_envs, *stream)
        return RoleView(OthersAtRandom(env), self.role) if self.role else env

    def single_seed(self, seed: int | None = None) -> TrainedPolicy:
        """Return one seed's policy, by default the first's, on the CPU and with products in float32, for export."""
        seeds = self.config.seeds
        if seed is not None and seed not in seeds:
            raise UserError(f"{self.source} has no seed {seed}; it has {', '.join(map(str, seeds))}")
        index = 0 if seed is None else seeds.index(seed)
        network = _at_default(self.config.network, "precision", "compiled")
        choice = {"seeds": seeds[index : index + 1], "network": network, "device": "cpu"}
        config = self.config.model_copy(update=choice)
        policy = _untrained(config, self.spec)
        policy.load_state_dict({name: t[index : index + 1].cpu() for name, t in self.policy.state_dict().items()})
        return replace(self, config=config, policy=policy, stopped=(0,) if index in self.stopped else ())


def open_policy(where: Path, algo: str | None = None, prior: str | None = None) -> TrainedPolicy:
    """Open a run folder, a policy file, or a bundled policy by its name or its task's.

    An existing path goes before a bundled policy of that name, unless algorithm or prior is given, which choose among
    the bundled ones; an algorithm "module:Class" of the caller chooses none.
    """
    name = str(where)
    algo = None if algo is not None and ":" in algo else algo
    chosen = algo is not None or prior is not None
    try:
        exists = where.exists()
    except OSError as error:  # a name that no file can have
        raise UserError(f"there is no policy {shortened(name)}: {error.strerror}") from None
    if exists and not chosen:
        return TrainedPolicy.read(where)
    known = [*task_names(), *(entry.name for entry in bundled.read_bundled())]
    if name in known:
        entry = bundled.find(name, algo, prior)
        trained = TrainedPolicy.read(bundled.bundled_folder() / entry.file, entry.sha256)
        note = f"{name}: taking the bundled policy {entry.name}"
        return trained if entry.name == name else replace(trained, notes=(*trained.notes, note))
    if chosen:
        raise UserError(f"--algo and --prior choose among a task's policies, but {where} is not a task; leave them out")
    hint = did_you_mean(name, known) or "; give a run folder, a policy file, or a task's or policy's name"
    raise UserError(f"{where} does not exist{hint}")


def weights_to_start(
    source: str | os.PathLike[str], learner: Learner, note: Callable[[str], object]
) -> tuple[InitialPolicy, dict[str, Tensor]]:
    """Return what a new run's configuration records of the policy it starts from, and weights [S, ...] for its learner.

    They are those of the policy, and where a network is free of counts all that fits. One seed's serve all seeds; as
    many seeds as the new run has serve one each. `note` is told what a user has to know of the policy.
    """
    trained = open_policy(Path(source))
    for text in trained.notes:
        note(text)
    config, held, seeds = trained.config, trained.policy.num_seeds, learner.policy.num_seeds
    own, given = learner.policy.state_dict(), {**trained.policy.state_dict(), **trained.further}
    fitting: dict[str, Tensor] = {}
    for name, tensors in learner.further_weights().items():
        theirs = {key: given.pop(key) for key in [*given] if key.startswith(f"{name}.")}
        if {key: t.shape[1:] for key, t in theirs.items()} == {key: t.shape[1:] for key, t in tensors.items()}:
            fitting |= theirs
    if held not in (1, seeds):
        raise UserError(
            f"cannot start {seeds} seed(s) from {trained.source}, which holds {held}; train {held} seeds, or start "
            "from a policy of one seed"
        )
    # names before shapes: those that differ are of another algorithm or network
    for name in [*sorted(own.keys() ^ given.keys()), *sorted(own.keys() & given.keys())]:
        here, there = (list(side[name].shape[1:]) if name in side else None for side in (own, given))
        if here != there:
            of_it = f"'{name}' is {'missing' if there is None else there} there"
            of_this = "missing" if here is None else here
            algorithm = "the algorithm, " if here is None or there is None else ""
            raise UserError(
                f"cannot start from {trained.source}: it is a policy of {config.algorithm} on {config.task} with the "
                f"network {config.network.name}, and {of_it} but {of_this} in this run; choose {algorithm}the task "
                f"settings and the network of that policy (--network {config.network.name})"
            )
    weights = {name: t.cpu().expand(seeds, *t.shape[1:]).contiguous() for name, t in {**given, **fitting}.items()}
    return InitialPolicy(source=os.fspath(source), sha256=digest(weights, {})), weights


def _seen_in_one(was: list[TaskSpec], now: list[TaskSpec]) -> list[str]:
    """Return the families that a role sees in one of two specs alone, if what it sees in the other is the rest."""
    sets = [[{family.name for family in role.observation.families} for role in roles] for roles in (was, now)]
    pairs = list(zip(*sets, strict=True))
    nested = all(one <= other or other <= one for one, other in pairs)
    return sorted({name for one, other in pairs for name in one ^ other}) if nested else []


def _untrained(config: RunConfig, spec: TaskSpec) -> Policy:
    network = _at_default(config.network, "compiled")  # using a policy needs no compiler
    policy = new_policy(ALGORITHMS[config.algorithm], spec, network, generators(config.seeds, "shape"))
    return policy.to(config.device).eval()


def _at_default(network: NetworkConfig, *names: str) -> NetworkConfig:
    """Return a network's settings with some of them, where it has them, as they are by default; `compiled` is off."""
    fields = type(network).model_fields
    chosen = {name: fields[name].default for name in names if name in fields}
    return network.model_copy(update=chosen | {name: False for name in chosen if name == "compiled"})


def _build(
    path: Path, config: RunConfig, tensors: dict[str, Tensor], meta: Mapping[str, Any], notes: tuple[str, ...] = ()
) -> TrainedPolicy:
    if config.device == "cuda" and not torch.cuda.is_available():
        config = config.model_copy(update={"device": "cpu"})
    if type(step := meta.get("step")) is not int or step < 0:
        raise UserError(f"{path} is damaged: it does not say after how many steps it was written")
    misfit = f"{path}: the weights do not fit the configuration beside them"
    # Checked before worlds are made for every seed: a damaged configuration may ask for more than the memory holds.
    if {tuple(tensor.shape[:1]) for tensor in tensors.values()} != {(len(config.seeds),)}:
        raise UserError(f"{misfit} (seeds {', '.join(map(str, config.seeds[:10]))})")
    spec = spec_of(config)
    if (version := meta.get("task_version", spec.version)) != spec.version:
        raise UserError(
            f"{path} was trained on {config.task} version {str(version)[:20]}, but this is version {spec.version}, in "
            "which observations, actions or rewards differ; use the esp that it was trained with, or train again"
        )
    # Checked before networks are made, for the same reason.
    needed = len(config.seeds) * config.network.least_parameters(spec.observation.width)
    if needed > sum(tensor.numel() for tensor in tensors.values()):
        raise UserError(f"{misfit} (hidden widths {config.network.hidden})")
    policy = _untrained(config, spec)
    _fill(policy, tensors, path, misfit)
    if stopped := _stopped(meta, len(config.seeds)):
        seeds = ", ".join(str(config.seeds[k]) for k in stopped)
        notes = (*notes, f"{path}: training of seed {seeds} stopped early on a number that is not finite")
    return TrainedPolicy(config, policy, spec, step, path, notes, stopped)


def _stopped(meta: Mapping[str, Any], seeds: int) -> tuple[int, ...]:
    named, returns = meta.get("stopped_seeds"), meta.get("greedy_returns")
    if isinstance(named, Mapping):
        return tuple(k for k in range(seeds) if str(k) in named)
    return tuple(k for k, value in enumerate(returns[:seeds]) if value is None) if isinstance(returns, list) else ()


def _fill(policy: Policy, tensors: dict[str, Tensor], path: Path, misfit: str) -> None:
    for name, own in policy.state_dict().items():
        # torch would convert them silently
        if name in tensors and tensors[name].dtype != own.dtype:
            raise UserError(f"{misfit} ({name} is {tensors[name].dtype}, where {own.dtype} is needed)")
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:
        raise UserError(f"{misfit} ({str(error).strip().splitlines()[-1].strip()})") from None
    if not all(bool(tensor.isfinite().all()) for tensor in tensors.values()):
        raise UserError(f"{path} holds weights that are not finite; use another copy of it, or train again")
