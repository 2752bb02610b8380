"""Films and pictures: every step of every episode of the chosen seed, in real time, drawn without a display."""

from __future__ import annotations

import contextlib
from io import BytesIO

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from esp_cli.drawing.films import write_gif, write_mp4
from esp_cli.drawing.rendering import (
    default_episodes,
    open_painter,
    record,
    shots,
    stride,
    trajectories,
    write_film,
    write_picture,
)
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.training.build import build_environment
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.play import PolicyController
from esp_cli.training.streams import generators
from esp_envs import Body, Scene
from esp_envs.drawing import TopPainter, draw
from tests.training.runs import tiny_config

SEEDS = (3, 7)
RED, BLUE = "#ff0000", "#0000ff"


@pytest.fixture
def trained(tmp_path) -> TrainedPolicy:
    config = tiny_config(seeds=SEEDS, task__horizon=6)
    spec = build_environment(config, 1, "shape").spec
    policy = StochasticPolicy(spec, config.network, generators(SEEDS, "weights"))
    return TrainedPolicy(config, policy, spec, 0, tmp_path)


@pytest.fixture
def env(trained):
    return build_environment(trained.config, 1, "film")


def filmed(trained, *choice):
    """Record in a new environment."""
    return record(trained, build_environment(trained.config, 1, "film"), *choice)


def line(count=9, trail=True):
    """A red body on its way from the lower left to the right, and a blue one that stands."""
    places = np.linspace([-0.8, -0.6], [0.8, -0.6], count)  # beside the lines of the grid
    still = Body((0.0, 0.5), 0.1, BLUE)
    return [Scene((still, Body(tuple(place), 0.1, RED, trail=trail)), (-1.0, 1.0, -1.0, 1.0)) for place in places]


def test_the_start_and_every_step_of_every_episode_are_recorded(trained, env):
    episodes = record(trained, env, 3, 2)
    assert [len(scenes) for scenes in episodes] == [6 + 1, 6 + 1]
    flat = [scene for scenes in episodes for scene in scenes]
    assert len(set(flat)) == len(flat), "something moves in each"


def test_a_recording_ends_where_the_episode_ended_not_where_the_next_begins(trained, env):
    recorded = filmed(trained, 7, 1)[0]
    controller = PolicyController(trained.policy)
    observation = env.reset()
    controller.begin(env, observation)
    scenes = [env.scene((1, 0))]
    for _ in range(6):
        step = env.step(controller.act(env, observation))
        observation = step.next
        scenes.append(env.scene((1, 0)))
    following = scenes[-1]
    env.set_state(step.final.state)
    scenes[-1] = env.scene((1, 0))
    assert scenes[-1] != following
    assert recorded == scenes


def test_seeds_and_noise_make_other_recordings_and_the_same_choice_the_same(trained):
    assert filmed(trained, 3, 1) == filmed(trained, 3, 1)
    assert filmed(trained, 3, 1, False) == filmed(trained, 3, 1, False)
    assert filmed(trained, 3, 1) != filmed(trained, 7, 1)
    assert filmed(trained, 3, 1) != filmed(trained, 3, 1, False)


def test_a_seed_that_the_run_has_not_is_refused(trained):
    with pytest.raises(ValueError, match=r"has no seed 5; it has 3, 7"):
        filmed(trained, 5, 1)


def test_an_episode_that_ends_early_ends_the_recording(trained, monkeypatch):
    kind = type(build_environment(trained.config, 1, "film"))
    step = kind.step

    def ending(self, action):
        """Seed 7's world reaches its end in the third step, seed 3's in the second."""
        result = step(self, action)
        ended = torch.tensor([[self._time >= 2], [self._time >= 3]])
        return type(result)(result.next, result.reward, ended, result.truncated, result.next, result.metrics)

    monkeypatch.setattr(kind, "step", ending)
    assert [len(scenes) for scenes in filmed(trained, 3, 1)] == [1 + 2]
    assert [len(scenes) for scenes in filmed(trained, 7, 2)] == [1 + 3, 1 + 3]


@pytest.mark.parametrize(("horizon", "episodes"), [(25, 3), (100, 3), (101, 2), (150, 2), (151, 1), (300, 1), (999, 1)])
def test_a_film_is_three_episodes_or_half_a_minute(horizon, episodes):
    spec = build_environment(tiny_config(task__horizon=horizon), 1, "shape").spec
    assert default_episodes(spec) == episodes


@pytest.mark.parametrize(
    ("period", "speed", "rate", "steps"),
    [
        (0.1, 1.0, 25, 1),  # 10 frames a second
        (0.1, 2.5, 25, 1),  # just 25
        (0.1, 4.0, 25, 2),  # 40 would be too many, 20 are not
        (0.1, 4.0, 50, 1),
        (0.1, 100.0, 25, 40),
        (0.04, 1.0, 25, 1),
        (0.1, 1.0, 3, 4),
    ],
)
def test_frames_are_skipped_where_the_rate_asks_for_it(period, speed, rate, steps):
    assert stride(period, speed, rate) == steps


