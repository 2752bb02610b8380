"""Films: every step of every episode of the chosen seed, drawn without a display."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from esp_cli.experiments.rendering import film, write_gif
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.training.evaluation import PolicyController
from esp_cli.training.loading import TrainedPolicy
from esp_cli.training.streams import generators
from esp_cli.training.trainer import build_environment
from esp_envs.drawing import draw
from tests.training.runs import tiny_config

SEEDS = (3, 7)


@pytest.fixture
def trained(tmp_path) -> TrainedPolicy:
    config = tiny_config(seeds=SEEDS, task__horizon=6)
    spec = build_environment(config, 1, "shape").spec
    policy = StochasticPolicy(spec, config.network, generators(SEEDS, "weights"))
    return TrainedPolicy(config, policy, spec, 0, tmp_path)


def test_a_film_shows_the_start_and_every_step_of_every_episode(trained):
    frames = film(trained, 3, 2, 40)
    assert len(frames) == 2 * (6 + 1)
    assert all(frame.shape == (40, 40, 3) and frame.dtype == np.uint8 for frame in frames)
    assert len({frame.tobytes() for frame in frames}) == len(frames), "something moves in each"


def test_a_film_ends_where_the_episode_ended_not_where_the_next_begins(trained):
    frames = film(trained, 7, 1, 40)
    env = build_environment(trained.config, 1, "film")
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
    for k in (0, 3, 6):
        assert np.array_equal(frames[k], draw(scenes[k], 40, trail=scenes[:k]))


def test_seeds_and_noise_make_other_films_and_the_same_choice_the_same(trained):
    def content(*choice):
        return np.stack(film(trained, *choice)).tobytes()

    assert content(3, 1, 40) == content(3, 1, 40)
    assert content(3, 1, 40, False) == content(3, 1, 40, False)
    assert len({content(3, 1, 40), content(7, 1, 40), content(3, 1, 40, False)}) == 3


def test_a_seed_that_the_run_has_not_is_refused(trained):
    with pytest.raises(ValueError, match=r"has no seed 5; it has 3, 7"):
        film(trained, 5, 1, 40)


def test_an_episode_that_ends_early_ends_the_film(trained, monkeypatch):
    kind = type(build_environment(trained.config, 1, "film"))
    step = kind.step

    def ending(self, action):
        """Seed 7's world reaches its end in the third step, seed 3's in the second."""
        result = step(self, action)
        ended = torch.tensor([[self._time >= 2], [self._time >= 3]])
        return type(result)(result.next, result.reward, ended, result.truncated, result.next, result.metrics)

    monkeypatch.setattr(kind, "step", ending)
    assert len(film(trained, 3, 1, 40)) == 1 + 2
    assert len(film(trained, 7, 2, 40)) == 2 * (1 + 3)


def test_a_gif_holds_the_frames_at_their_rate_and_for_ever(tmp_path):
    shades = [np.full((20, 30, 3), 40 * k, dtype=np.uint8) for k in range(5)]
    write_gif(tmp_path / "new" / "film.gif", shades, frames_per_second=20)
    with Image.open(tmp_path / "new" / "film.gif") as gif:
        assert (gif.n_frames, gif.size, gif.info["duration"], gif.info["loop"]) == (5, (30, 20), 50, 0)
        for k, shade in enumerate(shades):
            gif.seek(k)
            assert np.abs(np.asarray(gif.convert("RGB")).astype(int) - shade).max() <= 8


def test_a_gif_that_cannot_be_written_leaves_nothing_behind(tmp_path):
    (tmp_path / "film.gif").mkdir()
    with pytest.raises(IsADirectoryError):
        write_gif(tmp_path / "film.gif", [np.zeros((8, 8, 3), dtype=np.uint8)], 10)
    assert [entry.name for entry in tmp_path.iterdir()] == ["film.gif"]
