"""Failures of the file system: which the user can correct, and what the sentence says."""

from __future__ import annotations

import errno
import os

import pytest

from esp_cli.files import failures


class ToyError(ValueError):
    pass


def failed(number):
    return OSError(number, os.strerror(number))


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES, errno.ELOOP, errno.ENAMETOOLONG, errno.EISDIR])
def test_what_the_user_can_correct_becomes_one_sentence(number):
    with pytest.raises(ToyError, match="cannot write a/b: "), failures.attempting("write", "a/b", ToyError):
        raise failed(number)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO])
def test_a_failure_of_the_machine_passes_and_names_the_path(number):
    with pytest.raises(OSError, match="a/b") as caught, failures.attempting("write", "a/b", ToyError):
        raise failed(number)
    assert caught.value.errno == number
    assert not failures.is_correctable(caught.value)
    assert failures.sentence(caught.value).startswith(f"{os.strerror(number).lower()}: a/b; ")
