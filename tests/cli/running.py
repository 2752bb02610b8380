"""Commands run in this process, and policies that a user might hand over by mistake or by malice."""

import json
import pickle
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

from typer.testing import CliRunner, Result

from esp_cli.app import app
from esp_cli.training.checkpoint import POLICY_FORMAT, load_checkpoint, save_checkpoint
from tests.training.runs import TINY

TINY_OPTIONS = [part for name, value in TINY.items() for part in ("--set", f"{name}={json.dumps(value)}")]
"""50 steps an iteration; a run takes milliseconds."""
STEPS = ["--steps", "150"]

_runner = CliRunner()


def esp(*arguments: object, code: int = 0) -> Result:
    """Run a command line in this process and check its exit code; a bug keeps its traceback."""
    result = _runner.invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result


def refused(*arguments: object) -> str:
    """Run a command line that has to end in one sentence and exit code 2; return the sentence."""
    result = esp(*arguments, code=2)
    assert result.stdout == ""
    assert result.stderr.startswith("error: "), result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
    assert "Traceback" not in result.stderr
    return result.stderr.removeprefix("error: ").strip()


def train_tiny(out: Path, *options: object, steps: object = 150) -> Path:
    """Train a tiny run, of a perceptron unless the options name a preset or another network, and return its folder."""
    network = () if "--preset" in options else ("--network", "mlp")
    esp("train", *network, *TINY_OPTIONS, "--steps", steps, "--out", out, *options)
    return out


def printed(*options: object) -> dict[str, Any]:
    return json.loads(esp("train", "--print-config", *options).stdout)


def written(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def stored_config(run: Path) -> dict[str, Any]:
    """Return what a run folder says of its configuration, as `--print-config` prints it: without its identity."""
    document = json.loads((run / "config.json").read_text())
    del document["run_id"]
    return document


def edit_config(run: Path, **changes: Any) -> Path:
    file = run / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return run


def _edit_policy(run: Path, format_name: str = POLICY_FORMAT, **changes: Any) -> Path:
    """Write a policy file whose checksum is right and whose description is not."""
    file = run / "policy.safetensors"
    tensors, meta = load_checkpoint(file, format_name=POLICY_FORMAT)
    save_checkpoint(file, tensors, meta | changes, format_name=format_name)
    return file


def _edit_policy_config(run: Path, **changes: Any) -> Path:
    config = load_checkpoint(run / "policy.safetensors", format_name=POLICY_FORMAT)[1]["config"]
    return _edit_policy(run, config=config | changes)


def _rewrite(file: Path, content: bytes) -> Path:
    file.write_bytes(content)
    return file


def _truncate(file: Path) -> Path:
    return _rewrite(file, file.read_bytes()[:-5])


def _without_checkpoints(run: Path) -> Path:
    shutil.rmtree(run / "checkpoints")
    (run / "policy.safetensors").unlink()
    return run


def _with_truncated_checkpoints(run: Path) -> Path:
    for file in (run / "checkpoints").iterdir():
        _truncate(file)
    (run / "policy.safetensors").unlink()
    return run


class _Bomb:
    """Leaves a trace when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.mkdir, (self.trace,)


def _pickle(run: Path) -> Path:
    return _rewrite(run / "policy.safetensors", pickle.dumps(_Bomb(run / "exploded")))


DAMAGE: dict[str, tuple[Callable[[Path], Path], str]] = {
    "nothing there": (lambda run: run / "nothing", "does not exist"),
    "a folder without a run": (lambda run: run / "checkpoints", "is no run folder"),
    "no checkpoint yet": (_without_checkpoints, "holds no checkpoint yet; train on with esp train --resume"),
    "truncated checkpoints": (_with_truncated_checkpoints, "has no good checkpoint"),
    "config that is no JSON": (lambda run: _rewrite(run / "config.json", b"{").parent, "is not valid JSON"),
    "config of another program": (lambda run: edit_config(run, format="other"), "is foreign"),
    "config of a newer version": (lambda run: edit_config(run, version=99), "newer esp"),
    "seeds that are a text": (lambda run: edit_config(run, seeds="many"), "bad value 'many' for 'config.seeds'"),
    "steps that are negative": (lambda run: edit_config(run, steps=-5), "bad value -5 for 'config.steps'"),
    "a network that is a number": (lambda run: edit_config(run, network=5), "bad value 5 for 'config.network'"),
    "a device nobody has": (lambda run: edit_config(run, device="tpu"), "bad value 'tpu' for 'config.device'"),
    "a key nobody knows": (lambda run: edit_config(run, colour="red"), "unknown setting 'config.colour'"),
    "a task nobody has": (lambda run: edit_config(run, task="chess"), "unknown task 'chess'"),
    "an algorithm nobody has": (lambda run: edit_config(run, algorithm="magic"), "unknown algorithm 'magic'"),
    "task settings of another": (
        lambda run: edit_config(run, task_settings={"weather": 1}),
        "unknown setting 'task.weather'",
    ),
    "a network larger than the file": (
        lambda run: edit_config(run, network={"hidden": [4096] * 16}),
        "was written under another configuration",
    ),
    "a network of negative size": (lambda run: edit_config(run, network={"hidden": [-8]}), "bad value -8"),
    "another number of seeds": (lambda run: edit_config(run, seeds=[3]), "was written under another configuration"),
    "an empty policy file": (lambda run: _rewrite(run / "policy.safetensors", b""), "is no safetensors file"),
    "a text as a policy file": (lambda run: _rewrite(run / "notes.txt", b"train more, sleep less"), "safetensors"),
    "a truncated policy file": (lambda run: _truncate(run / "policy.safetensors"), "is truncated"),
    "a header larger than the file": (
        lambda run: _rewrite(run / "policy.safetensors", struct.pack("<Q", 2**62) + b"{}"),
        "the header that it declares does not fit",
    ),
    "a pickle file": (_pickle, "safetensors"),
    "a checkpoint as a policy file": (
        lambda run: next((run / "checkpoints").iterdir()),
        "is a file of the format 'esp-checkpoint', where 'esp-policy' is needed",
    ),
    "a policy without a config": (lambda run: _edit_policy(run, config=None), "bad value None for 'config'"),
    "a policy whose config is a list": (lambda run: _edit_policy(run, config=[1]), "bad value [1] for 'config'"),
    "a policy without steps": (lambda run: _edit_policy(run, step="many"), "after how many steps"),
    "a policy of another version": (
        lambda run: _edit_policy(run, task_version=0),
        "was trained on navigation version 0, but this is version 1",
    ),
    "a policy of another width": (
        lambda run: _edit_policy_config(run, network={"hidden": [4]}),
        "the weights do not fit the configuration",
    ),
}
"""What is handed over: a function that damages a copy of a run and returns what to name, and a part of the sentence."""
