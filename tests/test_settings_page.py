"""The settings table of the MAPPO page says what the code says."""

from __future__ import annotations

import re
from pathlib import Path

from esp_cli.algorithms.mappo import PRESETS, TUNED, MappoConfig
from esp_cli.networks.bodies import NetworkConfig
from esp_cli.prior import PriorConfig
from esp_cli.training.config import EvaluationConfig

PAGE = Path(__file__).parents[1] / "docs" / "mappo.md"
SECTIONS = {"mappo": MappoConfig, "network": NetworkConfig, "prior": PriorConfig, "evaluation": EvaluationConfig}
TUNED_ROW = re.compile(r"^\| (\w+) \| `(\w+\.\w+)` \| (\S+) \|$", re.MULTILINE)
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


def expected() -> dict[str, tuple[str, ...]]:
    """Return default and paper value of every setting."""
    table = {}
    for section, model in SECTIONS.items():
        paper = PRESETS["paper"].get(section, {})
        for name, field in model.model_fields.items():
            values = (field.default, paper.get(name, field.default))
            table[f"{section}.{name}"] = tuple(written(value) for value in values)
    return table


def test_what_a_task_changes_stands_on_the_page():
    rows = TUNED_ROW.findall(PAGE.read_text(encoding="utf-8"))
    changed = {
        (task, f"{section}.{name}", written(value))
        for task, sections in TUNED.items()
        for section, values in sections.items()
        for name, value in values.items()
    }
    assert {(task, name, value.strip("`")) for task, name, value in rows} == changed


def test_every_setting_stands_on_the_page_with_its_default_and_the_papers_value():
    rows = ROW.findall(PAGE.read_text(encoding="utf-8"))
    found = {f"{s}.{n}": (d.strip().strip("`"), p.strip().strip("`")) for s, n, d, p in rows}
    assert found == expected()
