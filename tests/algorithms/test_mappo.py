"""MAPPO with and without the prior: what must be equal bit for bit, and what must not."""

import copy
import math
from dataclasses import replace

import pytest
import torch

from esp_cli.algorithms.rollout import Batch, Rollout, values_along
from esp_cli.prior.symmetry_prior import SymmetryPrior
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config
from esp_envs.base import Observation
from tests.algorithms.off_policy import on_perceptron

SMALL = {"mappo.num_envs": 4, "mappo.num_epochs": 2, "mappo.num_minibatches": 2, "network.hidden": [16, 16]}


def learner(task="navigation", seeds=(0, 1), **overrides):
    settings = SMALL | on_perceptron(task) | {name.replace("__", "."): value for name, value in overrides.items()}
    return build_learner(resolve_config(task, steps=10_000, seeds=seeds, overrides=settings))


def weights(trained):
    return {
        name: tensor.clone() for name, tensor in trained.state_dict().items() if name.startswith(("policy", "critic"))
    }


def after(iterations=2, **choice):
    trained = learner(**choice)
    metrics = [trained.iterate(0.0).metrics for _ in range(iterations)]
    return weights(trained), metrics


def equal(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)


def test_no_copies_and_no_coefficient_is_the_plain_algorithm_bit_for_bit():
    plain, _ = after(prior__kind="none")
    silent, _ = after(prior__kind="consistency", prior__consistency_coef=0.0)
    spoken, _ = after(prior__kind="consistency", prior__consistency_coef=1e-3)
    assert equal(plain, silent)
    assert not equal(plain, spoken), "negative control: a coefficient does change the run"


WIDE = {"network__hidden": [64, 64]}


@pytest.mark.parametrize(
    "choice",
    [{"prior__kind": "none"}, {"prior__kind": "esp"}, {"network__name": "gru"}, {"network__precision": "bfloat16"}],
)
def test_a_seed_learns_the_same_alone_and_among_others(choice):
    """Up to the rounding of float32: vectorised kernels round the ends of their arrays otherwise than the middle."""
    together, _ = after(seeds=(7, 8, 9), **WIDE, **choice)
    alone, _ = after(seeds=(8,), **WIDE, **choice)
    for name, tensor in alone.items():
        torch.testing.assert_close(tensor[0], together[name][1], rtol=1e-4, atol=1e-6)
    assert not any(torch.equal(together[name][0], together[name][1]) for name in together if name.endswith("weight"))


def test_recomputed_old_log_probability_starts_the_ratio_at_one_and_a_copied_one_does_not():
    def first_ratio(rule):
        trained = learner(prior__kind="augment", prior__transforms="rot90", prior__old_log_prob=rule)
        trained.iterate(0.0)
        batch, _ = trained.prepare(trained.collector.collect(25))
        trained._remember_old_networks()
        copies = trained.prior.copies(batch, trained.generators["prior"], trained.reevaluated)
        rows = copies.rows.map(lambda x: x[:, batch.count :])
        log_prob = trained.policy.head.log_prob(trained.policy.unroll(rows.obs), rows.action)
        return (log_prob - rows.log_prob).abs().max().item()

    assert first_ratio("recompute") < 1e-5
    assert first_ratio("copy") > 1e-3


def test_a_transformed_batch_turns_what_turns_and_keeps_what_stays():
    trained = learner(prior__transforms="rot90")
    batch, _ = trained.prepare(trained.collector.collect(25))
    copies = trained.prior.copies(batch, trained.generators["prior"])
    turned = copies.rows.map(lambda x: x[:, batch.count :])
    x, y = batch.obs[..., 0], batch.obs[..., 1]
    torch.testing.assert_close(turned.obs[..., 0], -y)
    torch.testing.assert_close(turned.obs[..., 1], x)
    names = trained.spec.action.names
    assert (turned.action[batch.action == names.index("right")] == names.index("up")).all()
    assert torch.equal(turned.advantage, batch.advantage)
    assert torch.equal(turned.target, batch.target)


