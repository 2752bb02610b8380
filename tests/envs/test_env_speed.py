"""The speed scripts run, print their tables and write JSON."""

import importlib
import itertools
import json
import sys
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SUBJECTS = {
    "env_speed": ([], ("task",), [(task,) for task in ("navigation", "predator-prey", "wildlife")]),
    "epuck_speed": (
        ["--engine", "mujoco", "--engine", "pymunk", "--threads", "1"],
        ("subject", "engine"),
        list(itertools.product(("physics", "formation"), ("mujoco", "pymunk"))),
    ),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_the_script_measures_and_writes_json(name, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(BENCHMARKS)
    script = importlib.import_module(name)
    arguments, keys, expected = SUBJECTS[name]
    out = tmp_path / "speed.json"
    common = ["--worlds", "2", "--seconds", "0.01", "--runs", "3", "--json", str(out)]
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments, *common])
    before = torch.get_num_threads()
    script.main()
    torch.set_num_threads(before)
    records = json.loads(out.read_text())["records"]
    assert [tuple(record[key] for key in keys) for record in records] == expected
    assert all(0 < r["least"] <= r["steps_per_second"] <= r["most"] for r in records)
    assert expected[-1][0] in capsys.readouterr().out
