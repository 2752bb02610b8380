"""The larger example of the page on algorithms, docs/masac.py: soft actor-critic, used as a file of a user's own."""

import math
import sys
from pathlib import Path

import pytest
import torch

from esp_cli import load_policy
from esp_cli.algorithms.presets import ALGORITHMS
from esp_envs.fields import Field, Kind, layout
from esp_envs.spec import Continuous
from tests.algorithms.off_policy import equal, learner, networks
from tests.cli.running import esp
from tests.learning.pointing import Pointing
from tests.learning.test_off_policy_answers import learn

DOCS = Path(__file__).parents[2] / "docs"
MASAC = "masac:Masac"
ALGO = ["--algo", MASAC]
TINY = [
    part
    for setting in (
        ["num_envs=2", "batch_episodes=3", "replay_episodes=8", "warmup_episodes=2", "initial_temperature=0.2"]
    )
    for part in ("--set", f"{MASAC}.{setting}")
] + ["--set", "network.hidden=[16,16]", "--set", "evaluation.episodes=4", "--set", "evaluation.every_steps=1000000"]
KINDS = {
    "discrete": ["--task", "navigation"],
    "vectors": ["--task", "navigation", "--set", "task.actions=continuous"],
    "wheels": ["--task", "formation", "--set", "task.horizon=20"],
}


@pytest.fixture(autouse=True)
def masac(monkeypatch):
    """Make the file importable, registered as by `--algo`, and take it out again."""
    monkeypatch.syspath_prepend(str(DOCS))
    monkeypatch.setattr(ALGORITHMS, "_registered", {})
    ALGORITHMS.register(MASAC)
    yield sys.modules["masac"]
    del sys.modules["masac"]


def soft(actions="discrete", **choice):
    return learner(MASAC, task__actions=actions, **choice)


both = pytest.mark.parametrize("actions", ["discrete", "continuous"])


def test_the_file_is_as_short_as_the_page_says():
    assert len((DOCS / "masac.py").read_text().splitlines()) <= 250


@pytest.mark.usefixtures("few_scenes")
@pytest.mark.parametrize(("kind", "prior"), [("discrete", "none"), ("vectors", "esp"), ("wheels", "esp")])
def test_it_trains_and_is_evaluated_drawn_exported_and_loaded(tmp_path, kind, prior):
    run = tmp_path / "run"
    esp("train", *ALGO, *KINDS[kind], "--prior", prior, "--seeds", 2, "--steps", 400, *TINY, "--out", run)
    assert "after 400 steps" in esp("eval", run, *ALGO, "--episodes", 3).stdout
    esp("render", run, *ALGO, "-o", tmp_path / "film.gif", "--episodes", 1, "--size", 64)
    exported = esp("export", run, *ALGO, "-f", "numpy", "-f", "c", "-o", tmp_path / "export").stdout
    assert "numpy" in exported
    assert (tmp_path / "export" / "policy.c").exists()
    policy = load_policy(run, algo=MASAC)
    assert policy.act([[0.0] * policy.spec.observation.width]).shape[0] == 1


@both
@torch.no_grad()
def test_a_recurrent_policy_plays_with_the_history_that_it_learns_from(actions):
    learned = soft(actions, network__name="gru")
    policy, env = learned.policy, learned.collector.env
    obs = env.reset().obs
    played = policy.initial_memory(env.num_envs, obs)
    learning = played.clone()
    for _ in range(3):
        action, played = policy.act(obs, played)
        outputs, learning = policy.step(obs, learning)
        latent = policy.head.mode(outputs)
        learning = policy.remember(learning, latent)
        assert torch.equal(action, policy.head.to_environment(latent))
        assert torch.equal(played, learning)
        assert bool(played[..., -policy.head.num_outputs :].any())
        obs = env.step(action).next.obs


