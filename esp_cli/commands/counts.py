"""Counts and seeds as people write them: 500k, 3M, ten seeds, the seeds 3 and 7."""

from __future__ import annotations

import re
from collections.abc import Iterable
from decimal import Decimal

from esp_cli.defaults import MAX_SEED, MAX_SEEDS, MAX_STEPS
from esp_envs.errors import UserError

_MULTIPLIERS = {"": 1, "k": 1_000, "m": 1_000_000, "g": 1_000_000_000}
_COUNT = re.compile(r"(?P<number>\d[\d_]*(?:\.\d+)?(?:e\d{1,2})?)\s*(?P<letter>[kmg]?)", re.IGNORECASE)
_SEED_LIST = re.compile(r"\d+(\s*,\s*\d+)*\s*,?")


def parse_count(value: str | int) -> int:
    """Read a positive number of steps, at most `MAX_STEPS`: 20000, 20_000, 500k, 1.5M, 2e6."""
    text = str(value).strip()
    match, how = _COUNT.fullmatch(text), "write for example 20000, 500k or 1.5M"
    if match is None:
        raise UserError(f"'{text}' is not a number of steps; {how}")
    count = Decimal(match["number"].replace("_", "")) * _MULTIPLIERS[match["letter"].lower()]
    if count != count.to_integral_value() or count < 1:
        raise UserError(f"'{text}' is not a whole, positive number of steps; {how}")
    if count > MAX_STEPS:
        raise UserError(f"'{text}' is more than the {MAX_STEPS:.0e} steps that can be asked for; write for example 3M")
    return int(count)


def parse_seeds(value: str | int) -> tuple[int, ...]:
    """Read how many seeds a run has: "10" means the ten seeds 0..9."""
    text = str(value).strip()
    if not re.fullmatch(r"\d{1,9}", text):
        raise UserError(f"'{text}' does not say how many seeds; write --seeds 10, or which, as --seed-list 3,7")
    if not 1 <= int(text) <= MAX_SEEDS:
        raise UserError(
            f"{text} seeds cannot be trained at once; ask for 1 to {MAX_SEEDS}, or name one by --seed-list {text}"
        )
    return tuple(range(int(text)))


def parse_seed_list(value: str | Iterable[int]) -> tuple[int, ...]:
    """Read the seeds of a run by their numbers: "3,7" means the seeds 3 and 7, "7" the seed 7 alone."""
    text = str(value).strip() if isinstance(value, str) else ",".join(map(str, value))
    if not _SEED_LIST.fullmatch(text):
        raise UserError(f"'{text}' is not a list of seeds; write their numbers, as 3,7")
    if re.search(r"\d{10}", text):
        raise UserError(f"'{text[:40]}' names a seed beyond {MAX_SEED}; write numbers from 0 to {MAX_SEED}")
    seeds = tuple(int(item) for item in text.split(",") if item.strip())
    if len(seeds) > MAX_SEEDS:
        raise UserError(f"{len(seeds)} seeds cannot be trained at once; name at most {MAX_SEEDS}")
    if len(set(seeds)) < len(seeds):
        raise UserError(f"the seeds '{text}' name one seed twice; name each once")
    return seeds


def chosen_seeds(
    counted: tuple[int, ...] | None, named: tuple[int, ...] | None, default: tuple[int, ...]
) -> tuple[int, ...]:
    """Return the seeds that `--seeds` or `--seed-list` asks for."""
    if named is not None and counted is not None:
        raise UserError("--seeds and --seed-list both say which seeds to train; leave one of them out")
    return counted or named or default