def test_shots_keep_the_first_and_last_scene_and_the_time_of_all():
    scenes = line(6)
    taken = shots([scenes, scenes[:5]], 2)
    assert [shot.scenes[-1] for shot in taken] == [scenes[k] for k in (0, 2, 4, 5, 0, 2, 4)]
    assert [shot.steps for shot in taken] == [2, 2, 1, 1, 2, 2, 1]
    assert [len(shot.scenes) for shot in taken] == [1, 3, 5, 6, 1, 3, 5], "trails come from every step of the episode"
    assert np.array_equal(taken[2].draw(TopPainter(40)), draw(scenes[4], 40, trail=scenes[:4]))


def test_a_film_is_drawn_in_order_and_watched(tmp_path):
    scenes, told = line(5), []
    write_film(tmp_path / "film.gif", TopPainter(60), shots([scenes], 2), 0.05, told.append)
    assert told == [1, 2, 3]
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.n_frames == 3
        for k, duration in ((0, 100), (1, 100), (2, 50)):
            gif.seek(k)
            assert gif.info["duration"] == duration
            drawn = draw(scenes[2 * k], 60, trail=scenes[: 2 * k])
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - drawn).max() <= 40


def test_a_gif_holds_the_frames_for_ever(tmp_path):
    shades = [np.full((20, 30, 3), 40 * k, dtype=np.uint8) for k in range(5)]
    write_gif(tmp_path / "new" / "film.gif", shades, [0.05] * 5, shades)
    with Image.open(tmp_path / "new" / "film.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"], gif.info["loop"]) == (5, (30, 20), 50, 0)
        for k, shade in enumerate(shades):
            gif.seek(k)
            assert np.array_equal(np.asarray(gif.convert("RGB")), shade)
    write_gif(tmp_path / "film.gif", shades, [0.05] * 5, [shades[0], shades[4]])
    with Image.open(tmp_path / "film.gif") as gif:
        gif.seek(gif.n_frames - 2)
        assert set(np.asarray(gif.convert("RGB")).ravel()) <= {0, 160}, "the palette is made for the sample"


def durations(path):
    with Image.open(path) as gif:
        found = []
        for k in range(gif.n_frames):
            gif.seek(k)
            found.append(gif.info["duration"])
        return found


def test_a_gif_runs_in_real_time_though_it_counts_in_hundredths(tmp_path):
    frames = [np.full((8, 8, 3), 5 * k, dtype=np.uint8) for k in range(30)]
    write_gif(tmp_path / "film.gif", frames, [1 / 30] * 30, frames)
    assert sum(durations(tmp_path / "film.gif")) == 1000
    assert set(durations(tmp_path / "film.gif")) == {30, 40}
    write_gif(tmp_path / "film.gif", frames[:2], [0.02, 0.001], frames)
    assert durations(tmp_path / "film.gif") == [20, 20], "what is shorter, players would show for a tenth of a second"


def test_frames_alike_are_one_long_frame(tmp_path):
    frame = np.zeros((8, 8, 3), dtype=np.uint8)
    write_gif(tmp_path / "film.gif", [frame, frame, frame + 50], [0.1, 0.2, 0.3], [frame, frame + 50])
    assert durations(tmp_path / "film.gif") == [300, 300]