@both
@pytest.mark.parametrize("choice", [{}, {"prior__replay": "stored", "network__name": "gru"}])
def test_a_learner_restored_between_iterations_goes_on_bit_for_bit(actions, choice):
    straight, halted = soft(actions, **choice), soft(actions, **choice)
    for _ in range(3):
        straight.iterate(0.0)
        halted.iterate(0.0)
    resumed = soft(actions, **choice)
    assert not equal(networks(resumed), networks(halted))
    resumed.load_state_dict({name: tensor.clone() for name, tensor in halted.state_dict().items()})
    straight.iterate(0.0)
    resumed.iterate(0.0)
    assert equal(straight.state_dict(), resumed.state_dict())


@both
def test_no_coefficient_is_the_plain_algorithm_and_each_part_of_the_prior_moves_it(actions):
    def after(**choice):
        trained = soft(actions, **choice)
        for _ in range(2):
            trained.iterate(0.0)
        return networks(trained)

    plain = after(prior__kind="none")
    assert equal(plain, after(prior__kind="consistency", prior__consistency_coef=0.0))
    for choice in ({"kind": "augment"}, {"kind": "consistency"}, {"replay": "stored"}):
        assert not equal(plain, after(**{f"prior__{name}": value for name, value in choice.items()}))


@pytest.mark.parametrize("task", ["predator-prey", "wildlife"])
def test_it_learns_with_rewards_of_the_agents_own_and_where_agents_end(task):
    trained = learner(MASAC, task)
    for _ in range(3):
        metrics = trained.iterate(0.0).metrics
    assert trained.updates > 0
    assert all(value.isfinite().all() for value in metrics.values())


def test_the_density_after_the_squash_by_hand(masac):
    """Of one number log N(u) - log(1 - tanh(u)^2); 1 - tanh(1)^2 = 0.41997, and N(1 | 0, 0.6) = 0.16579."""
    head = masac.SquashedGaussian(Continuous(layout(Field("wheels", Kind.SCALAR))), 1)
    outputs, latent = torch.zeros(1, 1, 1, 1, 1), torch.ones(1, 1, 1, 1, 1)
    expected = math.log(0.16579) - math.log(0.41997)
    assert head.squashed_log_prob(outputs, latent).item() == pytest.approx(expected, abs=1e-4)
    assert head.log_prob(outputs, latent).item() == pytest.approx(math.log(0.16579), abs=1e-4), "that of the latent"


def test_the_density_of_a_vector_and_a_number_is_that_of_the_change_of_variables(masac):
    fields = Field("force", Kind.VECTOR), Field("grip", Kind.SCALAR)
    head = masac.SquashedGaussian(Continuous(layout(*fields)), 1)
    latent = torch.tensor([0.3, -1.2, 0.7])
    slopes = torch.autograd.functional.jacobian(head.to_environment, latent)
    outputs, row = torch.zeros(1, 1, 1, 1, 3), latent.view(1, 1, 1, 1, 3)
    expected = head.log_prob(outputs, row) - torch.linalg.det(slopes).abs().log()
    torch.testing.assert_close(head.squashed_log_prob(outputs, row), expected)


def test_the_temperature_by_hand(masac):
    """log alpha (H - target) with H = 1.0 and 2.0 beside a target of 1.5, at alpha = 2: -0.34657 and 0.34657."""
    temperature = masac.Temperature(2, 2.0)
    loss = temperature.loss(torch.tensor([1.0, 2.0]), 1.5)
    assert loss.tolist() == pytest.approx([-0.34657, 0.34657], abs=1e-5)
    (slope,) = torch.autograd.grad(loss.sum(), [temperature.log])
    assert slope.tolist() == [[-0.5], [0.5]], "down the slope alpha rises where the entropy is below its target"


@both
@pytest.mark.parametrize("learns", [True, False])
def test_the_temperature_moves_the_entropy_to_its_target(actions, learns):
    """Negative control: with a temperature that stays near 0 the critics let the entropy fall far below."""
    target = 1.0 if actions == "discrete" else 0.0
    rates = {"algo__temperature_learning_rate": 0.03 if learns else 1e-9, "algo__actor_learning_rate": 0.01}
    trained = soft(actions, prior__kind="none", algo__target_entropy=target, algo__initial_temperature=1e-3, **rates)
    batch = trained.collector.collect()[0]
    copies, seen = trained.prior.copies(batch, []), trained.critic_rows(batch)[:, :, :-1]
    entropies = [trained.learn_actor(copies, seen)["entropy"] for _ in range(600)]
    gap = (torch.stack(entropies[-50:]).mean(0) - target).abs()
    assert (gap < 0.15).all() if learns else (gap > 0.5).all(), gap


