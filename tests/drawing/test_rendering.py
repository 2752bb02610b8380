"""Films and pictures: every step of every episode of the chosen seed, in real time, drawn without a display."""

import contextlib
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image

from esp_cli.drawing.draw import open_painter, shots, write_film
from esp_cli.drawing.films import write_gif, write_mp4
from esp_cli.drawing.recording import HOLD_SECONDS, framed, record
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.policies.loading import TrainedPolicy
from esp_cli.training.build import PolicyController, build_environment, generators
from esp_envs import Body, Scene
from esp_envs.base import Environment
from esp_envs.drawing import TopPainter, draw
from esp_envs.errors import UserError
from esp_envs.views import Compass
from tests.drawing.scenes import RED, episode, line
from tests.training.runs import tiny_config

SEEDS = (3, 7)


@pytest.fixture
def trained(tmp_path) -> TrainedPolicy:
    config = tiny_config(seeds=SEEDS, task__horizon=6)
    spec = build_environment(config, 1, "shape").spec
    policy = StochasticPolicy(spec, config.network, generators(SEEDS, "weights"))
    return TrainedPolicy(config, policy, spec, 0, tmp_path)


@pytest.fixture
def env(trained):
    return build_environment(trained.config, 1, "film")


def filmed(trained, seed, *choice):
    (own,) = record([trained.single_seed(seed)], *choice)
    return own


def test_the_start_and_every_step_of_every_episode_are_recorded(trained):
    episodes = filmed(trained, 3, 2)
    assert [len(episode.scenes) for episode in episodes] == [6 + 1, 6 + 1]
    assert [episode.steps for episode in episodes] == [6, 6]
    flat = [scene for episode in episodes for scene in episode.scenes]
    assert len(set(flat)) == len(flat), "something moves in each"


def test_returns_are_what_the_agents_got_so_far(trained):
    (recorded,) = filmed(trained, 7, 1)
    fresh = build_environment(trained.config, 1, "film")
    controller, observation = PolicyController(trained.policy), fresh.reset()
    controller.begin(fresh, observation)
    expected = [0.0]
    for _ in range(6):
        step = fresh.step(controller.act(fresh, observation))
        observation = step.next
        expected.append(expected[-1] + float(step.reward[1, 0].mean()))
    assert recorded.returns == pytest.approx(expected)
    assert len(set(expected)) == 7


def test_a_recording_ends_where_the_episode_ended_not_where_the_next_begins(trained, env):
    recorded = filmed(trained, 7, 1)[0].scenes
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


def test_a_task_that_cannot_be_put_into_a_state_keeps_its_last_scene_and_one_with_a_compass_shows_its_end(
    trained, monkeypatch
):
    ends = filmed(trained, 7, 1)[0].scenes[-1]
    framed = Compass(build_environment(trained.config, 1, "film"), 0.5)
    framed.reset()
    before = framed.scene((1, 0))
    seen = framed.set_state(framed.reset().state)
    assert seen.obs.shape[-1] == trained.spec.observation.width + 4
    assert framed.scene((1, 0)) != before
    monkeypatch.setattr(type(framed.inner), "set_state", Environment.set_state)
    assert not framed.has("set_state")
    scenes = filmed(trained, 7, 1)[0].scenes
    assert scenes[-1] == scenes[-2] != ends


def test_seeds_and_noise_make_other_recordings_and_the_same_choice_the_same(trained):
    assert filmed(trained, 3, 1) == filmed(trained, 3, 1)
    assert filmed(trained, 3, 1, False) == filmed(trained, 3, 1, False)
    assert filmed(trained, 3, 1) != filmed(trained, 7, 1)
    assert filmed(trained, 3, 1) != filmed(trained, 3, 1, False)


def test_an_episode_begins_alike_however_much_chance_the_one_before_had(trained, monkeypatch):
    first, second = filmed(trained, 3, 2)
    kind = type(build_environment(trained.config, 1, "film"))
    step = kind.step

    def with_chance(env, action):
        torch.rand(1, generator=env.generators[0])
        return step(env, action)

    monkeypatch.setattr(kind, "step", with_chance)
    assert filmed(trained, 3, 2) == [first, second]
    assert first.scenes[0] != second.scenes[0]


def test_an_episode_that_ends_early_ends_the_recording(trained, monkeypatch):
    kind = type(build_environment(trained.config, 1, "film"))
    step = kind.step

    def ending(self, action):
        """Reach the end in the third step."""
        result = step(self, action)
        ended = torch.tensor([[self._time >= 3]])
        return type(result)(result.next, result.reward, ended, result.truncated, result.next, result.metrics)

    monkeypatch.setattr(kind, "step", ending)
    assert [episode.steps for episode in filmed(trained, 7, 2)] == [3, 3]


@pytest.mark.parametrize(("horizon", "episodes"), [(2, 7), (10, 4), (25, 2), (40, 2), (60, 1), (150, 1)])
def test_episodes_follow_each_other_until_a_film_lasts_about_eight_seconds(trained, horizon, episodes):
    config = tiny_config(seeds=SEEDS, task__horizon=horizon)
    recorded = filmed(replace(trained, config=config), 3)
    assert len(recorded) == episodes
    seconds = episodes * (0.1 * horizon + HOLD_SECONDS)
    assert episodes == 1 or abs(seconds - 8) <= (0.1 * horizon + HOLD_SECONDS) / 2


