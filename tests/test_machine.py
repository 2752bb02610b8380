"""The process is prepared where it can be, and what the user has set stays."""

import ctypes
import os
import platform
from types import SimpleNamespace

import pytest

from esp_cli import machine


@pytest.fixture
def calls(monkeypatch):
    made = []
    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(mallopt=lambda *pair: made.append(pair)))
    monkeypatch.setattr(platform, "libc_ver", lambda: ("glibc", "2.36"))
    for name in list(os.environ):
        if name.startswith(("MALLOC_", "GLIBC_TUNABLES", "GOMP_SPINCOUNT")):
            monkeypatch.delenv(name)
    for name in ("GOMP_SPINCOUNT", "THP_MEM_ALLOC_ENABLE"):
        monkeypatch.setenv(name, "")  # so that what `prepare` sets is undone after the test
        monkeypatch.delenv(name)
    return made


def test_threads_wait_shortly_and_memory_is_kept(calls):
    machine.prepare()
    assert os.environ["GOMP_SPINCOUNT"] == "10000"
    assert os.environ["THP_MEM_ALLOC_ENABLE"] == "1"
    assert [name for name, _ in calls] == [-3, -1, -2]
    assert all(0 < value < 2**31 for _, value in calls)


def test_what_the_user_has_set_stays(calls, monkeypatch):
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    monkeypatch.setenv("THP_MEM_ALLOC_ENABLE", "0")
    monkeypatch.setenv("MALLOC_ARENA_MAX", "1")
    machine.prepare()
    assert os.environ["GOMP_SPINCOUNT"] == "7"
    assert os.environ["THP_MEM_ALLOC_ENABLE"] == "0"
    assert not calls


def test_other_systems_are_left_alone(calls, monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    machine.prepare()
    assert not calls
