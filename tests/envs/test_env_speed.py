"""The speed script runs, prints its table and writes JSON."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "env_speed.py"


def test_the_script_measures_and_writes_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = importlib.util.spec_from_file_location("env_speed", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    out = tmp_path / "speed.json"
    arguments = ["--worlds", "8", "--seconds", "0.01", "--runs", "3", "--json", str(out)]
    monkeypatch.setattr(sys, "argv", ["env_speed.py", *arguments])
    before = torch.get_num_threads()
    script.main()
    torch.set_num_threads(before)
    records = json.loads(out.read_text())["records"]
    tasks = ("navigation", "predator-prey", "wildlife")
    assert [(r["task"], r["worlds"], r["runs"]) for r in records] == [(task, 8, 3) for task in tasks]
    assert all(0 < r["least"] <= r["steps_per_second"] <= r["most"] for r in records)
    assert "predator-prey" in capsys.readouterr().out
