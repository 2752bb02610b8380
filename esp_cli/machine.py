"""How this process uses the machine: what has to be said before torch is imported."""

from __future__ import annotations

import ctypes
import os
import platform

from esp_envs.errors import UserError

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3
_MEBIBYTE = 1 << 20


def prepare() -> None:
    """Tune thread waiting and memory for training; what the user has set in the environment stays.

    OpenMP's threads wait for each other by spinning, by default for milliseconds: a second busy program on the same
    cores then slows training tenfold and more. glibc gives large tensors back to the kernel as soon as they are freed,
    and every new one costs its page faults again: kept, they make a recurrent update 1.4 times as fast. Large pages for
    tensors of megabytes, where Linux gives them, make training a little faster.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")  # read when torch is imported
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # read at the first tensor
    if platform.libc_ver()[0] != "glibc" or any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ):
        return
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_MMAP_THRESHOLD, 1024 * _MEBIBYTE)
    libc.mallopt(_M_TRIM_THRESHOLD, 2047 * _MEBIBYTE)
    libc.mallopt(_M_TOP_PAD, 64 * _MEBIBYTE)


def resolve_device(wanted: str) -> str:
    """Return "cpu" or "cuda" for what --device asks for; a UserError says that there is no such device."""
    if wanted not in ("cpu", "cuda", "auto"):
        raise UserError(f"there is no device '{wanted}'; choose cpu, cuda or auto")
    import torch  # noqa: PLC0415 - takes a second

    available = torch.cuda.is_available()
    if wanted == "cuda" and not available:
        raise UserError("there is no CUDA device here; use --device cpu or auto")
    return "cuda" if wanted != "cpu" and available else "cpu"
