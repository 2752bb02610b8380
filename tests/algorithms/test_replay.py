"""The replay keeps whole episodes, each seed's apart, and gives them back as they were."""

import pytest
import torch

from esp_cli.algorithms.replay import EpisodeBatch, EpisodeCollector, EpisodeReplay
from esp_cli.symmetry import transform_set
from esp_cli.training.build import generators
from esp_envs.base import Step
from esp_envs.registry import make
from tests.algorithms.off_policy import learner, numbered_batch, turn

SPEC = make("navigation", 1, [0]).spec


def replay(capacity=5, seeds=2) -> EpisodeReplay:
    return EpisodeReplay(SPEC, seeds, capacity, torch.device("cpu"))


def marks(batch: EpisodeBatch) -> torch.Tensor:
    """The mark of each episode, after checking that all its numbers carry the same."""
    mark = batch.reward[:, :, 0, 0]
    for tensor in (batch.obs, batch.state, batch.reward):
        assert (tensor == mark.view(*mark.shape, *[1] * (tensor.dim() - 2))).all()
    return mark


def test_a_drawn_episode_is_whole_and_of_its_own_seed():
    memory = replay()
    for first in (0, 2, 4, 6):
        memory.add(numbered_batch(SPEC, 2, 2, first))
    batch = memory.sample(200, generators((0, 1), "draws"))
    drawn = marks(batch)
    assert set(drawn[0].tolist()) == {3.0, 4.0, 5.0, 6.0, 7.0}, "the newest five"
    assert set(drawn[1].tolist()) == {1003.0, 1004.0, 1005.0, 1006.0, 1007.0}
    assert not torch.equal(drawn[0], drawn[1] - 1000), "each seed draws by its own generator"


def test_what_is_not_stored_yet_is_never_drawn():
    memory = replay()
    memory.add(numbered_batch(SPEC, 2, 2))
    assert marks(memory.sample(100, generators((0, 1), "draws"))).unique().tolist() == [0.0, 1.0, 1000.0, 1001.0]


def test_a_seed_draws_the_same_alone_and_among_others():
    among, alone = replay(seeds=3), replay(seeds=1)
    among.add(numbered_batch(SPEC, 3, 5))
    alone.add(numbered_batch(SPEC, 1, 5))
    drawn = marks(among.sample(20, generators((4, 7, 9), "draws")))
    assert torch.equal(marks(alone.sample(20, generators((7,), "draws")))[0] + 1000, drawn[1])


def test_more_episodes_than_there_is_room_for_are_refused():
    with pytest.raises(ValueError, match="one round brings 4 episodes, but replay_episodes is 3"):
        learner("qmix", algo__replay_episodes=3, prior__replay="stored", prior__transforms="rot90")


def test_only_the_filled_part_is_saved_and_comes_back():
    memory, other = replay(), replay()
    memory.add(numbered_batch(SPEC, 2, 3))
    saved = memory.state_dict()
    assert saved["obs"].shape[1] == 3
    other.load_state_dict(saved)
    memory.add(numbered_batch(SPEC, 2, 4, 10))
    other.add(numbered_batch(SPEC, 2, 4, 10))
    drawn = [marks(m.sample(50, generators((0, 1), "draws"))) for m in (memory, other)]
    assert torch.equal(*drawn)
    with pytest.raises(ValueError, match="do not fit into the replay"):
        replay(seeds=3).load_state_dict(saved)
    with pytest.raises(ValueError, match="do not fit into the replay"):
        replay(capacity=2).load_state_dict(saved)


def test_a_recurrent_policy_is_collected_with_what_it_did_before():
    trained, env = learner("qmix", network__name="gru"), make("navigation", 4, (0, 1))
    trained.policy.head.explore(0.0)
    with torch.no_grad():
        for parameter in trained.policy.parameters():
            parameter.mul_(3)  # so that the action before matters
        batch, _ = EpisodeCollector(env, trained.policy, generators((0, 1), "noise")).collect()
        values, forgetful = (trained.policy.unroll(batch.obs, done) for done in (batch.action, 0 * batch.action))
    assert torch.equal(values[:, :, :-1].argmax(-1), batch.action)
    assert not torch.equal(forgetful[:, :, :-1].argmax(-1), batch.action), "the control"


def played(task="navigation", seeds=(0, 1), num_envs=4, **settings):
    """A collector after one round, and what it collected."""
    trained = learner("qmix" if settings.get("actions") != "continuous" else "maddpg", task, seeds)
    env = make(task, num_envs, seeds, settings)
    collector = EpisodeCollector(env, trained.policy, generators(seeds, "noise"))
    return env, *collector.collect()


