"""Trains small runs through the command line and hashes the weights that they end with.

    python tests/learning/golden.py             # write golden_weights.json anew
    python tests/learning/golden.py --add       # add this processor to it
    python tests/learning/golden.py CASE ...    # print the hashes of some cases

Processors round otherwise, so the file has hashes for each kind of them, which began as those of commit 1b792e9 on the
first. Write them anew only for a change that is meant to change results. To take them from another commit, put its
checkout first on the path:

    PYTHONPATH=OTHER:OTHER/environments python tests/learning/golden.py --add

This module therefore uses nothing of the project but its command line and the tensors of a final checkpoint.
"""

import hashlib
import json
import os
import shlex
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import mujoco
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional as F
from typer.testing import CliRunner

from esp_cli.app import app

torch.set_num_threads(1)  # threads share the rows of a sum, so their number decides how it rounds

HASHES = Path(__file__).with_name("golden_weights.json")

_NAVIGATION = "--task navigation --network mlp --set mappo.num_envs=8 --set mappo.num_epochs=3 --steps 800"
_OFF_POLICY = "--seeds 2 --steps 1000 --set network.hidden=[16,16]"
_FORMATION = "--task formation --seeds 2 --set task.horizon=40 --set task.num_agents=3"
_WILDLIFE = "--task wildlife --seeds 2 --set task.horizon=16 --set network.hidden=[8,8]"

CASES: dict[str, str] = {
    # every algorithm and every task
    "navigation mappo": "--task navigation --network mlp --seeds 2 --steps 5k",
    "navigation mappo, sets": "--task navigation --seeds 2 --steps 3200 --set mappo.num_envs=16",
    "navigation mappo, all of c4, recomputed": (
        "--task navigation --network mlp --seeds 2 --steps 5k --transforms c4"
        " --set prior.copies=all --set prior.old_log_prob=recompute"
    ),
    "predator-prey mappo gru": (
        "--task predator-prey --seeds 2 --network gru --set mappo.num_envs=8 --set mappo.num_epochs=3 --steps 800"
    ),
    "navigation maddpg": f"--task navigation --network mlp --algo maddpg {_OFF_POLICY}",
    "navigation maddpg, sets": f"--task navigation --algo maddpg {_OFF_POLICY}",
    "navigation qmix, sets": f"--task navigation --algo qmix {_OFF_POLICY}",
    "predator-prey qmix": f"--task predator-prey --algo qmix {_OFF_POLICY}",
    "formation mappo": f"{_FORMATION} --set mappo.num_envs=4 --set mappo.num_steps=40 --steps 320",
    "wildlife mappo": f"{_WILDLIFE} --set mappo.num_envs=8 --steps 256",
    # the parts of the prior and the kinds of elements
    "plain": f"{_NAVIGATION} --prior none",
    "augmentation alone, all copies": f"{_NAVIGATION} --prior augment --set prior.copies=all --transforms rot90,flip-x",
    "agents permuted": f"{_NAVIGATION} --transforms d4*agents --seeds 2",
    "agents permuted, a value each": (
        f"{_NAVIGATION} --transforms agents --set mappo.critic_input=own --set mappo.clip_value=true"
    ),
    "a reward each": f"{_NAVIGATION} --transforms d2*agents --set task.convention=pettingzoo",
    "sampled rotations, forces": f"{_NAVIGATION} --transforms so2 --set task.actions=continuous --seeds 2",
    "sampled rotations and reflections": f"{_NAVIGATION} --transforms o2*agents --set task.actions=continuous",
    "clipped values, recomputed": (
        f"{_NAVIGATION} --set mappo.clip_value=true --set prior.old_log_prob=recompute --transforms d4*agents"
    ),
    "gru, clipped values, recomputed": (
        f"{_NAVIGATION} --network gru --set mappo.clip_value=true --set prior.old_log_prob=recompute"
        " --set network.layer_norm=true"
    ),
    "bfloat16, small chunks": f"{_NAVIGATION} --set network.precision=bfloat16 --set mappo.chunk_steps=30",
    "paper's mappo": "--task navigation --preset paper --set mappo.num_envs=8 --set mappo.num_epochs=3 --steps 400",
    "the prey learns": (
        "--task predator-prey --set task.control=prey --set mappo.num_envs=8 --set mappo.num_epochs=3 --steps 400"
    ),
    # networks that know what they read
    "equivariant": f"{_NAVIGATION} --network equivariant --set network.hidden=[16,16]",
    "equivariant message passing": (
        f"{_WILDLIFE} --network empn --set mappo.num_envs=4 --transforms d4*agents --steps 64"
    ),
    "symmetrised": f"{_NAVIGATION} --set network.symmetrise=c4 --set network.hidden=[16,16]",
    # off-policy learners
    "maddpg, stored copies": (
        f"--task navigation --network mlp --algo maddpg {_OFF_POLICY} --transforms rot90"
        " --set prior.replay=stored --set maddpg.actor_actions=own"
    ),
    "maddpg, a reward each": (
        f"--task navigation --network mlp --algo maddpg {_OFF_POLICY} --set task.convention=pettingzoo"
        " --transforms rot90,flip-y*agents-1-2-0 --set prior.copies=all --set prior.replay=stored"
    ),
    "paper's maddpg": "--task navigation --algo maddpg --preset paper --set maddpg.rounds=10 --steps 250",
    "qmix gru, all copies": (
        f"--task navigation --algo qmix {_OFF_POLICY} --network gru --transforms rot90,agents-1-2-0"
        " --set prior.copies=all --set qmix.target_every=10"
    ),
    "paper's qmix": "--task navigation --algo qmix --preset paper --set qmix.rounds=10 --steps 250",
    # wheel pairs and pictures
    "formation maddpg": f"{_FORMATION} --algo maddpg --set network.hidden=[16] --steps 640 --transforms d4*agents",
    "formation qmix": f"{_FORMATION} --algo qmix --set network.hidden=[16] --steps 640 --transforms d4",
    "formation mappo, pymunk": (
        f"{_FORMATION} --physics pymunk --transforms d4*agents"
        " --set mappo.num_envs=2 --set mappo.num_steps=40 --steps 80"
    ),
    "wildlife maddpg": f"{_WILDLIFE} --algo maddpg --steps 256",
    "wildlife qmix": f"{_WILDLIFE} --algo qmix --transforms d4*agents --steps 256",
}
"""Names to what stands behind `esp train` beside the folder; the first two take some hundred gradient steps."""
_QUIET = ["--set", "evaluation.episodes=1", "--set", "evaluation.every_steps=1000000"]
_NO_WEIGHTS = ("optimiser.", "generators.", "collector.", "counters", "replay.")
"""Prefixes of what a checkpoint holds beside networks and statistics."""


