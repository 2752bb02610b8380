"""MADDPG and QMIX with and without the prior: what must be equal bit for bit, and what must not."""

from functools import cache

import pytest
import torch

from esp_cli.algorithms.normalisation import ValueNormaliser
from esp_cli.training.config import resolve_config
from esp_envs.errors import UserError
from tests.algorithms.off_policy import after, equal, learner, networks, turn

ALGORITHMS = ["maddpg", "qmix"]
both = pytest.mark.parametrize("algorithm", ALGORITHMS)


@cache
def plain(algorithm):
    return after(algorithm, prior__kind="none")[0]


@both
def test_no_copies_and_no_coefficient_is_the_plain_algorithm_bit_for_bit(algorithm):
    silent, _ = after(algorithm, prior__kind="consistency", prior__consistency_coef=0.0)
    spoken, _ = after(algorithm, prior__kind="consistency", prior__consistency_coef=1e-3)
    assert equal(plain(algorithm), silent)
    assert not equal(plain(algorithm), spoken), "negative control: a coefficient does change the run"


@both
@pytest.mark.parametrize("kind", ["esp", "augment", "consistency"])
@pytest.mark.parametrize("replay", ["sampled", "stored"])
def test_each_mean_of_the_prior_changes_the_run(algorithm, kind, replay):
    other, _ = after(algorithm, prior__kind=kind, prior__replay=replay)
    assert not equal(plain(algorithm), other)


@both
@pytest.mark.parametrize(
    "choice", [{"prior__kind": "none"}, {"prior__replay": "stored"}, {"network__name": "gru"}, {}], ids=str
)
def test_a_seed_learns_the_same_alone_and_among_others(algorithm, choice):
    """Up to the rounding of float32: 1e-4 of a weight, 1e-5 absolutely, after eight gradient steps."""
    together, _ = after(algorithm, seeds=(7, 8, 9), **choice)
    alone, _ = after(algorithm, seeds=(8,), **choice)
    for name, tensor in alone.items():
        torch.testing.assert_close(tensor[0], together[name][1], rtol=1e-4, atol=1e-5)
    assert not any(torch.equal(together[name][0], together[name][1]) for name in together if name.endswith("weight"))


@both
@pytest.mark.parametrize(("network", "replay"), [("mlp", "sampled"), ("gru", "stored")])
def test_a_learner_restored_between_iterations_goes_on_bit_for_bit_with_its_replay(algorithm, network, replay):
    choice = {"network__name": network, "prior__replay": replay}
    straight, halted = learner(algorithm, **choice), learner(algorithm, **choice)
    for _ in range(3):
        straight.iterate(0.0)
        halted.iterate(0.0)
    resumed = learner(algorithm, **choice)
    resumed.load_state_dict({name: tensor.clone() for name, tensor in halted.state_dict().items()})
    for _ in range(3):
        ours, theirs = straight.iterate(0.0).metrics, resumed.iterate(0.0).metrics
        assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert equal(straight.state_dict(), resumed.state_dict())
    assert (straight.episodes, straight.updates) == (24, 24)
    other = learner(algorithm, **choice)
    other.load_state_dict({n: t for n, t in halted.state_dict().items() if not n.startswith("replay")})
    assert other.replay.size == 0, "a complete run's checkpoint has no replay"
    for wrong in ({"replay.cursor": torch.tensor([1, 2])}, {"replay.cursor": torch.tensor(torch.nan)}):
        with pytest.raises(UserError, match="do not fit into the replay"):
            other.load_state_dict(halted.state_dict() | wrong)
    with pytest.raises(UserError, match="it has no counters"):
        other.load_state_dict(halted.state_dict() | {"counters": torch.tensor([torch.nan, 1.0])})


@both
def test_a_complete_run_leaves_its_replay_behind(algorithm):
    trained = learner(algorithm)
    trained.iterate(0.0)
    assert any(name.startswith("replay") for name in trained.state_dict())
    assert not any(name.startswith("replay") for name in trained.state_dict(complete=True))