def test_the_colour_of_something_small_survives_among_many_shades(tmp_path):
    ramp = np.arange(100 * 100, dtype=np.uint32).reshape(100, 100)
    frame = np.stack([ramp % 200, ramp // 50, 100 + ramp % 97], -1).astype(np.uint8)
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) > 5000
    frame[40:43, 40:43] = (255, 0, 0)
    frame[:20] = (250, 250, 247)
    write_gif(tmp_path / "film.gif", [frame], [0.1], [frame])
    with Image.open(tmp_path / "film.gif") as gif:
        shown = np.asarray(gif.convert("RGB")).astype(int)
    assert shown[5, 5].tolist() == [250, 250, 247], "what there is most of is exact"
    assert np.abs(shown[41, 41] - [255, 0, 0]).max() <= 60
    assert np.abs(shown - frame).mean() < 12


def test_a_gif_that_cannot_be_written_leaves_nothing_behind(tmp_path):
    (tmp_path / "film.gif").mkdir()
    frame = np.zeros((8, 8, 3), dtype=np.uint8)
    with pytest.raises(IsADirectoryError):
        write_gif(tmp_path / "film.gif", [frame], [0.1], [frame])
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.gif"]


def test_an_mp4_holds_the_frames_at_their_rate(tmp_path):
    frames = [np.full((33, 48, 3), 40 * k, dtype=np.uint8) for k in range(6)]
    write_mp4(tmp_path / "new" / "film.mp4", frames, 12.5)
    film = tmp_path / "new" / "film.mp4"
    shown = [frame.mean() for frame in iio.imiter(film)]
    assert iio.immeta(film)["fps"] == 12.5
    assert iio.improps(film).shape[1:] == (34, 48, 3), "an odd side is made even"
    assert shown == pytest.approx([40 * k for k in range(6)], abs=10)


class Space:
    """A view in space that shows a grey picture."""

    note = "drawn in grey"

    def draw(self, scene, trail=()):
        return np.full((12, 16, 3), 100 + len(trail), dtype=np.uint8)


def test_the_view_in_space_is_taken_where_there_is_one(env, monkeypatch):
    with open_painter(env, "auto", 40) as painter:
        assert isinstance(painter, TopPainter)
        assert painter.note is None
        assert painter.draw(env.scene()).shape == (40, 40, 3)
    with pytest.raises(ValueError, match="navigation is a flat task"), open_painter(env, "3d", 40):
        pass
    closed = []

    @contextlib.contextmanager
    def opened(size):
        yield Space()
        closed.append(size)

    monkeypatch.setattr(env, "painter", opened)
    for view, kind in (("auto", Space), ("3d", Space), ("top", TopPainter)):
        with open_painter(env, view, 40) as painter:
            assert isinstance(painter, kind)
    assert closed == [40, 40]


def test_a_picture_comes_out_where_space_cannot_be_drawn(env, monkeypatch):
    @contextlib.contextmanager
    def broken(size):
        raise ValueError("no library here can draw")
        yield

    monkeypatch.setattr(env, "painter", broken)
    with open_painter(env, "auto", 40) as painter:
        assert painter.note == "no library here can draw; so the view is from above"
        assert painter.draw(env.scene()).shape == (40, 40, 3)
    with pytest.raises(ValueError, match=r"^no library here can draw$"), open_painter(env, "3d", 40):
        pass


def test_a_picture_in_space_is_the_end_with_its_trails_and_one_from_above_a_figure(tmp_path):
    write_picture(tmp_path / "new" / "space.png", Space(), line(9), "title", 200)
    with Image.open(tmp_path / "new" / "space.png") as picture:
        assert (np.asarray(picture) == 108).all()
    write_picture(tmp_path / "top.png", TopPainter(200), line(9), "title", 200)
    with Image.open(tmp_path / "top.png") as picture:
        assert picture.size == (200, 200)
        assert picture.info.get("Software") is None


def drawn(figure):
    """Return the picture of a figure and a function from a point of the world to its colour."""
    content = BytesIO()
    figure.savefig(content, format="png")
    picture = np.asarray(Image.open(content).convert("RGB")).astype(int)

    def color(x, y):
        column, above = figure.axes[0].transData.transform((x, y))
        return picture[len(picture) - 1 - int(above), int(column)].tolist()

    return picture, color


def test_trajectories_are_drawn_where_they_went_more_opaque_with_time():
    picture, color = drawn(trajectories(line(), "title", 600))
    assert picture.shape == (600, 600, 3)
    early, middle, late = (color(x, -0.6) for x in (-0.65, 0.05, 0.62))
    assert all(found[0] == 255 and found[1] == found[2] for found in (early, middle, late)), "red on white"
    assert 235 > early[1] > middle[1] + 40 > late[1] + 80
    assert color(0.1, -0.3) == [255, 255, 255]
    _, color = drawn(trajectories(line(trail=False), "title", 600))
    assert color(0.05, -0.6) == [255, 255, 255], "a body that leaves no trail has none"


def test_trajectories_show_the_start_the_end_and_what_stands():
    _, color = drawn(trajectories(line(), "title", 600))
    assert color(-0.8, -0.6) == [255, 0, 0], "the mark of the start is opaque"
    assert color(0.87, -0.6) == [255, 0, 0], "the end is as large as the body"
    assert color(0.07, 0.5) == [0, 0, 255]
    shapes = [Body((-0.5, 0.0), 0.2, RED, "ring", model="goal"), Body((0.5, 0.0), 0.2, BLUE, "cross")]
    shapes.append(Body((0.0, 0.6), 0.2, RED, "square"))
    figure = trajectories([Scene(tuple(shapes), (-1.0, 1.0, -1.0, 1.0))], "title", 600)
    _, color = drawn(figure)
    assert color(-0.3, 0.0) == [255, 0, 0]
    assert color(-0.5, 0.01) != [255, 0, 0]
    assert color(0.5, 0.0) == color(0.6, 0.1) == [0, 0, 255]
    assert color(0.6, 0.02) != [0, 0, 255]
    assert color(0.15, 0.75) == [255, 0, 0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["start", "end", "goal"]
    assert figure.axes[0].get_title(loc="left") == "title"
