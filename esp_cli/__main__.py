"""`esp` and `python -m esp_cli`: the application, with Ctrl-C answered from its first import on."""

from __future__ import annotations

import os
import signal
from types import FrameType


def main() -> None:
    """Run the application on the command line of this process."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else whoever started it wants no interrupts
        signal.signal(signal.SIGINT, _interrupt)
    from esp_cli.app import main as run  # noqa: PLC0415 - what takes long comes after the handler

    run()


def _interrupt(_number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt; within an import leave at once, since a half-imported module breaks what comes after."""
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            os.write(2, b"interrupted\n")
            os._exit(128 + signal.SIGINT)
        frame = frame.f_back
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
