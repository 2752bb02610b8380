"""The record of an assault: how far each part came, and what was found."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from esp_cli.files.writing import replace_file

SAVE_INTERVAL_S = 10.0


class Part:
    """One kind of assault; a case follows from the seed and its number."""

    done = 0
    """Kills that took effect, files or lines since they were counted."""

    def run(self, number: int) -> str | None:
        raise NotImplementedError

    def count(self) -> int:
        """Return what was done since the last call."""
        done, self.done = self.done, 0
        return done


@dataclass
class Finding:
    part: str
    number: int
    text: str


@dataclass
class Record:
    """How far an assault came.

    Attributes:
        seed: of all cases.
        cases: next case by part.
        counts: kills, files and lines so far.
        seconds: spent, by part.
    """

    seed: int
    path: Path | None = None
    cases: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    @classmethod
    def open(cls, path: Path | None, seed: int) -> Record:
        if path is None or not path.is_file():
            return cls(seed, path)
        found = json.loads(path.read_text())
        if found["seed"] != seed:
            raise SystemExit(f"{path} is the record of seed {found['seed']}; give --seed {found['seed']}")
        found["findings"] = [Finding(**item) for item in found["findings"]]
        return cls(path=path, **found)

    def run(self, name: str, part: Part, end: float, until: int) -> None:
        begun = saved = time.monotonic()
        earlier = self.seconds.get(name, 0.0)
        while time.monotonic() < end and self.counts.get(name, 0) < until:
            number = self.cases.get(name, 0)
            text = part.run(number)
            if text is not None:
                self.findings.append(Finding(name, number, text))
                print(f"{name} {number}: {text}", flush=True)
            self.cases[name] = number + 1
            self.counts[name] = self.counts.get(name, 0) + part.count()
            self.seconds[name] = earlier + time.monotonic() - begun
            if time.monotonic() - saved > SAVE_INTERVAL_S:
                self.save()
                saved = time.monotonic()
        self.save()

    def save(self) -> None:
        if self.path is not None:
            content = {key: value for key, value in asdict(self).items() if key != "path"}
            replace_file(self.path, json.dumps(content, indent=1).encode())

    def summary(self) -> str:
        parts = [f"{count} {name} in {self.seconds[name]:.0f} s" for name, count in self.counts.items()]
        return f"seed {self.seed}: {', '.join(parts)}; {len(self.findings)} findings"
