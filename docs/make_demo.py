"""Copy the picture and the film of `esp demo` into the documentation, with the numbers that their captions state.

esp demo --out runs/demo && python docs/make_demo.py runs/demo
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from pathlib import Path

from esp_cli.commands.demo import CURVES, FILM
from esp_cli.drawing.recording import record
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.reporting.collect import collect_study
from esp_cli.studies.study import StudyFolder

DOCS = Path(__file__).parent
PICTURES = {CURVES: "demo.png", FILM: "demo.gif"}
FILM_EPISODES = 3


def main(folder: Path) -> None:
    """Copy the files of a demo and write its results, the returns of its film, and digests of the pictures."""
    study = StudyFolder.open(folder)
    recorded = record([TrainedPolicy.read(study.run_path(c)).single_seed() for c in study.study.cells], FILM_EPISODES)
    returns = [sum(episode.returns[-1] for episode in own) / len(own) for own in recorded]
    for own, shipped in PICTURES.items():
        shutil.copyfile(folder / own, DOCS / "pictures" / shipped)
    shown = {
        "film": dict(zip((cell.variant for cell in study.study.cells), (round(x, 1) for x in returns), strict=True)),
        "sha256": {name: digest(DOCS / "pictures" / name) for name in PICTURES.values()},
    }
    results = collect_study(study).results.document()
    (DOCS / "measured" / "demo.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    (DOCS / "pictures" / "demo.json").write_text(json.dumps(shown, indent=1) + "\n", encoding="utf-8")


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
