"""Write esp_cli/settings_index.json from the models that hold the defaults: python docs/make_settings.py."""

from __future__ import annotations

import json
from dataclasses import asdict

from esp_cli.settings_index import INDEX
from esp_cli.training.settings import sections


def index() -> str:
    """Return the text of the index."""
    return json.dumps([asdict(section) for section in sections()], indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    INDEX.write_text(index(), encoding="utf-8")
    print(f"{INDEX} is written")
