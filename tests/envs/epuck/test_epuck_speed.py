"""The speed script of the e-pucks runs, prints its table and writes JSON."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_the_script_measures_and_writes_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    script = importlib.import_module("epuck_speed")
    out = tmp_path / "speed.json"
    arguments = ["--worlds", "2", "--seconds", "0.01", "--runs", "3", "--threads", "1", "--json", str(out)]
    monkeypatch.setattr(sys, "argv", ["epuck_speed.py", "--engine", "mujoco", "--engine", "pymunk", *arguments])
    before = torch.get_num_threads()
    script.main()
    torch.set_num_threads(before)
    records = json.loads(out.read_text())["records"]
    want = [(subject, engine, 1) for subject in ("physics", "formation") for engine in ("mujoco", "pymunk")]
    assert [(r["subject"], r["engine"], r["threads"]) for r in records] == want
    assert all(0 < r["least"] <= r["steps_per_second"] <= r["most"] for r in records)
    assert "formation" in capsys.readouterr().out
