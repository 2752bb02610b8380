"""Locks of folders between processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from esp_cli.files.opening import LockError, acquire, is_held, release


def test_a_lock_is_let_go_of_though_a_forked_process_lives_on(tmp_path: Path) -> None:
    file = tmp_path / "lock"
    descriptor = acquire(file)
    child = os.fork()
    if not child:
        signal.pause()
    try:
        assert is_held(file)
        with pytest.raises(LockError, match=f"in use by process {os.getpid()}"):
            acquire(file)
        release(descriptor)
        assert not is_held(file)
        release(acquire(file))
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
