"""Whether an export does what the policy does: both act on the same observations, thousands of them."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from esp_cli.export.c_source import FLAGS
from esp_cli.export.layers import Floats
from esp_cli.export.onnx_file import library
from esp_cli.export.program import Program
from esp_cli.networks.heads import masked
from esp_cli.networks.policy import Policy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import build_environment
from esp_envs.errors import UserError

OBSERVATIONS = 10_000
"""On which every export is compared with its policy."""
TOLERANCE = 1e-4
"""Largest difference of an output, as a share of the largest output (or of 1); float32 in another order gives 1e-6."""
_STEPS = 50

Numbers = NDArray[Any]
Runner = Callable[[Floats, Floats, Numbers | None], tuple[Numbers, Numbers, Numbers]]
"""(observation [B, D], memory [B, H], action mask [B, A] or None) to (action [B] or [B, width], outputs [B, O], memory
after [B, H])."""


@dataclass(frozen=True)
class Sample:
    """What the policy itself does, row by row: observation, memory, outputs, action, next memory, allowed actions."""

    obs: Floats
    memory: Floats
    outputs: Floats
    action: Numbers
    after: Floats
    mask: Numbers | None = None

    @property
    def choosable(self) -> Floats:
        """Outputs as the policy chooses among them: those of forbidden actions are out of reach."""
        mask = None if self.mask is None else torch.from_numpy(self.mask)
        return masked(torch.from_numpy(self.outputs), mask).numpy()


@dataclass(frozen=True)
class Agreement:
    """How far an export is from the policy.

    Attributes:
        observations: compared.
        max_difference: of an output, an action's number or the memory after it.
        other_actions: choices that differ, each of them a tie within rounding; None where the head does not choose.
    """

    observations: int
    max_difference: float
    other_actions: int | None


@torch.no_grad()
def take_sample(alone: TrainedPolicy, program: Program, count: int = OBSERVATIONS) -> Sample:
    """Let one seed's policy act: one half on observations that it meets in its task, one half on random ones.

    Of a team every world is whole, so there may be a few observations more.
    """
    met = _met(alone, _whole(count // 2, program.team))
    missing = _whole(count - len(met[0]), program.team)
    rng = np.random.default_rng(0)
    obs = rng.standard_normal((missing, program.num_inputs), np.float32)
    memory = rng.uniform(-1, 1, (missing, program.memory_width)).astype(np.float32)
    if program.previous and program.head == "choose":
        memory[:, program.hidden :] = np.eye(program.previous)[rng.integers(program.previous, size=missing)]
    rows = torch.cat([met[0], torch.from_numpy(obs)]), torch.cat([met[1], torch.from_numpy(memory)])
    mask = None
    if met[2] is not None:
        mask = torch.cat([met[2], torch.from_numpy(rng.random((missing, program.num_outputs)) < 0.6)])
    allowed = None if mask is None else mask[None, None]
    action, after = alone.policy.act(rows[0][None, None], rows[1][None], action_mask=allowed)
    outputs = _raw_outputs(alone.policy, *rows)
    width = action.shape[3:]
    parts = (rows[0], rows[1], outputs, action.reshape(len(rows[0]), *width), after[0])
    seen, carried, told, done, kept = (part.numpy() for part in parts)
    return Sample(seen, carried, told, done, kept, None if mask is None else mask.numpy())


def _whole(count: int, team: int) -> int:
    return math.ceil(count / team) * team


def _met(alone: TrainedPolicy, count: int) -> tuple[Tensor, Tensor, Tensor | None]:
    """Play a little and return the first observations, memories and action masks that the policy meets."""
    steps = min(_STEPS, alone.spec.horizon)
    env = build_environment(alone.config, math.ceil(count / (steps * alone.spec.num_agents)), "export")
    observation = env.reset()
    memory = alone.policy.initial_memory(env.num_envs, observation.obs)
    seen, carried, masks = [], [], []
    for _ in range(steps):
        seen.append(observation.obs.flatten(0, 2))
        carried.append(memory[0])
        mask = observation.action_mask
        masks += [] if mask is None else [mask.flatten(0, 2)]
        action, memory = alone.policy.act(observation.obs, memory, action_mask=mask)
        observation = env.step(action).next
    return torch.cat(seen)[:count], torch.cat(carried)[:count], torch.cat(masks)[:count] if masks else None


def _raw_outputs(policy: Policy, obs: Tensor, memory: Tensor) -> Tensor:
    """Return what the actor's last layer says, before its head normalises it: [B, O]."""
    hidden, previous = memory.split([policy.actor.memory_width, memory.shape[1] - policy.actor.memory_width], 1)
    return policy.actor.step(torch.cat([obs, previous], 1)[None], hidden[None])[0][0]


def compare(sample: Sample, runner: Runner) -> Agreement:
    """Compare an export with the policy.

    Raises:
        RuntimeError: they do not agree, which is a bug.
        UserError: they cannot agree, since the rounding of the observations moves the outputs as far.
    """
    action, outputs, after = runner(sample.obs, sample.memory, sample.mask)
    largest = max(1.0, float(np.abs(sample.outputs).max()))
    gap = float(np.abs(outputs - sample.outputs).max())
    differing = np.zeros(len(sample.obs), bool)
    if sample.action.dtype.kind == "i":
        differing = action != sample.action
        first, second = np.sort(sample.choosable[differing], 1)[:, ::-1][:, :2].T
        ties = bool((first - second <= 2 * TOLERANCE * largest).all())
        same = ~differing  # after another choice the memory holds another previous action
    else:
        gap = max(gap, float(np.abs(action - sample.action).max()))
        ties, same = True, ~differing
    if sample.after.size:
        gap = max(gap, float(np.abs(after[same] - sample.after[same]).max()))
    if not gap <= TOLERANCE * largest or not ties:
        _refuse_ill_conditioned(sample, runner, outputs, max(gap / 10, TOLERANCE * largest))
        raise RuntimeError(f"the export differs from the policy by {gap:g} of {largest:g}; this is a bug")
    others = int(differing.sum()) if sample.action.dtype.kind == "i" else None
    return Agreement(len(sample.obs), gap, others)


