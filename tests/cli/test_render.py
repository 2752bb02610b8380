"""`esp render`: films and pictures of the right length, size and speed; one sentence for whatever cannot be drawn."""

import re
import shutil
from pathlib import Path

import pytest
from PIL import Image

from esp_cli.policies.evaluation import rough_anchors
from esp_cli.run import Run
from esp_envs.epuck import gl
from tests.cli.running import esp, refused, train_tiny

FRAMES = 26
"""Of one episode: the start and 25 steps."""


def test_a_gif_has_every_step_of_every_episode_in_real_time(finished: Path, tmp_path: Path) -> None:
    file = tmp_path / "new" / "film.gif"
    told = esp("render", finished, "-o", file, "--episodes", 2, "--size", 64)
    assert told.stdout == ""
    assert f"{2 * FRAMES} frames -> {file}" in told.stderr
    assert f"{2 * FRAMES}/{2 * FRAMES}" in told.stderr, "progress is shown"
    (said,) = re.findall(r": return (\S+), normalised (\S+) \(0 random, 1 the best heuristic\)", told.stderr)
    drawn = Run(finished).render(tmp_path / "again.gif", episodes=2, size=64).returns[0]
    anchors = rough_anchors(Run(finished).config, 64)
    score = (drawn - anchors["random"]) / (max(anchors.values()) - anchors["random"])
    assert said == (f"{drawn:.1f}", f"{score:.2f}")
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
    assert film("--view", "top") == greedy, "a flat task has no other view"


def test_the_policy_beside_acts_by_the_same_seed_or_not_at_all(finished: Path, tmp_path: Path) -> None:
    others = train_tiny(tmp_path / "others", "--seed-list", "3,5", steps=50)
    words = ("render", finished, others, "-o", tmp_path / "film.gif", "--episodes", 1, "--size", 48)
    esp(*words, "--seed", 3)
    assert "has no seed 7; it has 3, 5" in refused(*words, "--seed", 7)


def test_a_picture_for_print_is_as_wide_as_asked_for_and_has_its_letters_embedded(finished, tmp_path):
    for kind in ("pdf", "svg", "png"):
        esp("render", finished, "-o", tmp_path / f"column.{kind}", "--width", 89)
    points = 89 / 25.4 * 72
    pdf = (tmp_path / "column.pdf").read_bytes()
    (box,) = re.findall(rb"/MediaBox \[ 0 0 ([\d.]+) ", pdf)
    assert float(box) == pytest.approx(points)
    assert b"/FontFile2" in pdf
    assert b"/Type3" not in pdf, "no editor knows letters of that kind"
    assert f'width="{points:.3f}'[:-1] in (tmp_path / "column.svg").read_text()
    with Image.open(tmp_path / "column.png") as picture:
        assert picture.width == round(89 / 25.4 * 300)
    first = pdf
    esp("render", finished, "-o", tmp_path / "column.pdf", "--width", 89)
    assert (tmp_path / "column.pdf").read_bytes() == first, "no date in it"
    assert "leave out --width" in refused("render", finished, "-o", tmp_path / "film.gif", "--width", 89)


@pytest.mark.parametrize(
    ("kind", "options", "sentence"),
    [
        ("png", ["--fps", 10], "is a picture without frames; leave out --fps"),
        ("png", ["--speed", "4x"], "is a picture without frames; leave out --speed"),
        ("pdf", ["--size", 200], "is for print, whose width --width sets in mm; leave out --size"),
        ("png", ["--size", 200, "--width", 89], "is for print, whose width --width sets in mm; leave out --size"),
    ],
)
def test_what_a_picture_does_not_have_is_refused(finished, tmp_path, kind, options, sentence):
    assert sentence in refused("render", finished, "-o", tmp_path / f"picture.{kind}", *options)


def test_policies_of_one_name_are_told_apart_and_a_folder_has_its_name(finished, tmp_path, monkeypatch):
    runs = [shutil.copytree(finished, tmp_path / name / "run") for name in "ab"]
    told = esp("render", *runs, "-o", tmp_path / "both.png", "--size", 64).stderr
    assert all(f"{run}: return" in told for run in runs)
    monkeypatch.chdir(runs[0])
    assert "run: return" in esp("render", ".", "-o", tmp_path / "one.png", "--size", 64).stderr.splitlines()[-1]


@pytest.mark.parametrize(
    ("options", "frames", "duration"),
    [
        (["--speed", "0.5"], FRAMES, 200),
        (["--speed", "2x"], FRAMES, 50),
        (["--speed", "4X"], 14, 50),  # 40 frames a second are too many: every second of 0..25, and the last
        (["--speed", "4", "--fps", "40"], FRAMES, 20),  # 25 ms each, rounded to 20 and 30
        (["--fps", "5"], 14, 200),
        (["--speed", "10", "--fps", "60"], 14, 20),  # 50 a second are the most that players show
    ],
)
def test_frames_are_skipped_at_high_speed(finished, tmp_path, options, frames, duration):
    esp("render", finished, "-o", tmp_path / "film.gif", "-e", 1, "--size", 48, *options)
    with Image.open(tmp_path / "film.gif") as film:
        assert (film.n_frames, film.info["duration"]) == (frames, duration)