def test_a_collected_episode_is_what_the_worlds_did():
    _, batch, returns = played()
    again = make("navigation", 4, (0, 1))
    observation = again.reset()
    total = torch.zeros(2, 4)
    for t in range(25):
        assert torch.equal(batch.obs[:, :, t], observation.obs)
        assert torch.equal(batch.state[:, :, t], observation.state)
        step = again.step(batch.action[:, :, t])
        torch.testing.assert_close(batch.reward[:, :, t, 0], step.reward[..., 0])
        total += step.reward.mean(-1)
        observation = step.next
    assert torch.equal(batch.obs[:, :, 25], step.final.obs), "the last row is the final state, not the next episode's"
    assert not torch.equal(batch.obs[:, :, 25], step.next.obs)
    torch.testing.assert_close(returns, total.mean(1))
    assert batch.valid.all()
    assert not batch.terminated.any()


def test_what_follows_the_end_of_an_episode_is_not_valid(monkeypatch):
    env = make("navigation", 4, (0, 1))
    step, count = env.step, iter(range(100))

    def ends_world_one_after_three_steps(action):
        out = step(action)
        terminated = out.terminated.clone()
        terminated[:, 1] = next(count) == 2
        final = out.final or out.next
        return Step(out.next, out.reward, terminated, out.truncated, final, out.metrics)

    monkeypatch.setattr(env, "step", ends_world_one_after_three_steps)
    trained = learner("qmix")
    batch, returns = EpisodeCollector(env, trained.policy, generators((0, 1), "noise")).collect()
    assert batch.valid[:, 1].sum(-1).tolist() == [3, 3]
    assert batch.valid[:, [0, 2, 3]].all()
    assert batch.terminated[:, 1, 2].all()
    assert batch.terminated.sum() == 2
    counted = torch.where(batch.valid, batch.reward.squeeze(-1), 0.0).sum(2).mean(1)
    torch.testing.assert_close(returns, counted)
    # and nothing that is not valid enters a gradient step
    spoilt = EpisodeBatch(**{name: tensor.clone() for name, tensor in batch.tensors.items()})
    spoilt.obs[:, 1, 4:], spoilt.state[:, 1, 4:], spoilt.reward[:, 1, 3:] = 9.0, 9.0, -9.0
    for algorithm in ("qmix", "maddpg"):
        weights = []
        for episodes in (batch, spoilt):
            trained = learner(algorithm, prior__kind="none")
            trained._store(episodes)
            trained.update(episodes)
            weights.append(trained.policy.actor.layers[0].weight.detach().clone())
        torch.testing.assert_close(*weights, rtol=0, atol=0)


@pytest.mark.parametrize("text", ["rot90", "flip-x", "rot90*swap"])
def test_a_transformed_batch_equals_the_batch_of_transformed_episodes(text):
    env, batch, _ = played()
    spec = env.spec
    group = "d4*agents" if "swap" in text else text
    elements = transform_set(group, spec).each()
    g = elements[-1] if "swap" in text else elements[0]
    memory, turned = (EpisodeReplay(spec, 2, 9, torch.device("cpu")) for _ in range(2))
    memory.add(batch)
    turned.add(batch.transformed(g))
    ours = memory.sample(6, generators((0, 1), "draws")).transformed(g)
    theirs = turned.sample(6, generators((0, 1), "draws"))
    for name, tensor in vars(ours).items():
        torch.testing.assert_close(tensor, getattr(theirs, name), rtol=0, atol=0)


def test_a_transformed_episode_is_what_the_transformed_worlds_would_have_done():
    """Eq. 5 and 6 over a whole episode: play the turned actions from the turned start."""
    env, batch, _ = played()
    g = turn(env.spec)
    copy = batch.transformed(g)
    env.set_state(copy.state[:, :, 0])
    for t in range(25):
        step = env.step(copy.action[:, :, t])
        after = step.next if step.final is None else step.final
        torch.testing.assert_close(after.obs, copy.obs[:, :, t + 1], rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(step.reward[..., :1], copy.reward[:, :, t], rtol=1e-4, atol=1e-3)


def test_rewards_of_their_own_move_with_their_agents():
    _, batch, _ = played(convention="pettingzoo")
    assert batch.reward.shape[-1] == 3
    spec = make("navigation", 1, [0], {"convention": "pettingzoo"}).spec
    for g in transform_set("agents", spec).each():
        (element,) = g.elements
        moved = batch.transformed(g)
        for i, j in enumerate(element.permutation):
            assert torch.equal(moved.reward[..., j], batch.reward[..., i])
            assert torch.equal(moved.action[..., j], batch.action[..., i])
