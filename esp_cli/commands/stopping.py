"""Ctrl-C in two steps, shared by the commands that take long: a request first, an interrupt second."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from esp_cli import console


@contextmanager
def stop_requests(sentence: str) -> Iterator[list[int]]:
    """Turn the first Ctrl-C (or SIGTERM, or the SIGHUP of a closed terminal) into a request; a second one interrupts.

    A SIGHUP that `nohup` ignores stays ignored. The list that is yielded is empty until the request comes, which is
    answered with the sentence.
    """
    requests: list[int] = []

    def handler(number: int, _frame: FrameType | None) -> None:
        if requests:
            raise KeyboardInterrupt
        requests.append(number)
        console.note(f"{sentence} (press Ctrl-C again to stop at once)")

    heard = [signal.SIGINT, signal.SIGTERM]
    heard += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else []
    previous = {number: signal.signal(number, handler) for number in heard}
    try:
        yield requests
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