@both
def test_targets_by_hand_on_the_last_transitions(actions, monkeypatch):
    """With Q = 3 and 2, alpha = 0.5 and H = 0.7 each of 3 agents: 2 + 0.5 x 2.1 / 5 for what follows."""
    trained = soft(actions, prior__kind="none", algo__initial_temperature=0.5, algo__td_lambda=0.5, algo__gamma=0.9)
    batch = trained.collector.collect()[0]
    batch.reward.fill_(0.0)
    critics = iter((3.0, 2.0))
    value = lambda critic, seen, action: torch.full((*action.shape[:3], 1), next(critics))  # noqa: E731
    monkeypatch.setattr(trained.joint, "value", value)
    drawn = trained.drawn
    monkeypatch.setattr(trained, "drawn", lambda outputs: (drawn(outputs)[0], torch.full(outputs.shape[:-1], 0.7)))
    target = trained.targets(batch, trained.critic_rows(batch))[..., 0]
    bonus = 0.5 * 3 * 0.7 / 5  # a value is in rewards divided by the root of 25 steps
    before = 0.9 * (0.5 * 2.0 + bonus)  # lambda of it goes on with the last target, which is 0
    expected = torch.tensor([0.9 * (0.5 * 2.0 + bonus + 0.5 * before), before, 0.0]).expand(2, 2, 3)
    torch.testing.assert_close(target[:, :, -3:], expected)


def test_the_expectation_over_discrete_actions_by_hand(monkeypatch):
    """Q = 0, 1, 2, 3, 4 of five actions and a uniform policy: -(5 x 2 + 0.5 log 5), as values count five times."""
    trained = soft(prior__kind="none", algo__initial_temperature=0.5)
    batch = trained.collector.collect()[0]
    monkeypatch.setattr(
        trained.joint, "exchanged", lambda critic, seen, joint, choices: torch.arange(5.0).expand(choices.shape[:-1])
    )
    outputs = torch.full((2, 2, 25, 3, 5), -math.log(5))
    loss, entropy = trained.policy_loss(outputs, trained.critic_rows(batch)[:, :, :-1], batch)
    torch.testing.assert_close(loss, torch.full((2,), -(10 + 0.5 * math.log(5))))
    torch.testing.assert_close(entropy, torch.full((2, 2, 25, 3), math.log(5)))


@both
def test_the_value_consistency_is_0_for_an_invariant_critic_alone(actions):
    trained = soft(actions, prior__transforms="d4*agents")
    trained.iterate(0.0)
    batch = trained.replay.sample(3, trained.generators["learner"])
    copies = trained.prior.copies(batch, trained.generators["prior"])

    def invariant(seen, action):
        return torch.cat([seen, action], -1).square().sum(-1, keepdim=True)

    def other(seen, action):
        return torch.cat([seen, action], -1)[..., :1]

    def gap(critic):
        rows = copies.rows
        value = trained.joint.value(critic, trained.critic_rows(rows)[:, :, :-1], trained.encoded(rows))
        return copies.gaps(value=value)["value"]

    assert gap(invariant).max() < 1e-6
    assert gap(other).min() > 1e-4
    assert gap(trained.critics[0]).min() > 1e-6
    errors = trained.prior.errors(batch, trained.answers)
    assert set(errors) == {"policy_symmetry_error", "value_symmetry_error"}


def test_it_finds_the_answer_and_sooner_with_the_prior():
    plain = learn(MASAC, Pointing, kind="none")
    assert plain[0].max() < 0.5
    assert plain[-1].min() > 0.9
    esp = learn(MASAC, Pointing, kind="esp", transforms="d4")
    assert esp[-1].min() > 0.9
    assert (torch.stack(esp[1:3]).mean(0) > torch.stack(plain[1:3]).mean(0)).all(), "of each seed"