@both
def test_random_episodes_come_first_and_epsilon_falls_linearly(algorithm):
    trained = learner(algorithm, algo__epsilon_steps=400, algo__epsilon_finish=0.2, algo__warmup_episodes=4)
    before = networks(trained)
    seen = [trained.iterate(0.0).metrics["train/epsilon"] for _ in range(6)]
    # an iteration is two rounds of two episodes of 25 steps; logged is the epsilon of its second round
    shares = torch.stack([(torch.tensor(100.0 * k + 50) / 400).clamp(max=1) for k in range(6)])
    expected = 1 - 0.8 * shares
    expected[0] = 1.0
    torch.testing.assert_close(torch.stack(seen), expected.unsqueeze(1).expand(6, 2))
    assert not equal(before, networks(trained))
    waiting = learner(algorithm, algo__warmup_episodes=100)
    metrics = waiting.iterate(0.0).metrics
    assert equal(
        {k: v for k, v in before.items() if "epsilon" not in k},
        {k: v for k, v in networks(waiting).items() if "epsilon" not in k},
    )
    assert set(metrics) == {"train/return", "train/epsilon", "train/augmented_share"}


@both
def test_every_iteration_logs_what_the_page_promises(algorithm):
    _, metrics = after(algorithm)
    names = (
        "return epsilon augmented_share td_loss value value_symmetry_error "
        + {"maddpg": "critic_grad_norm policy_loss actor_grad_norm entropy policy_symmetry_error", "qmix": "grad_norm"}[
            algorithm
        ]
    )
    assert set(metrics[-1]) == {f"train/{name}" for name in names.split()}
    assert all(value.shape == (2,) and value.isfinite().all() for value in metrics[-1].values())
    assert metrics[-1]["train/augmented_share"].tolist() == [0.5, 0.5]


EVERYTHING = [
    {"prior__transforms": "d4*agents"},
    {"prior__transforms": "c4", "prior__copies": "all"},
    {"prior__transforms": "c4", "prior__copies": "all", "prior__replay": "stored", "algo__replay_episodes": 40},
    {"task__convention": "pettingzoo", "prior__transforms": "agents"},
    {"task": "predator-prey", "task__prey": "fleeing", "network__name": "gru"},
    {"task": "predator-prey", "task__control": "prey"},
    {"task__num_agents": 1, "algo__td_lambda": 0.5},
    {"algo__bootstrap_truncated": True, "algo__critic_sees_time": False},
    {"network__layer_norm": True},
]
CONTINUOUS = [
    {"task__actions": "continuous", "prior__transforms": "o2"},
    {"task__actions": "continuous", "prior__transforms": "so2", "network__name": "gru", "prior__replay": "stored"},
    {"task": "predator-prey", "task__actions": "continuous", "prior__transforms": "d4"},
    {"algo__actor_actions": "all", "algo__critic_input": "state"},
]


@pytest.mark.parametrize(
    ("algorithm", "choice"),
    [(a, c) for a in ALGORITHMS for c in EVERYTHING] + [("maddpg", c) for c in CONTINUOUS],
    ids=str,
)
def test_every_choice_learns_without_breaking(algorithm, choice):
    _, metrics = after(algorithm, **choice)
    assert all(value.isfinite().all() for value in metrics[-1].values())


@both
def test_the_paper_preset_is_supplement_table_3(algorithm):
    config = resolve_config("navigation", algorithm, preset="paper")
    settings, network, prior = config.algorithm_settings, config.network, config.prior
    names = "num_envs updates_per_episode batch_episodes replay_episodes warmup_episodes epsilon_start epsilon_finish"
    assert [settings[name] for name in names.split()] == [1, 1, 32, 5000, 5, 1.0, 0.05]
    assert (settings["epsilon_steps"], settings["learning_rate"], settings["gamma"]) == (50_000, 7e-4, 0.99)
    assert (settings["adam_epsilon"], settings["max_grad_norm"], settings["huber_delta"]) == (1e-5, 10.0, 10.0)
    assert (network.name, network.layer_norm, network.hidden) == ("gru", True, (64, 64))
    assert (prior.transforms, prior.consistency_coef, prior.replay) == ("rot90", 0.5, "stored")


@both
def test_stored_copies_share_the_replay_and_sampled_ones_do_not(algorithm):
    stored = learner(algorithm, prior__replay="stored", prior__transforms="rot90")
    sampled = learner(algorithm, prior__transforms="rot90")
    stored.iterate(0.0)
    sampled.iterate(0.0)
    assert (stored.replay.size, sampled.replay.size) == (7, 4), "8 of which 7 fit, and 4"
    g = turn(stored.spec)
    places = torch.arange(4).expand(2, 4)
    original, copies = sampled.replay.select(places), stored.replay.select((places + 4) % 7)
    assert torch.equal(copies.obs[:, :2], original.obs[:, 2:]), "the second round's episodes"
    assert torch.equal(copies.obs[:, 2], g.obs(original.obs[:, 2])), "and behind them their copies"