def test_two_policies_play_the_same_episodes(trained, tmp_path):
    other = TrainedPolicy(
        trained.config,
        StochasticPolicy(trained.spec, trained.config.network, generators((8, 9), "weights")),
        trained.spec,
        0,
        tmp_path / "other",
    )
    first, second = record([trained.single_seed(3), other.single_seed(7)], 2)
    assert first == filmed(trained, 3, 2), "the first plays what it plays alone"
    for one, another in zip(first, second, strict=True):
        assert one.scenes[0] == another.scenes[0]
        assert one.scenes[-1] != another.scenes[-1]
    assert record([trained.single_seed(7), other.single_seed(7)], 1)[0] != first[:1]
    crowded = tiny_config(seeds=SEEDS, task__horizon=6, task__num_landmarks=2)
    spec = build_environment(crowded, 1, "shape").spec
    fewer = TrainedPolicy(
        crowded, StochasticPolicy(spec, crowded.network, generators(SEEDS, "weights")), spec, 0, tmp_path / "fewer"
    )
    with pytest.raises(ValueError, match=r"begin differently; compare policies whose task has the same settings"):
        record([trained.single_seed(3), fewer.single_seed(3)], 1)


def test_a_window_grows_until_everything_stays_in_it():
    inside = [[episode(line(3))]]
    assert framed(inside) == inside
    leaving = Scene((Body((1.4, 0.0), 0.1, RED),), (-1.0, 1.0, -1.0, 1.0))
    near = Scene((Body((0.92, 0.0), 0.1, RED),), (-1.0, 1.0, -1.0, 1.0))
    assert framed([[episode([near])]]) == [[episode([near])]], "what sticks out by a hair moves no window"
    (wide, other) = framed([*inside, [episode([leaving, near])]])
    windows = {scene.window for one in (*wide, *other) for scene in one.scenes}
    assert windows == {(-1.5, 1.5, -1.5, 1.5)}, "one for all episodes"
    assert wide[0].scenes[0].bodies == inside[0][0].scenes[0].bodies


def test_shots_keep_the_first_and_last_scene_and_the_time_of_all():
    scenes = line(6)
    taken = shots([[episode(scenes), episode(scenes[:5])]], 2, 0.1, "task")
    (moments,) = zip(*(shot.episodes for shot in taken), strict=True)
    assert [moment.scenes[-1] for moment in moments] == [scenes[k] for k in (0, 2, 4, 5, 0, 2, 4)]
    assert [moment.returns[-1] for moment in moments] == [0, 2, 4, 5, 0, 2, 4]
    assert [shot.steps for shot in taken] == [2, 2, 1, 1, 2, 2, 1]
    assert [shot.time_s for shot in taken] == pytest.approx([0, 0.2, 0.4, 0.5, 0, 0.2, 0.4])
    assert [shot.caption for shot in taken] == ["task, episode 1 of 2"] * 4 + ["task, episode 2 of 2"] * 3
    assert [len(moment.scenes) for moment in moments] == [1, 3, 5, 6, 1, 3, 5], "trails come from every step"
    assert np.array_equal(taken[2].draw(TopPainter(40)), draw(scenes[4], 40, trail=scenes[:4]))


def test_a_film_is_drawn_in_order_and_watched(tmp_path):
    scenes, told = line(5), []
    taken = shots([[episode(scenes)]], 2, 0.1, "task")
    write_film(tmp_path / "film.gif", TopPainter(60), taken, 0.05, told.append)
    assert told == [1, 2, 3]
    with Image.open(tmp_path / "film.gif") as gif:
        assert gif.n_frames == 3
        for k, duration in ((0, 100), (1, 100), (2, 1050)):  # the end stays in view
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
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - shade).max() <= 2
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
    frames = [np.zeros((8, 8, 3), dtype=np.uint8) for _ in range(30)]
    for k, frame in enumerate(frames):
        frame[k // 8, k % 8] = 255
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
    assert np.abs(shown[5, 5] - [250, 250, 247]).max() <= 4, "what there is most of stays"
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
        raise UserError("no library here can draw")
        yield

    monkeypatch.setattr(env, "painter", broken)
    with open_painter(env, "auto", 40) as painter:
        assert painter.note == "no library here can draw; so the view is from above"
        assert painter.draw(env.scene()).shape == (40, 40, 3)
    with pytest.raises(ValueError, match=r"^no library here can draw$"), open_painter(env, "3d", 40):
        pass


def test_the_end_of_every_episode_stays_in_view(tmp_path):
    taken = shots([[episode(line(3)), episode(line(3))]], 1, 0.1, "task")
    write_film(tmp_path / "film.gif", TopPainter(60), taken, 0.1, lambda _: None)
    assert durations(tmp_path / "film.gif") == [100, 100, 1100, 100, 100, 1100]
    write_film(tmp_path / "film.mp4", TopPainter(64), taken, 0.1, lambda _: None)
    assert len(list(iio.imiter(tmp_path / "film.mp4"))) == 2 + 11 + 2 + 11


def test_the_policy_that_ends_first_waits_for_the_other():
    scenes = line(6)
    taken = shots([[episode(scenes)], [episode(scenes[:3])]], 2, 0.1, "task", ("long", "short"))
    pairs = [[moment.scenes[-1] for moment in shot.episodes] for shot in taken]
    assert pairs == [[scenes[k], scenes[min(k, 2)]] for k in (0, 2, 4, 5)]
    assert [moment.name for moment in taken[0].episodes] == ["long", "short"]
    assert [moment.returns[-1] for moment in taken[-1].episodes] == [5, 2]
