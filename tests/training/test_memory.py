"""A run that needs more memory than the machine has is refused before the memory is taken."""

import pytest

from esp_cli.algorithms.presets import ALGORITHMS
from esp_cli.training import build
from esp_cli.training.build import build_learner, spec_of
from esp_cli.training.config import resolve_config


@pytest.mark.parametrize(
    ("algorithm", "setting", "value"),
    [
        ("mappo", "mappo.num_envs", 10**9),
        ("mappo", "mappo.num_steps", 10**10),
        ("mappo", "evaluation.episodes", 10**12),
        ("qmix", "qmix.replay_episodes", 10**9),
        ("maddpg", "maddpg.batch_episodes", 10**9),
    ],
)
def test_a_setting_that_asks_for_too_much_is_named_with_what_it_needs(algorithm, setting, value):
    config = resolve_config("navigation", algorithm, overrides={setting: value})
    with pytest.raises(ValueError, match=r"needs at least [\d,]+\.\d GB of memory, .* for '.*' with 1 seeds, but cpu"):
        build_learner(config)


def test_the_bound_counts_what_the_replay_holds():
    config = resolve_config("navigation", "qmix", seeds=(0, 1))
    learner = build_learner(config)
    settings = ALGORITHMS["qmix"].config_class(**config.algorithm_settings)
    counted = build.least_bytes(config, settings, learner.spec)["qmix.replay_episodes"]
    held = sum(tensor.nbytes for tensor in learner.replay._store.tensors.values())
    assert 0.8 * held < counted <= held


def test_a_machine_with_less_memory_refuses_what_a_larger_one_takes(monkeypatch):
    config = resolve_config("navigation")
    build_learner(config)
    monkeypatch.setattr(build, "machine_bytes", lambda device: 10_000)
    with pytest.raises(ValueError, match=r"but cpu has 0\.0 GB"):
        build_learner(config)


def test_a_container_has_the_memory_that_it_may_take(monkeypatch, tmp_path):
    installed = build.machine_bytes("cpu")
    for content, expected in (("1000000\n", 1_000_000), ("max\n", installed), (f"{2 * installed}\n", installed)):
        (tmp_path / "memory.max").write_text(content)
        monkeypatch.setattr(build, "_LIMITS", (tmp_path / "memory.max", tmp_path / "nothing"))
        assert build.machine_bytes("cpu") == expected


def test_every_seed_counts():
    one, ten = (resolve_config("formation", seeds=range(count)) for count in (1, 10))
    settings = ALGORITHMS["mappo"].config_class(**one.algorithm_settings)
    needed = build.least_bytes(one, settings, spec_of(one))
    assert build.least_bytes(ten, settings, spec_of(ten)) == {name: 10 * size for name, size in needed.items()}


def test_a_process_on_a_cluster_is_given_room_for_its_replay_and_its_libraries():
    small, large = (resolve_config("navigation", "qmix", seeds=range(count)) for count in (1, 10))
    settings = ALGORITHMS["qmix"].config_class(**small.algorithm_settings)
    held = sum(build.least_bytes(small, settings, spec_of(small)).values())
    given = [build.process_bytes(config, spec_of(config)) for config in (small, large)]
    assert given[0] > 500e6 + held
    assert given[1] - given[0] == 2 * 9 * held


def test_the_frame_of_a_compass_takes_room_in_every_row():
    plain, framed = (resolve_config("navigation", "qmix", overrides={"prior.compass": length}) for length in (0.0, 1.0))
    settings = ALGORITHMS["qmix"].config_class(**plain.algorithm_settings)
    rows = [build.least_bytes(config, settings, spec_of(config))["qmix.replay_episodes"] for config in (plain, framed)]
    frame_width = 4  # two vectors, seen by each of three agents and once in the state
    steps = settings.replay_episodes * spec_of(plain).horizon
    assert rows[1] - rows[0] == steps * (3 + 1) * frame_width * 4