@both
@pytest.mark.parametrize(("anneal", "share"), [(True, 0.25), (False, 1.0)])
def test_the_learning_rate_falls_linearly_where_asked(algorithm, anneal, share):
    trained = learner(algorithm, algo__anneal_learning_rate=anneal)
    for progress in (0.5, 0.75):  # the share is of the first rate, not of the last
        trained.iterate(progress)
    expected = pytest.approx(trained.config.learning_rate * share)
    for optimiser in trained.optimisers.values():
        assert optimiser.learning_rate == expected


@both
@pytest.mark.parametrize(("task", "share"), [("navigation", 0.0), ("wildlife", 1.0)])
def test_a_reward_for_every_step_counts_where_episodes_end_early_alone(algorithm, task, share):
    """Paid 1 a step, a longer episode is worth more; of episodes of one length all are alike, and the mean is taken."""
    trained = learner(algorithm, task)
    batch, _ = trained.collector.collect()
    ones = torch.ones_like(batch.reward[..., :1])
    trained.reward_scale = ValueNormaliser(2, 0.9)
    trained.reward_scale.update(ones)
    batch.terminated, batch.valid = torch.zeros_like(batch.terminated), torch.ones_like(batch.valid)
    following = torch.zeros(*batch.terminated.shape, 1)
    targets = trained.td_targets(batch, ones, following)[..., 0]
    steps, gamma = trained.spec.horizon, trained.config.gamma * trained.config.td_lambda
    expected = share * steps**-0.5 * (1 - gamma**steps) / (1 - gamma)
    torch.testing.assert_close(targets[:, :, 0], torch.full_like(targets[:, :, 0], expected))


@pytest.mark.parametrize(("algorithm", "optimiser"), [("maddpg", "actor"), ("maddpg", "critic"), ("qmix", "adam")])
def test_a_gradient_that_is_not_finite_stops_its_seed(algorithm, optimiser):
    trained = learner(algorithm)
    step = trained.optimisers[optimiser].step

    def broken(gradient):
        (norm,) = step(gradient)
        norm[1] = torch.nan
        return [norm]

    trained.optimisers[optimiser].step = broken
    result = trained.iterate(0.0)
    assert result.finite.tolist() == [True, False]
    assert all(value.isfinite().all() for name, value in result.metrics.items() if name.endswith("loss"))


@both
def test_every_episode_brings_its_gradient_steps(algorithm):
    trained = learner(algorithm, algo__updates_per_episode=3)
    trained.iterate(0.0)
    assert trained.updates == 12, "3 for each of two worlds in each of two rounds"


@both
def test_the_numbers_of_an_iteration_are_means_over_its_rounds_and_its_gradient_steps(algorithm):
    """Returns of 1 and 5, and losses of 1, 2, 3, 4 in the four gradient steps of two rounds."""
    trained = learner(algorithm)
    collect, returns, losses = trained.collector.collect, iter((1.0, 5.0)), iter((1.0, 2.0, 3.0, 4.0))
    trained.collector.collect = lambda: (collect()[0], torch.full((2,), next(returns)))
    trained.update = lambda batch: {"td_loss": torch.full((2,), next(losses))}
    metrics = trained.iterate(0.0).metrics
    assert metrics["train/return"].tolist() == [3.0, 3.0]
    assert metrics["train/td_loss"].tolist() == [2.5, 2.5]


@both
def test_the_reward_statistics_forget_by_the_episode(algorithm):
    """A round of eight episodes of rewards 0 leaves 0.999^8 of what was there, one of four 0.999^4."""
    for worlds, kept in ((4, 0.99600), (8, 0.99203)):
        trained = learner(algorithm, algo__num_envs=worlds, algo__replay_episodes=20)
        trained.reward_scale.mean.fill_(1.0)
        trained.reward_scale.weight.fill_(1.0)
        episodes, _ = trained.collector.collect()
        episodes.reward.zero_()
        trained._store(episodes)
        torch.testing.assert_close(trained.reward_scale.mean, torch.full((2,), kept).double(), atol=1e-5, rtol=0)