def train(case: str, folder: Path, *changes: str) -> str:
    arguments = ["train", *shlex.split(CASES[case]), *_QUIET, *changes, "--out", str(folder)]
    result = CliRunner().invoke(app, arguments)
    if result.exit_code:
        raise RuntimeError(f"esp {shlex.join(arguments)} ends with {result.exit_code}: {result.output}")
    return final_weights(folder)


def final_weights(folder: Path) -> str:
    """Return the hash of the networks, target networks and normalisers that a finished run ends with."""
    (checkpoint,) = (folder / "checkpoints").iterdir()
    tensors = load_file(checkpoint)
    return digest({name: tensor for name, tensor in tensors.items() if not name.startswith(_NO_WEIGHTS)})


def digest(tensors: Mapping[str, Tensor]) -> str:
    """Return the hash of a set of tensors, whatever their names and their order.

    Each tensor gives one hash of its dtype, shape and bytes; the sorted hashes are hashed.
    """
    parts = sorted(hashlib.sha256(_described(tensor)).digest() for tensor in tensors.values())
    return hashlib.sha256(b"".join(parts)).hexdigest()


def _described(tensor: Tensor) -> bytes:
    content = tensor.detach().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
    return f"{tensor.dtype} {list(tensor.shape)} ".encode() + content


def probe() -> str:
    """Return the hash of fixed computations with the operations of training, and nothing of the project.

    Where it differs from those on file, processor or libraries round otherwise, and no run can have those weights.
    """
    generator = torch.Generator().manual_seed(0)
    results: dict[str, Tensor] = {"physics": _fall()}
    for seeds, rows, inputs, outputs in ((2, 600, 18, 64), (2, 1000, 64, 64), (1, 320, 64, 1), (2, 96, 7, 5)):
        x = torch.randn(seeds, rows, inputs, generator=generator)
        weight = torch.randn(seeds, inputs, outputs, generator=generator).requires_grad_()
        bias = torch.zeros(seeds, 1, outputs, requires_grad=True)
        optimiser = torch.optim.Adam([weight, bias], 1e-3, eps=1e-5, fused=True)
        for step in range(4):
            dtype = torch.bfloat16 if step == 3 else torch.float32
            y = torch.baddbmm(bias.to(dtype), x.to(dtype), weight.to(dtype)).float()
            gates = y.sigmoid() * y.tanh() + F.softplus(y) + y.relu()
            loss = gates.log_softmax(-1).exp().square().flatten(1).mean(1) + y.tanh().sum((1, 2)) / rows
            optimiser.zero_grad()
            loss.sum().backward()
            assert weight.grad is not None
            weight.grad *= 1 / (weight.grad.square().sum((1, 2), keepdim=True).sqrt() + 1e-6)
            optimiser.step()
        results |= {f"{rows} {name}": t for name, t in {"weight": weight, "bias": bias, "loss": loss}.items()}
    angle = torch.randn(1000, generator=generator)
    kernel = torch.randn(8, 3, 3, 3, generator=generator)
    results["functions"] = torch.stack([angle.sin(), angle.cos(), angle.exp(), angle.abs().log(), angle.abs().sqrt()])
    results["pictures"] = F.conv2d(torch.randn(20, 3, 21, 21, generator=generator), kernel)
    return digest(results)


def _fall() -> Tensor:
    """Let two balls and a plane collide, as MuJoCo computes it: [steps, 14]."""
    ball = '<body pos="{} 0 .2"><freejoint/><geom size=".1" mass=".1"/></body>'
    text = (
        f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{ball.format(0)}{ball.format(0.17)}</worldbody></mujoco>'
    )
    model = mujoco.MjModel.from_xml_string(text)
    data, rows = mujoco.MjData(model), []
    for _ in range(200):
        mujoco.mj_step(model, data)
        rows.append(torch.from_numpy(data.qpos.copy()))
    return torch.stack(rows)


def on_file() -> dict[str, dict[str, str]]:
    """Return the hashes of all cases, by the probe of the processors that reach them."""
    hashes: dict[str, dict[str, str]] = json.loads(HASHES.read_text())
    return hashes


def measure(cases: Iterable[str]) -> dict[str, str]:
    with tempfile.TemporaryDirectory() as folder:
        return {case: train(case, Path(folder) / str(k)) for k, case in enumerate(cases)}


if __name__ == "__main__":
    if sys.argv[1:] in ([], ["--add"]):
        others = on_file() if sys.argv[1:] else {}
        HASHES.write_text(json.dumps(others | {probe(): measure(CASES)}, indent=2) + "\n")
    else:
        print(json.dumps(measure(sys.argv[1:]), indent=2))