def test_advantages_are_normalised_before_rows_are_copied():
    trained = learner()
    batch, _ = trained.prepare(trained.collector.collect(25))
    torch.testing.assert_close(batch.advantage.flatten(1).mean(1), torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(batch.advantage.flatten(1).std(1), torch.ones(2), atol=1e-2, rtol=0)


def test_every_update_logs_what_the_page_promises():
    _, metrics = after(prior__kind="none")
    names = (
        "return explained_variance clip_fraction kl entropy policy_loss value_loss actor_grad_norm critic_grad_norm "
        "augmented_share policy_symmetry_error value_symmetry_error"
    )
    assert set(metrics[-1]) == {f"train/{name}" for name in names.split()}
    assert all(value.shape == (2,) and value.isfinite().all() for value in metrics[-1].values())
    _, augmented = after(prior__kind="esp")
    assert augmented[-1]["train/augmented_share"].tolist() == [0.5, 0.5]


def test_chunks_change_speed_only():
    whole, _ = after()
    cut, _ = after(mappo__chunk_steps=13)
    for name, tensor in whole.items():
        torch.testing.assert_close(tensor, cut[name], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    "choice",
    [
        {"prior__transforms": "d4*agents", "prior__old_log_prob": "recompute"},
        {"prior__transforms": "c4", "prior__copies": "all", "mappo__clip_value": True},
        {"task__actions": "continuous", "prior__transforms": "o2"},
        {"task__convention": "pettingzoo", "prior__transforms": "agents"},
        {"task": "predator-prey", "prior__transforms": "d4*agents"},
        {"network__name": "gru", "network__layer_norm": True, "mappo__critic_input": "state"},
        {"network__precision": "bfloat16"},
        {"mappo__bootstrap_truncated": False, "mappo__anneal_learning_rate": True, "mappo__anneal_entropy": True},
    ],
)
def test_choices_combine(choice):
    tensors, metrics = after(**choice)
    assert all(tensor.isfinite().all() for tensor in tensors.values())
    assert all(value.isfinite().all() for value in metrics[-1].values())


def test_a_rollout_has_a_row_for_every_minibatch():
    with pytest.raises(ValueError, match="100 rows to share"):
        learner(mappo__num_minibatches=101)


def test_batches_cut_select_and_join_without_mixing_seeds():
    rows = torch.arange(2 * 6).view(2, 6, 1, 1)
    batch = Batch(*(rows for _ in range(7)))
    assert torch.equal(Batch.concatenate(batch.chunks(4)).obs, rows)
    assert [piece.obs.shape[1] for piece in batch.chunks(4)] == [4, 2]
    chosen = batch.select(torch.tensor([[5, 0], [1, 1]]))
    assert chosen.action.flatten(1).tolist() == [[5, 0], [7, 7]]


def test_the_final_states_of_cut_episodes_alone_are_valued_and_ends_have_no_value_beyond():
    settings = {"task__horizon": 4, "task__width": 3, "task__height": 3, "task__num_agents": 2}
    settings |= {"mappo__num_envs": 12, "mappo__num_steps": 8, "prior__kind": "none"}
    trained = learner("wildlife", **settings)
    rollout = trained.collector.collect(8)
    cut = rollout.ended & ~rollout.terminated
    assert cut.any()
    assert rollout.terminated.any()
    with torch.no_grad():
        _, following = values_along(trained.critic, rollout, None)
        for t in range(8):
            final = rollout.finals[t]
            expected = trained.critic.unroll(final.obs.unsqueeze(2), final.state.unsqueeze(2)).squeeze(2)
            torch.testing.assert_close(following[:, :, t][cut[:, :, t]], expected[cut[:, :, t]])
    # what comes after an end is another episode: its value must not matter
    batch, _ = trained.prepare(rollout)
    marred = copy.deepcopy(rollout)
    for t, final in marred.finals.items():
        final.obs[rollout.terminated[:, :, t]] = 7.0
    again, _ = learner("wildlife", **settings).prepare(marred)
    torch.testing.assert_close(again.advantage, batch.advantage)


@pytest.mark.parametrize("group", ["actor", "critic"])
def test_a_gradient_that_is_not_finite_stops_its_seed(group):
    trained = learner()
    step = trained.optimiser.apply

    def broken(gradient):
        norms = dict(zip(("actor", "critic"), step(gradient), strict=True))
        norms[group][1] = torch.nan
        return [*norms.values()]

    trained.optimiser.apply = broken
    result = trained.iterate(0.0)
    assert result.finite.tolist() == [True, False]
    assert all(result.metrics[f"train/{name}"].isfinite().all() for name in ("policy_loss", "value_loss"))


def test_the_numbers_of_an_update_are_means_over_its_minibatches():
    """A fresh policy is nearly uniform over five actions: its entropy is ln 5."""
    metrics = learner(mappo__num_minibatches=4, mappo__learning_rate=1e-12).iterate(0.0).metrics
    torch.testing.assert_close(metrics["train/entropy"], torch.full((2,), math.log(5)), atol=1e-3, rtol=0)


@pytest.mark.parametrize(("clip", "fraction", "loss"), [(0.2, 1.0, -1.2), (1.5, 0.0, -2.0)])
def test_what_is_logged_of_the_policy_by_hand(clip, fraction, loss):
    """The probability of what was done is 1/2 and was 1/4: a ratio of 2, for an advantage of 1."""
    trained = learner(mappo__clip_epsilon=clip, prior__kind="none")
    batch, _ = trained.prepare(trained.collector.collect(25))
    ones = torch.ones_like(batch.log_prob)
    batch = replace(batch, action=torch.zeros_like(batch.action), log_prob=ones * math.log(1 / 4), advantage=ones)
    outputs = torch.tensor([1 / 2, 1 / 8, 1 / 8, 1 / 8, 1 / 8]).log().expand(*ones.shape, 5)
    sums = {}
    trained._watch(batch, outputs, batch.value, 1.0, sums)
    expected = {
        "clip_fraction": fraction,
        "kl": 2 - 1 - math.log(2),
        "entropy": math.log(2) / 2 + 4 * math.log(8) / 8,
        "policy_loss": loss,
    }
    for name, number in expected.items():
        torch.testing.assert_close(sums[name], torch.full((2,), number))


def test_the_return_is_that_of_each_episode_alone():
    """A reward of 1 a step for 25 steps, of episodes that end in the third, the fifth and the eighth rollout."""
    trained = learner()
    step = trained.collector.env.step
    trained.collector.env.step = lambda action: replace(step(action), reward=torch.ones(2, 4, 3))
    returns = []
    for _ in range(8):
        trained.collector.collect(10)
        returns.append(trained.collector.pop_mean_return().nan_to_num(-1.0).tolist())
    assert returns == [[number] * 2 for number in (-1.0, -1.0, 25.0, -1.0, 25.0, -1.0, -1.0, 25.0)]


@pytest.mark.parametrize(("anneal", "share"), [(True, 0.25), (False, 1.0)])
def test_rate_and_entropy_fall_linearly_where_asked(anneal, share):
    trained = learner(
        mappo__anneal_learning_rate=anneal,
        mappo__anneal_entropy=anneal,
        mappo__learning_rate=0.008,
        mappo__entropy_coef=0.04,
    )
    rollout, step, seen = trained.collector.collect(25), trained._gradient_step, []
    trained._gradient_step = lambda rows, entropy, sums: seen.append(entropy) or step(rows, entropy, sums)
    for progress in (0.5, 0.75):  # the share is of the first rate, not of the last
        seen.clear()
        trained.update(rollout, progress)
    assert trained.optimiser.learning_rate == pytest.approx(0.008 * share)
    assert seen == [pytest.approx(0.04 * share)] * 4, "two minibatches in two epochs"


@pytest.mark.parametrize(("bootstrap", "last"), [(True, 6.0), (False, 1.0)])
def test_the_target_of_a_cut_episode_by_hand(bootstrap, last):
    """Rewards of 1, values of 0 but for 10 of the final states: 1 + 0.5 x 10 where the final state is valued."""
    trained = learner(mappo__bootstrap_truncated=bootstrap, mappo__gamma=0.5, mappo__gae_lambda=0.0)
    rollout = trained.collector.collect(25)
    rollout.reward.fill_(1.0)
    trained.normaliser.begin = lambda *rewards, **choice: None  # rewards of 1 alone are an offset
    trained.critic.unroll = lambda obs, state: obs.new_full((*obs.shape[:3], 1), 10.0 if obs.shape[2] == 1 else 0.0)
    batch, _ = trained.prepare(rollout)
    targets = trained.normaliser.denormalise(batch.target).view(2, 4, 25)
    torch.testing.assert_close(targets, torch.tensor([1.0] * 24 + [last]).expand(2, 4, 25))


def test_minibatches_take_every_row_once_in_an_order_of_each_seed_and_epoch():
    trained = learner(mappo__num_minibatches=4)
    batch, _ = trained.prepare(trained.collector.collect(25))
    numbers = torch.arange(100.0)
    batch = replace(batch, value=numbers.view(1, 100, 1, 1).expand(2, 100, 1, 1))
    orders = []
    for _ in range(2):
        parts = trained._minibatches(batch)
        assert [part.value.shape[1] for part in parts] == [25] * 4
        orders += torch.cat([part.value for part in parts], 1).flatten(1).unbind(0)
    assert all(torch.equal(order.sort().values, numbers) for order in orders)
    assert len({tuple(order.tolist()) for order in [numbers, *orders]}) == 5


@pytest.mark.parametrize(("agents", "steps"), [(3, 100), (16, 100), (100, 16)])
def test_symmetry_errors_are_measured_on_as_many_agents_of_large_teams(agents, steps, monkeypatch: pytest.MonkeyPatch):
    seen = []
    monkeypatch.setattr(SymmetryPrior, "errors", lambda self, batch, evaluate: seen.append(batch.obs.shape) or {})
    many = {"task__num_agents": agents, "task__sees": 2, "task__density": 8} if agents > 3 else {}
    trained = learner(mappo__num_envs=5, mappo__num_epochs=1, network__name="set", mappo__critic_input="own", **many)
    trained.iterate(0.0)
    assert seen[0][1:4] == (steps, 1, agents)


RECOMPUTED = {
    "mappo__clip_value": True,
    "prior__kind": "augment",
    "prior__transforms": "rot90",
    "prior__old_log_prob": "recompute",
}


def test_old_probabilities_and_values_are_those_of_the_networks_that_collected():
    trained = learner(**RECOMPUTED)
    batch, _ = trained.prepare(trained.collector.collect(25))
    trained._remember_old_networks()
    before = trained.reevaluated(batch)
    trained.optimiser.parameters.buffer.add_(torch.linspace(-1, 1, trained.optimiser.parameters.buffer.shape[1]))
    after = trained.reevaluated(batch)
    assert torch.equal(after.log_prob, before.log_prob)
    assert torch.equal(after.value, before.value)
    trained._remember_old_networks()
    now = trained.reevaluated(batch)
    assert (now.log_prob - before.log_prob).abs().max() > 0.01, "the control"
    assert (now.value - before.value).abs().max() > 0.1, "the control"


def test_the_memory_of_a_world_is_empty_where_its_episode_ended_and_there_alone():
    collector = learner(network__name="gru").collector
    collector.collect(10)
    assert (collector.memory.abs().amax(2) > 0).all(), "they remember within an episode"
    kept, ended = collector.memory.clone(), torch.tensor([[False, True, False, False], [True, False, False, True]])
    collector._finish(torch.zeros(2, 4, 3), ended, True)
    memory, kept = (x.view(2, 4, 3, -1) for x in (collector.memory, kept))
    assert (memory[ended] == 0).all()
    assert torch.equal(memory[~ended], kept[~ended])
    collector.collect(15)
    assert (collector.memory == 0).all(), "the horizon ended all"


def test_the_next_value_along_whole_episodes_is_that_of_the_step_after():
    """Of a critic that says how many steps it has seen: 0 to 24, and 1 to 25 behind them, in each of two episodes."""
    trained = learner(network__name="gru", mappo__num_steps=50)
    rollout = trained.collector.collect(50)
    steps = torch.arange(26.0).view(26, 1)
    trained.critic.unroll = lambda obs, state: steps[: obs.shape[2]].expand(*obs.shape[:2], -1, 1)
    value, following = values_along(trained.critic, rollout, 25)
    assert torch.equal(value, steps[:25].repeat(2, 1).expand(2, 4, 50, 1))
    assert torch.equal(following - value, torch.ones(2, 4, 50, 1))


def test_the_value_of_what_followed_is_looked_up_anew_in_worlds_that_ended_alone():
    """Where another world's end would have it computed anew, its last bits would depend on that world."""

    class Counting:
        calls = 0

        def unroll(self, obs, state):
            self.calls += 1
            return torch.full((*obs.shape[:3], 1), float(self.calls))

    obs, state, flags = torch.zeros(1, 2, 3, 1, 1), torch.zeros(1, 2, 3, 1), torch.zeros(1, 2, 3, dtype=torch.bool)
    ended, seen = flags.clone(), Observation(obs[:, :, 0], state[:, :, 0])
    ended[0, 1, 1] = True
    rollout = Rollout(obs, state, obs, obs, obs, flags, ended, seen, {1: seen})
    _, following = values_along(Counting(), rollout, None)
    assert following[0, :, :, 0].tolist() == [[1, 1, 2], [1, 3, 2]]
