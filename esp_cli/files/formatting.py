"""How numbers and names are written for people, on the screen as on pages."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from html import escape
from itertools import takewhile
from pathlib import Path
from unicodedata import category

from esp_envs.errors import UserError

NOTHING = "-"
_MARKUP = re.compile(r"[\\`*<|]|\](?=\()")


def escaped(text: str) -> str:
    r"""Return a text in which what cannot be printed is written as "\x1b"; line breaks, tabs and spaces stay."""
    return text if text.isprintable() else "".join(c if _stays(c) else repr(c)[1:-1] for c in text)


def _stays(character: str) -> bool:
    return character.isprintable() or character in "\n\t" or category(character) == "Zs"


def format_mean(mean: float | None, sem: float | None = None) -> str:
    """Return "mean ± standard error", the mean alone where one sample leaves no error to state, a dash for no mean."""
    if mean is None:
        return NOTHING
    return f"{mean:.2f} ± {sem:.2f}" if sem is not None and math.isfinite(sem) else f"{mean:.2f}"


def format_p(p: float | None) -> str:
    """Return what to write of a p-value: "= 0.012", "< 0.001", or "-"."""
    return NOTHING if p is None else f"= {p:.3f}" if p >= 0.001 else "< 0.001"


def format_interval(interval: Sequence[float] | None) -> str:
    """Return an interval (low, high) as "[low, high]", and a dash for none."""
    if interval is None:
        return NOTHING
    low, high = interval
    return f"[{low:.2f}, {high:.2f}]"


def name_of(path: Path) -> str:
    """Return the name of a file or folder, of "." too; a link keeps its own."""
    return path.resolve().name if path.name in ("", "..") else path.name


def file_name(text: str) -> str:
    """Return a name for a folder: "rot90, rot180" -> "rot90-rot180", "mine:Task" -> "mine-task"; ASCII alone."""
    words = "".join(c if (c.isascii() and c.isalnum()) or c == "." else " " for c in text.lower()).split()
    return "-".join(word.strip(".") for word in words if word.strip(".")) or "unnamed"


def format_span(counts: Collection[int]) -> str:
    """Return the smallest to the largest of some counts, or the one that they all are: {32, 160} -> "32 to 160"."""
    low, high = min(counts), max(counts)
    return f"{low}" if low == high else f"{low} to {high}"


def format_count(count: float) -> str:
    """Return a count in the short form that `--steps` takes: 500000 -> "500k", 1500000 -> "1.5M", 950 -> "950"."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        scaled = float(f"{count / size:.3g}")  # rounded first, so that 999,999 is 1M and not 1000k
        if abs(scaled) >= 1:
            return f"{scaled:g}{letter}"
    return f"{count:.3g}"


def format_exactly(count: int) -> str:
    """Return a count in the short form where that is exact, as names carry it: 500000 -> "500k", 1234 -> "1234"."""
    return format_count(count) if float(f"{count:.3g}") == count else str(count)


def format_duration(seconds: float) -> str:
    """Return a time to wait in its two largest units: "8 s", "2 min 05 s", "1 h 03 min"."""
    if not math.isfinite(seconds):
        return "?"
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def format_standing(done: int, total: int, rate: float | None, num_seeds: int, unit: str = "steps") -> str:
    """Return what is done of each seed, and once it is known the rate of all seeds together and the time left."""
    counts = f"{format_count(done)}/{format_count(total)}"
    if rate is None:
        return counts
    left_s = (total - done) * num_seeds / rate if rate > 0 else math.inf
    return f"{counts}  {format_count(rate)} {'seed-' if num_seeds > 1 else ''}{unit}/s  {format_duration(left_s)} left"


def nearest(text: str, known: Iterable[str]) -> str | None:
    """Return the known name that a mistyped or abbreviated one, as "lr", is likely to mean; None if none is near."""
    names = sorted(set(known))
    close = get_close_matches(text, names, n=1)
    if close or not text:
        return close[0] if close else None
    short = [name for name in names if text == "".join(word[0] for word in name.split("_") if word)]
    part = [name for name in names if text in name.split("_")]
    return next(iter(short + part), None)


class Shown:
    """Says in `repr`, and in a notebook as a table, what an object is: `_facts` gives a value or text by name."""

    def _facts(self) -> Mapping[str, object]:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}({'; '.join(f'{name}: {fact}' for name, fact in self._facts().items())})"

    def _repr_html_(self) -> str:
        rows = (f"<tr><th>{escape(n)}</th><td>{escape(str(fact))}</td></tr>" for n, fact in self._facts().items())
        return f"<table><caption>{type(self).__name__}</caption>{''.join(rows)}</table>"


def did_you_mean(text: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'NAME'?", or nothing where no known name is near."""
    name = nearest(text, known)
    return f"; did you mean '{name}'?" if name else ""


def shortened(text: str) -> str:
    """Return a text that fits into a sentence, whatever a file or a command line put into it."""
    line = next(iter(text.splitlines()), "")
    return line if len(line) <= 80 else f"{line[:77]}..."


_CORRECTABLE = {
    *(errno.ENOENT, errno.EEXIST, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOTDIR, errno.ENOTEMPTY),
    *(errno.ELOOP, errno.ENAMETOOLONG, errno.EINVAL, errno.ENXIO, errno.EXDEV),
}
_ADVICE = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some space and run the command again, or resume it"),
    errno.EFBIG: "raise the limit on the size of a file (ulimit -f) and run the command again",
    errno.EROFS: "make the file system writable, or choose another path",
}


def is_correctable(error: OSError) -> bool:
    """Return whether the user can correct the command line: a wrong path, a missing permission."""
    return error.errno in _CORRECTABLE


def sentence(error: OSError) -> str:
    """Return one sentence: what is wrong, with which path, what to do."""
    reason = (error.strerror or str(error) or type(error).__name__).lower()
    place = f": {os.fsdecode(error.filename)}" if isinstance(error.filename, str | bytes) and error.filename else ""
    default = "check the path and its permissions" if is_correctable(error) else "check the disk and the machine"
    return f"{reason}{place}; {_ADVICE.get(error.errno or 0, default)}"


def own_words(message: str) -> str:
    """Return a message of ours without what pydantic writes before it."""
    return message.replace("Value error, ", "")


@contextlib.contextmanager
def attempting(verb: str, path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn a failure to do something ("write", "make the run folder") with a path into one sentence.

    It is a UserError where the user can correct it, else, of a full or read-only disk, an OSError that names the path.
    """
    try:
        yield
    except OSError as error:
        if is_correctable(error):
            raise UserError(f"cannot {verb} {os.fspath(path)}: {error.strerror or error}") from None
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None


def said_once(conventions: Sequence[str]) -> str:
    """Return conventions one after the other, with what all begin with said once: "esp: sum; mud 0.9; wind 0.3"."""
    parts = [re.findall(r".+?[:,] ", f"{convention}, ") for convention in conventions]
    shared = [each[0] for each in takewhile(lambda each: len(set(each)) == 1, zip(*parts, strict=False))]
    texts = ["".join(shared), *("".join(own[len(shared) :]) for own in parts)]
    return "; ".join(text.removesuffix(", ") for text in texts if text).replace(": ; ", ": ")


def markdown_text(text: str) -> str:
    """Return a text that Markdown shows as it is, in a cell of a table too."""
    return _MARKUP.sub(r"\\\g<0>", " ".join(text.splitlines()))
