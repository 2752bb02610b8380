"""Let a trained policy drive eight simulated e-pucks for twelve seconds: python docs/load_policy.py."""

import torch

from esp_cli import load_policy
from esp_envs import make

policy = load_policy("formation")
print(f"{policy.source.name}: observation of {policy.spec.observation.width} numbers")
for index, field, kind, unit in policy.spec.observation.table():
    print(f"  {index:>5}  {field}: {kind}, {unit}")

world = make("formation", num_envs=1, seeds=[0], settings=policy.spec.settings)
seen = world.reset()
goal = policy.spec.observation.slices()["goal"]
for step in range(121):
    obs = seen.obs[0, 0].numpy()  # one world's robots: [8, D]
    if step % 40 == 0:
        distance = ((obs[:, goal] ** 2).sum(-1) ** 0.5).mean()
        print(f"after {step * policy.spec.control_period_s:4.1f} s: {distance:.2f} m to the goal")
    wheels = policy.act(obs)  # [8, 2], shares of full speed
    seen = world.step(torch.from_numpy(wheels)[None, None]).next