def test_two_policies_play_side_by_side(finished: Path, tmp_path: Path) -> None:
    told = esp("render", finished, "navigation", "-o", tmp_path / "both.gif", "--episodes", 1, "--size", 100)
    assert f"{FRAMES} frames -> " in told.stderr
    with Image.open(tmp_path / "both.gif") as film:
        assert film.size == (200, 100)
    esp("render", finished, "navigation", "-o", tmp_path / "both.png", "--size", 200)
    esp("render", finished, "-o", tmp_path / "one.png", "--size", 200)
    with Image.open(tmp_path / "both.png") as both, Image.open(tmp_path / "one.png") as one:
        assert both.size == (400, one.height)
        assert both.crop((0, 0, 200, one.height)).tobytes() != both.crop((200, 0, 400, one.height)).tobytes()
    sentence = refused("render", finished, "wildlife-mappo-esp", "-o", tmp_path / "other.gif")
    assert "is a policy of navigation, " in sentence
    assert sentence.endswith(" of wildlife; compare two policies of one task")
    assert not (tmp_path / "other.gif").exists()


def test_a_png_is_a_figure_of_the_episode(finished: Path, tmp_path: Path) -> None:
    told = esp("render", finished, "-o", tmp_path / "ways.PNG", "--size", 200)
    assert f"episode of {FRAMES - 1} steps -> {tmp_path / 'ways.PNG'}" in told.stderr
    with Image.open(tmp_path / "ways.PNG") as figure:
        assert (figure.format, figure.width) == ("PNG", 200)
        assert figure.height > 220, "a coverage map stands below the paths"
    other = tmp_path / "other.png"
    esp("render", finished, "-o", other, "--size", 200, "--view", "top", "--seed", 7, "--episodes", 1)
    assert other.read_bytes() != (tmp_path / "ways.PNG").read_bytes()
    sentence = refused("render", finished, "-o", other, "--episodes", 2)
    assert sentence == f"{other} holds one episode; leave out --episodes 2 or name a .gif file"


def test_a_flat_task_has_no_view_in_space(finished: Path, tmp_path: Path) -> None:
    sentence = refused("render", finished, "-o", tmp_path / "film.gif", "--view", "3d")
    assert sentence == "navigation is a flat task without a view in space; leave out --view 3d"


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of e-pucks with short episodes."""
    pytest.importorskip("mujoco")
    out = tmp_path_factory.mktemp("robots") / "run"
    return train_tiny(out, "--task", "formation", "--set", "task.horizon=8", steps=50)


def test_robots_are_drawn_in_space_and_from_above(robots: Path, tmp_path: Path) -> None:
    try:
        with gl.open_painter(64):
            pass
    except ValueError as error:
        pytest.skip(str(error))
    sizes = {}
    for name, options in (("auto", []), ("space", ["--view", "3d"]), ("top", ["--view", "top"])):
        for kind in ("gif", "png"):
            file = tmp_path / f"{name}.{kind}"
            esp("render", robots, "-o", file, "--size", 64, *options)
            with Image.open(file) as picture:
                sizes[file.name] = picture.size
    assert sizes == {name: (64, 64) if name.startswith("top") else (64, 48) for name in sizes}
    assert len(sizes) == 6
    assert (tmp_path / "auto.gif").read_bytes() == (tmp_path / "space.gif").read_bytes()


def test_without_graphics_the_view_is_from_above_and_a_note_says_why(robots, tmp_path, monkeypatch):
    monkeypatch.setattr(gl, "is_installed", lambda backend: False)
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)  # which MuJoCo has set if this process drew before
    told = esp("render", robots, "-o", tmp_path / "film.gif", "--size", 64)
    assert "apt-get install libosmesa6 (Fedora: dnf install mesa-libOSMesa); so the view is from above\n" in told.stderr
    with Image.open(tmp_path / "film.gif") as film:
        assert film.size == (64, 64)
    sentence = refused("render", robots, "-o", tmp_path / "space.gif", "--view", "3d")
    assert sentence.startswith("nothing here can draw a view in space (osmesa: not installed; egl: not installed)")
    assert not (tmp_path / "space.gif").exists()


def test_a_policy_is_drawn_under_other_settings_of_its_task(robots: Path, tmp_path: Path) -> None:
    told = esp("render", robots, "-o", tmp_path / "long.png", "--view", "top", "--set", "task.horizon=12")
    assert "episode of 12 steps" in told.stderr
    assert "mujoco" in refused("render", robots, "-o", tmp_path / "film.gif", "--physics", "marbles")


@pytest.mark.parametrize("name", ["film.mov", "film.jpg", "film", "gif"])
def test_another_kind_of_file_is_refused(finished: Path, tmp_path: Path, name: str) -> None:
    sentence = refused("render", finished, "-o", tmp_path / name)
    assert sentence == f"cannot write {tmp_path / name}: name a .gif or .mp4 film, or a .png, .pdf or .svg picture"
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--seed", "4"], "has no seed 4; it has 3, 7"),
        (["--speed", "0"], "'0' is no speed; write a number from 0.01 to 100, as 0.5 or 4x"),
        (["--speed", "fast"], "'fast' is no speed"),
        (["--speed", "nan"], "'nan' is no speed"),
    ],
)
def test_a_bad_option_is_told_in_one_sentence(finished, tmp_path, options, sentence):
    assert sentence in refused("render", finished, "-o", tmp_path / "film.gif", *options)


def test_a_place_that_cannot_be_written_is_told(finished: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.gif").mkdir()
    assert "is a directory" in refused("render", finished, "-o", tmp_path / "folder.gif", "--size", 32)
    assert list((tmp_path / "folder.gif").iterdir()) == []
