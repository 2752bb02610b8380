"""What sentences say: of failures of the file system, and of a name near one that nobody knows."""

import errno
import os

import pytest

from esp_cli.files import formatting
from esp_cli.files.formatting import did_you_mean, nearest
from esp_envs.errors import UserError


def failed(number):
    return OSError(number, os.strerror(number))


@pytest.mark.parametrize("number", [errno.ENOENT, errno.EACCES, errno.ELOOP, errno.ENAMETOOLONG, errno.EISDIR])
def test_what_the_user_can_correct_becomes_one_sentence(number):
    with pytest.raises(UserError, match="cannot write a/b: "), formatting.attempting("write", "a/b"):
        raise failed(number)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO])
def test_a_failure_of_the_machine_passes_and_names_the_path(number):
    with pytest.raises(OSError, match="a/b") as caught, formatting.attempting("write", "a/b"):
        raise failed(number)
    assert caught.value.errno == number
    assert not formatting.is_correctable(caught.value)
    assert formatting.sentence(caught.value).startswith(f"{os.strerror(number).lower()}: a/b; ")


NAMES = ("learning_rate", "clip_epsilon", "gamma", "num_envs")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("learing_rate", "learning_rate"),
        ("lr", "learning_rate"),
        ("clip", "clip_epsilon"),
        ("gama", "gamma"),
        ("colour", None),
        ("", None),
        ("x", None),
    ],
)
def test_a_typing_error_an_abbreviation_and_a_part_find_their_name(text: str, name: str | None) -> None:
    assert nearest(text, NAMES) == name
    assert did_you_mean(text, NAMES) == (f"; did you mean '{name}'?" if name else "")
