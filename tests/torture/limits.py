"""Limits of time that hold on a busy machine too."""

import contextlib
import signal
from collections.abc import Iterator

PROCESSOR_S = 10.0
WALL_S = 120.0


class TooLongError(BaseException):
    """A case took longer than is allowed; no code may catch this."""


@contextlib.contextmanager
def time_limit() -> Iterator[None]:
    """Raise TooLongError in here after `PROCESSOR_S` of this process's time, or after `WALL_S` of waiting."""

    def stop(number: int, frame: object) -> None:
        raise TooLongError

    old = {number: signal.signal(number, stop) for number in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, PROCESSOR_S)
    signal.setitimer(signal.ITIMER_REAL, WALL_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in old.items():
            signal.signal(number, handler)
