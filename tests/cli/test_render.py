"""`esp render`: a GIF of the right length, size and speed, and one sentence for whatever cannot be drawn."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests.cli.running import DAMAGE, esp, refused, train_tiny

FRAMES = 26
"""Of one episode: the start and 25 steps."""


def test_a_gif_has_every_step_of_every_episode_in_real_time(finished: Path, tmp_path: Path) -> None:
    file = tmp_path / "new" / "film.gif"
    told = esp("render", finished, "-o", file, "--episodes", 2, "--size", 64)
    assert told.stdout == ""
    assert f"{2 * FRAMES} frames -> {file}" in told.stderr
    with Image.open(file) as film:
        assert film.format == "GIF"
        assert film.n_frames == 2 * FRAMES
        assert film.size == (64, 64)
        assert film.info["duration"] == 100, "milliseconds: a step is 0.1 s"
        assert film.info["loop"] == 0
    assert [entry.name for entry in file.parent.iterdir()] == ["film.gif"]


def test_speed_seed_and_noise_are_chosen(finished: Path, tmp_path: Path) -> None:
    def film(*options: object) -> bytes:
        esp("render", finished, "-o", tmp_path / "film.gif", "--episodes", 1, "--size", 48, *options)
        return (tmp_path / "film.gif").read_bytes()

    greedy = film()
    assert film("--seed", 3) == greedy, "the first seed acts by default"
    assert film("--seed", 7) != greedy
    assert film("--stochastic") != greedy
    assert film("--speed", 0.5) != greedy
    with Image.open(tmp_path / "film.gif") as slow:
        assert slow.info["duration"] == 200


def test_predators_and_prey_are_drawn_from_a_policy_file(tmp_path: Path) -> None:
    run = train_tiny(tmp_path / "hunt", "--task", "predator-prey", steps=50)
    esp("render", run / "policy.safetensors", "-o", tmp_path / "hunt.GIF", "--episodes", 1, "--size", 48)
    with Image.open(tmp_path / "hunt.GIF") as film:
        assert film.n_frames == FRAMES


@pytest.mark.parametrize("name", ["film.mp4", "film.png", "film", "gif"])
def test_another_kind_of_file_is_refused(finished: Path, tmp_path: Path, name: str) -> None:
    sentence = refused("render", finished, "-o", tmp_path / name)
    assert sentence == f"cannot write {tmp_path / name}: name a .gif file"
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--seed", "4"], "has no seed 4; it has 3, 7"),
        (["--size", "5"], "--size"),
        (["--episodes", "0"], "--episodes"),
        (["--speed", "0"], "--speed"),
    ],
)
def test_a_bad_option_is_told_in_one_sentence(
    finished: Path, tmp_path: Path, options: list[str], sentence: str
) -> None:
    assert sentence in refused("render", finished, "-o", tmp_path / "film.gif", *options)


def test_the_file_has_to_be_named(finished: Path) -> None:
    assert "Missing option '--out'" in refused("render", finished)


def test_a_place_that_cannot_be_written_is_told(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.gif").mkdir()
    assert "is a directory" in refused("render", finished, "-o", tmp_path / "folder.gif", "--size", 32)
    assert list((tmp_path / "folder.gif").iterdir()) == []


@pytest.mark.parametrize("kind", DAMAGE)
def test_what_is_no_policy_is_told_in_one_sentence(copied: Path, tmp_path: Path, kind: str) -> None:
    damage, sentence = DAMAGE[kind]
    assert sentence in refused("render", damage(copied), "-o", tmp_path / "film.gif")
    assert not (tmp_path / "film.gif").exists()
    assert not (copied / "exploded").exists(), "loading ran code"
