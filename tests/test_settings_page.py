"""The settings table of each algorithm's page says what the code says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from esp_cli.algorithms.presets import FAST, PRESETS, TUNED, Sections
from esp_cli.algorithms.registry import ALGORITHMS
from esp_cli.networks.build import NETWORKS
from esp_cli.prior import PriorConfig
from esp_cli.training.config import EvaluationConfig

DOCS = Path(__file__).parents[1] / "docs"
SHARED: dict[str, tuple[type[BaseModel], ...]] = {
    "network": tuple(NETWORKS.values()),
    "prior": (PriorConfig,),
    "evaluation": (EvaluationConfig,),
}
TUNED_ROW = re.compile(r"^\| ([\w-]+) \| `(\w+\.\w+)` \| (\S+) \|$", re.MULTILINE)
FAST_ROW = re.compile(r"^\| ([\w-]+), fast \| `(\w+\.\w+)` \| (\S+) \|$", re.MULTILINE)
ROW = re.compile(r"\| `(\w+)\.(\w+)` \| ([^|]+) \| ([^|]+) \|")


def written(value: object) -> str:
    """Write a setting as the page does, without its back-quotes."""
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    if isinstance(value, float):
        return f"{value:.0e}".replace("e-0", "e-") if 0 < value < 0.005 else f"{value:g}"
    return str(value)


def expected(algorithm: str) -> dict[str, tuple[str, ...]]:
    """Return default and paper value of every setting."""
    table = {}
    for section, models in ({algorithm: (ALGORITHMS[algorithm].config_class,)} | SHARED).items():
        presets = [PRESETS[algorithm][preset].get(section, {}) for preset in ("default", "paper")]
        # the first network stands for all: a field of two networks has one default
        fields = {name: field for model in reversed(models) for name, field in model.model_fields.items()}
        for name, field in fields.items():
            table[f"{section}.{name}"] = tuple(written(preset.get(name, field.default)) for preset in presets)
    return table


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize(("pattern", "changes"), [(TUNED_ROW, TUNED), (FAST_ROW, FAST)], ids=["default", "fast"])
def test_what_a_preset_changes_on_a_task_stands_on_the_page(
    algorithm: str, pattern: re.Pattern[str], changes: dict[str, dict[str, Sections]]
) -> None:
    rows = pattern.findall((DOCS / f"{algorithm}.md").read_text(encoding="utf-8"))
    changed = {
        (task, f"{section}.{name}", written(value))
        for task, sections in changes.get(algorithm, {}).items()
        for section, values in sections.items()
        for name, value in values.items()
    }
    assert {(task, name, value.strip("`")) for task, name, value in rows} == changed


def expected_on_its_page(algorithm: str) -> dict[str, tuple[str, ...]]:
    """Return what the page of an algorithm states: shared settings stand on MAPPO's, unless their values differ."""
    whole, elsewhere = expected(algorithm), expected("mappo")
    if algorithm == "mappo":
        return whole
    return {name: values for name, values in whole.items() if elsewhere.get(name) != values}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_setting_stands_on_the_page_with_its_default_and_the_papers_value(algorithm: str) -> None:
    rows = ROW.findall((DOCS / f"{algorithm}.md").read_text(encoding="utf-8"))
    found = {f"{s}.{n}": (d.strip().strip("`"), p.strip().strip("`")) for s, n, d, p in rows}
    assert found == expected_on_its_page(algorithm)
