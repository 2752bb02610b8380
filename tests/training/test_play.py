"""Playing episodes, against returns worked out by hand in a world where everything is written down before."""

from operator import methodcaller

import pytest
import torch

from esp_cli.networks.build import NETWORKS
from esp_cli.networks.policy import StochasticPolicy
from esp_cli.training.build import PolicyController, ScriptedController, generators, play
from esp_envs.base import Environment, Observation, Step, generators_for
from esp_envs.scene import Scene
from esp_envs.settings import TaskSettings
from esp_envs.spec import LEFT, RIGHT, Discrete, Field, Kind, TaskSpec, joint_layout, layout

SEEDS = (5, 6)
OBSERVATION = layout(Field("clock", Kind.SCALAR), Field("place", Kind.VECTOR))
SCRIPT = torch.tensor([[1.0, 5.0, 0.0], [2.0, 7.0, 0.0], [3.0, 100.0, 0.0], [4.0, 100.0, -1.0]])
"""Reward by step [T] and world [E]; world 1 terminates after its second step, what follows is another episode's."""


class Scripted(Environment):
    """Three worlds of two agents. Agent i gets (seed index + 1) * SCRIPT + 2 i + its action."""

    heuristics = ("right", "left")

    def __init__(self, seeds=SEEDS):
        super().__init__(TaskSettings(), 3, generators_for(seeds))
        self.spec = TaskSpec(
            name="scripted",
            version=1,
            convention="by hand",
            num_agents=2,
            horizon=4,
            observation=OBSERVATION,
            state=joint_layout(OBSERVATION, 2),
            action=Discrete(Kind.VECTOR, (LEFT, RIGHT), ("left", "right")),
            symmetry="c1",
            shared_reward=False,
        )
        self.actions = []

    def reset(self):
        self.time = 0
        return self._observe()

    def step(self, action):
        self.actions.append(action)
        factor = torch.arange(1.0, self.num_seeds + 1).view(-1, 1, 1)
        reward = factor * SCRIPT[self.time].view(1, 3, 1) + torch.tensor([0.0, 2.0]) + action
        self.time += 1
        terminated = torch.tensor([False, self.time == 2, False]).expand(self.num_seeds, 3)
        truncated = torch.full((self.num_seeds, 3), self.time == 4)
        metrics = {"clock": torch.full((self.num_seeds, 3), float(self.time))}
        following = self._observe()
        return Step(following, reward, terminated, truncated, following if self.time in (2, 4) else None, metrics)

    def _observe(self):
        place = torch.linspace(-2, 2, self.num_seeds * 3 * 2 * 2).view(self.num_seeds, 3, 2, 2)
        obs = torch.cat([torch.full((self.num_seeds, 3, 2, 1), float(self.time)), place], -1)
        return Observation(obs, obs.flatten(2))

    def heuristic(self, name=None):
        chosen = self.heuristics.index(name or self.heuristics[0])
        return torch.full((self.num_seeds, 3, 2), 1 - chosen)

    def set_state(self, state):
        return self.reset()

    def state_dict(self):
        return {}

    def load_state_dict(self, tensors):
        self.reset()

    def scene(self, world=(0, 0)):
        return Scene((), (-1.0, 1.0, -1.0, 1.0))


def test_returns_lengths_and_metrics_by_hand():
    """Mean over agents of the sum over time: SCRIPT + 1 a step; with the action 0 nothing is added."""
    episodes = play(Scripted(), ScriptedController(methodcaller("heuristic", "left")))
    # world 0: 1 + 2 + 3 + 4 + 4 * 1; world 1: 5 + 7 + 2 * 1, and not the 100s; world 2: -1 + 4 * 1;
    # the second seed doubles SCRIPT
    assert episodes.returns.tolist() == [[14.0, 14.0, 3.0], [24.0, 26.0, 2.0]]
    assert episodes.lengths.tolist() == [[4.0, 2.0, 4.0]] * 2
    # mean of 1..4, and of 1..2 where the episode was over after two steps
    assert episodes.metrics["clock"].tolist() == [[2.5, 1.5, 2.5]] * 2
    # the action of the first heuristic is 1, which each agent gets on top in every step of the episode
    first = play(Scripted(), ScriptedController(methodcaller("heuristic")))
    assert first.returns.tolist() == [[18.0, 16.0, 7.0], [28.0, 28.0, 6.0]]


