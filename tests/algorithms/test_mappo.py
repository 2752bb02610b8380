"""MAPPO with and without the prior: what must be equal bit for bit, and what must not."""

import copy

import pytest
import torch

from esp_cli.algorithms.rollout import Batch, values_along
from esp_cli.training.build import build_learner
from esp_cli.training.config import resolve_config

SMALL = {"mappo.num_envs": 4, "mappo.num_epochs": 2, "mappo.num_minibatches": 2, "network.hidden": [16, 16]}


def learner(task="navigation", seeds=(0, 1), **overrides):
    settings = SMALL | {name.replace("__", "."): value for name, value in overrides.items()}
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


@pytest.mark.parametrize("kind", ["esp", "augment", "consistency"])
def test_each_mean_of_the_prior_changes_the_run(kind):
    plain, _ = after(prior__kind="none")
    other, _ = after(prior__kind=kind)
    assert not equal(plain, other)


@pytest.mark.parametrize("network", ["mlp", "gru"])
@pytest.mark.parametrize("kind", ["none", "esp"])
def test_same_seed_same_run(network, kind):
    first, _ = after(network__name=network, prior__kind=kind)
    second, _ = after(network__name=network, prior__kind=kind)
    assert equal(first, second)


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


def test_a_minibatch_in_several_chunks_differs_by_rounding_alone():
    """How a large minibatch is cut depends on the number of seeds, and a sum on how it is cut."""
    large = {"mappo__num_minibatches": 1, "mappo__chunk_steps": 60}
    together, _ = after(seeds=(7, 8, 9), **large)
    alone, _ = after(seeds=(8,), **large)
    for name, tensor in alone.items():
        torch.testing.assert_close(tensor[0], together[name][1], rtol=1e-4, atol=1e-6)


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


def test_recurrent_networks_need_whole_episodes():
    with pytest.raises(ValueError, match="multiple of 25"):
        learner(network__name="gru", mappo__num_steps=20)


def test_a_rollout_has_a_row_for_every_minibatch():
    with pytest.raises(ValueError, match="100 rows to share"):
        learner(mappo__num_minibatches=101)


def test_the_old_value_of_value_clipping_is_what_the_critic_said():
    trained = learner(mappo__clip_value=True)
    trained.iterate(0.0)
    batch, _ = trained.prepare(trained.collector.collect(25))
    now = trained.critic.unroll(batch.obs, batch.state)
    torch.testing.assert_close(batch.value, now, rtol=1e-4, atol=1e-5)


def test_a_restored_learner_goes_on_bit_for_bit():
    straight = learner()
    for _ in range(2):
        straight.iterate(0.0)
    saved = copy.deepcopy(straight.state_dict())
    resumed = learner()
    resumed.load_state_dict(saved)
    straight.iterate(0.0)
    resumed.iterate(0.0)
    assert equal(straight.state_dict(), resumed.state_dict())
    other = learner(seeds=(5, 6))
    other.iterate(0.0)
    assert not equal(weights(straight), weights(other)), "negative control"


def test_a_checkpoint_of_another_configuration_is_refused_in_one_sentence():
    saved = learner().state_dict()
    with pytest.raises(ValueError, match="does not fit this configuration"):
        learner(network__hidden=[8]).load_state_dict(saved)


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
