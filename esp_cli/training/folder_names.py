"""The names of what a run folder holds."""

from __future__ import annotations

from pathlib import Path

from esp_cli.files.writing import TEMPORARY_PREFIX

CONFIG, METRICS, CHECKPOINTS = "config.json", "metrics.jsonl", "checkpoints"
POLICY, INITIAL, LOCK = "policy.safetensors", "initial-policy.safetensors", "run.lock"
LOG, FINAL = "log.txt", "final-evaluation.json"
"""Names of what a study adds to the folder of a run."""
STUDY, TUNING, STUDY_LOCK, JOURNAL = "study.json", "tuning.json", "study.lock", "journal.jsonl"
"""Names in the folder of a study or a tuning."""
FRESH = "fresh"
"""Name of the study, inside a tuning, that evaluates its best settings."""


def is_leftover(entry: Path) -> bool:
    """Return whether `RunFolder.create`, killed before its end, may have left this."""
    if entry.name == CHECKPOINTS:
        return entry.is_dir() and not any(entry.iterdir())
    if entry.name == METRICS:
        return entry.is_file() and entry.stat().st_size == 0
    return entry.name in (LOCK, INITIAL) or entry.name.startswith(TEMPORARY_PREFIX)
