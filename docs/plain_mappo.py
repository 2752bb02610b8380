"""MAPPO in one file, on cooperative navigation; the four lines marked ESP add the symmetry prior.

python docs/plain_mappo.py --steps 200000

Without the marked lines it is plain MAPPO: shared actor, centralised critic, clipped objective, GAE.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.distributions import Categorical

from esp_cli import Symmetry  # ESP
from esp_envs import make


@dataclass(frozen=True)
class Settings:
    """What the command line may change."""

    steps: int = 200_000  # environment steps, of all worlds together
    seed: int = 0
    num_envs: int = 32  # E
    num_steps: int = 25  # T
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 7e-4
    gamma: float = 0.95
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy_coef: float = 0.01
    value_coef: float = 0.5
    max_grad_norm: float = 0.5
    reward_scale: float = 0.05  # keeps returns near 1


def perceptron(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Return a network of two hidden layers with orthogonal weights."""
    layers: list[nn.Module] = []
    for width_in, width_out, scale in ((inputs, 64, 2**0.5), (64, 64, 2**0.5), (64, outputs, gain)):
        linear = nn.Linear(width_in, width_out)
        nn.init.orthogonal_(linear.weight, scale)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


def advantages(
    reward: Tensor, value: Tensor, next_value: Tensor, ended: Tensor, gamma: float, gae_lambda: float
) -> Tensor:
    """Return generalised advantage estimates [T, E].

    Args:
        reward: [T, E].
        value: of the states seen, [T, E].
        next_value: of the states reached, 0 beyond an end, [T, E].
        ended: whether the episode ended or was cut here, [T, E].
        gamma: discount.
        gae_lambda: of the estimator.
    """
    out, running = torch.zeros_like(reward), torch.zeros_like(reward[0])
    delta = reward + gamma * next_value - value
    for t in reversed(range(len(reward))):
        running = delta[t] + gamma * gae_lambda * ~ended[t] * running
        out[t] = running
    return out


def main(arguments: list[str] | None = None) -> list[float]:
    """Train, print and return the mean return of the episodes of each update."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in vars(Settings()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(default), default=default)
    args = Settings(**vars(parser.parse_args(arguments)))
    torch.manual_seed(args.seed)

    world = make("navigation", args.num_envs, [args.seed])  # tensors [1, E, ...]: one seed
    spec = world.spec
    actor = perceptron(spec.observation.width, spec.action.count, 0.01)
    critic = perceptron(spec.state.width, 1, 1.0)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], args.learning_rate, eps=1e-5)
    symmetry = Symmetry(observation=spec.observation, action=spec.action, state=spec.state, num_agents=3)  # ESP

    def policy(obs: Tensor) -> Categorical:
        """Return the distribution of actions [..., N] at observations [..., N, D]."""
        return Categorical(logits=actor(obs), validate_args=False)

    seen, returns, begun = world.reset(), [], time.time()
    for update in range(args.steps // (args.num_envs * args.num_steps)):
        # Collect T steps of E worlds with N agents.
        rows: dict[str, list[Tensor]] = {}
        for _ in range(args.num_steps):
            obs, state = seen.obs[0], seen.state[0]
            with torch.no_grad():
                choice = policy(obs)
                action = choice.sample()
                step = world.step(action.unsqueeze(0))
                reached = step.final or step.next
                next_value = critic(reached.state[0]).squeeze(-1) * ~step.terminated[0]
                row = {
                    "obs": obs,
                    "state": state,
                    "action": action,
                    "log_prob": choice.log_prob(action),
                    "reward": step.reward[0].mean(-1),
                    "value": critic(state).squeeze(-1),
                    "next_value": next_value,
                    "ended": step.terminated[0] | step.truncated[0],
                }
            for name, tensor in row.items():
                rows.setdefault(name, []).append(tensor)
            seen = step.next
        data = {name: torch.stack(tensors) for name, tensors in rows.items()}
        returns.append(data["reward"].sum().item() / max(int(data["ended"].sum()), 1))

        advantage = advantages(
            args.reward_scale * data["reward"],
            data["value"],
            data["next_value"],
            data["ended"],
            args.gamma,
            args.gae_lambda,
        )
        data["target"] = advantage + data["value"]
        data["advantage"] = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        flat = {name: tensor.flatten(0, 1) for name, tensor in data.items()}

        # Learn from them.
        for _ in range(args.epochs):
            for batch in torch.randperm(args.num_envs * args.num_steps).chunk(args.minibatches):
                obs, state, action = (flat[name][batch] for name in ("obs", "state", "action"))
                numbers = tuple(flat[name][batch] for name in ("log_prob", "advantage", "target"))
                obs, action, state, numbers = symmetry.augment(obs, action, state=state, per_agent=numbers)  # ESP
                old_log_prob, weight, target = numbers

                choice = policy(obs)
                ratio = (choice.log_prob(action) - old_log_prob).exp()
                weight = weight.unsqueeze(-1)
                gain = torch.min(ratio * weight, ratio.clamp(1 - args.clip, 1 + args.clip) * weight).mean()
                value_loss = (critic(state).squeeze(-1) - target).square().mean()
                loss = -gain + args.value_coef * value_loss - args.entropy_coef * choice.entropy().mean()
                loss += 0.1 * (symmetry.policy_loss(policy, obs, choice) + symmetry.value_loss(critic, state))  # ESP

                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_([*actor.parameters(), *critic.parameters()], args.max_grad_norm)
                optimiser.step()
        if update % 10 == 0:
            steps = (update + 1) * args.num_envs * args.num_steps
            print(f"{steps:>8} steps  return {returns[-1]:8.2f}  {steps / (time.time() - begun):6.0f} steps/s")
    return returns


if __name__ == "__main__":
    main()