RANDOM = ScriptedController(methodcaller("random_action"))


def test_the_random_anchor_draws_from_the_worlds_own_generators():
    env = Scripted()
    returns = play(env, RANDOM).returns
    added = torch.stack(env.actions).float().mean(-1)
    added[2:, :, 1] = 0
    base = torch.tensor([[14.0, 14.0, 3.0], [24.0, 26.0, 2.0]])
    torch.testing.assert_close(returns, base + added.sum(0))
    assert 0 < torch.stack(env.actions).float().mean() < 1
    assert torch.equal(play(Scripted(), RANDOM).returns, returns)
    assert torch.equal(play(Scripted((6,)), RANDOM).lengths, torch.tensor([[4.0, 2.0, 4.0]]))


def policy_for(env, name="mlp"):
    return StochasticPolicy(env.spec, NETWORKS[name](hidden=(4,)), generators(SEEDS, "policy"))


def test_a_greedy_policy_takes_its_most_probable_action():
    env = Scripted()
    policy = policy_for(env)
    play(env, PolicyController(policy))
    for time, taken in enumerate(env.actions):
        env.time = time
        obs = env._observe().obs
        log_probs, _ = policy.step(obs, policy.initial_memory(3, obs))
        assert torch.equal(taken, log_probs.argmax(-1))
    assert len({int(a) for a in torch.stack(env.actions).unique()}) == 2, "it does not always take the same one"


def test_a_drawn_policy_draws_from_each_seeds_own_generator():
    def actions(seeds):
        env = Scripted()
        play(env, PolicyController(policy_for(env), generators(seeds, "noise")))
        return torch.stack(env.actions)

    first = actions((5, 6))
    assert torch.equal(actions((5, 6)), first)
    other = actions((5, 9))
    assert torch.equal(other[:, 0], first[:, 0])
    assert not torch.equal(other[:, 1], first[:, 1])


def test_the_frequency_of_drawn_actions_is_the_policys():
    env = Scripted()
    policy, noise = policy_for(env), generators(SEEDS, "noise")
    controller = PolicyController(policy, noise)
    observation = env.reset()
    controller.begin(env, observation)
    drawn = torch.stack([controller.act(env, observation) for _ in range(2000)]).float().mean(0)
    log_probs, _ = policy.step(observation.obs, policy.initial_memory(3, observation.obs))
    # standard error of a share over 2000 draws: at most 0.011
    torch.testing.assert_close(drawn, log_probs.exp()[..., 1], atol=0.045, rtol=0)


def test_memory_is_empty_at_the_beginning_of_every_play():
    env = Scripted()
    controller = PolicyController(policy_for(env, "gru"))
    first = play(env, controller).returns
    remembered = controller.memory.clone()
    assert remembered.abs().max() > 0, "it does remember within an episode"
    assert torch.equal(play(env, controller).returns, first)
    assert torch.equal(controller.memory, remembered), "after the same episode it remembers the same"
    observation = env.reset()
    controller.act(env, observation)  # negative control: without a beginning it goes on with what it remembers
    carried = controller.memory
    controller.begin(env, observation)
    assert controller.memory.abs().max() == 0
    controller.act(env, observation)
    assert not torch.allclose(carried, controller.memory)


def test_playing_leaves_no_gradient_behind():
    env = Scripted()
    controller = PolicyController(policy_for(env, "gru"))
    play(env, controller)
    assert not controller.memory.requires_grad
    with pytest.raises(RuntimeError, match="does not require grad"):
        controller.memory.sum().backward()