def _refuse_ill_conditioned(sample: Sample, runner: Runner, outputs: Floats, most: float) -> None:
    """Raise a ValueError where the rounding of float32 in observations moves an output by more than `most`."""
    rounded = np.nextafter(sample.obs, np.float32(np.inf))
    moved = float(np.abs(runner(rounded, sample.memory, sample.mask)[1] - outputs).max())
    if moved > most:
        raise UserError(
            f"the policy says {moved:g} more or less for observations that differ by the rounding of float32, so no "
            "export can agree with it; train it with a smaller learning rate"
        )


def numpy_runner(file: Path) -> Runner:
    """Run a written Python file."""
    spec = spec_from_file_location(f"esp_exported_{id(file)}", file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)

    def run(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        count, team = len(obs), module.POLICY.program["team"]
        lead = (count // team, team) if team > 1 else (count,)
        given = [rows.reshape(*lead, rows.shape[1]) for rows in (obs, memory)]
        allowed = [] if mask is None else [mask.reshape(*lead, mask.shape[1])]
        results = (*module.POLICY.step(*given, *allowed), module.POLICY.outputs(*given)[0])
        action, after, outputs = (rows.reshape(count, *rows.shape[len(lead) :]) for rows in results)
        return action, outputs, after

    return run


def onnx_runner(file: Path) -> Runner:
    """Run a written ONNX model with onnxruntime."""
    session = library("onnxruntime").InferenceSession(str(file), providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]

    def run(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        given = {"observation": obs, "memory": memory, "action_mask": mask}
        results = session.run(None, {name: given[name] for name in names})
        return results[0], results[1], results[2] if len(results) > 2 else memory

    return run


def torch_runner(file: Path) -> Runner:
    """Run a written torch.export archive."""
    module = torch.export.load(file).module()

    def run(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        allowed = {} if mask is None else {"action_mask": torch.from_numpy(mask)}
        given = [torch.from_numpy(array) for array in (obs, memory) if array.shape[1]]
        with torch.no_grad():
            results = [result.numpy() for result in module(*given, **allowed)]
        return results[0], results[1], results[2] if len(results) > 2 else memory

    return run


def compiler() -> str | None:
    """Return this machine's C compiler, or None."""
    return shutil.which("cc")


def compiled(*files: Path) -> ctypes.CDLL:
    """Compile written C sources into a library beside the first, with every warning an error.

    Raises:
        RuntimeError: they do not compile, which is a bug.
    """
    shared = files[0].with_suffix(".so")
    command = [compiler() or "cc", *FLAGS, "-shared", "-fPIC", *map(str, files), "-o", str(shared), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"the exported C does not compile; this is a bug\n{done.stderr}")
    return ctypes.CDLL(str(shared))


def c_runner(file: Path, program: Program) -> Runner:
    """Compile a written C source and call it row by row.

    Raises:
        RuntimeError: it does not compile, which is a bug.
    """
    code = compiled(file)
    pointer = ctypes.POINTER(ctypes.c_float)
    code.esp_policy_outputs.restype = pointer
    choose, team = program.head == "choose", program.team
    act = code.esp_policy_act
    act.restype = ctypes.c_int if choose and team == 1 else None

    flags = ctypes.POINTER(ctypes.c_ubyte)

    def run_team(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        obs, bits = np.ascontiguousarray(obs), None if mask is None else mask.astype(np.uint8)
        outputs = np.empty((len(obs), program.num_outputs), np.float32)
        action = np.empty(len(obs), np.intc)
        for k in range(0, len(obs), team):
            allowed = [] if bits is None else [bits[k:].ctypes.data_as(flags)]
            act(obs[k:].ctypes.data_as(pointer), *allowed, action[k:].ctypes.data_as(ctypes.POINTER(ctypes.c_int)))
            for i in range(team):
                outputs[k + i] = np.ctypeslib.as_array(code.esp_policy_outputs(i), (program.num_outputs,))
        return action, outputs, memory

    def run(obs: Floats, memory: Floats, mask: Numbers | None = None) -> tuple[Numbers, Numbers, Numbers]:
        obs, after, bits = np.ascontiguousarray(obs), memory.copy(), None if mask is None else mask.astype(np.uint8)
        outputs = np.empty((len(obs), program.num_outputs), np.float32)
        action: Numbers = np.empty(len(obs), np.int64) if choose else np.empty_like(outputs)
        for k in range(len(obs)):
            given = [*([after[k]] if program.memory_width else []), *([] if choose else [action[k]])]
            allowed = [] if bits is None else [bits[k].ctypes.data_as(flags)]
            rest = (array.ctypes.data_as(pointer) for array in given)
            chosen = act(obs[k].ctypes.data_as(pointer), *allowed, *rest)
            if choose:
                action[k] = chosen
            outputs[k] = np.ctypeslib.as_array(code.esp_policy_outputs(), (program.num_outputs,))
        return action, outputs, after

    return run if team == 1 else run_team


def example_runs(folder: Path) -> bool:
    """Compile and run the worked example of a C export; return whether it gives the expected action."""
    program = folder / "example"
    files = [str(folder / name) for name in ("policy_example.c", "policy.c")]
    subprocess.run([compiler() or "cc", *FLAGS, *files, "-o", str(program), "-lm"], check=True, capture_output=True)
    return subprocess.run([str(program)], check=False, capture_output=True).returncode == 0
