"""A policy-gradient loop in plain torch, as in CleanRL: all envs of a vector env are filtered.

python examples/vector_env.py --steps 100000
"""

import argparse

import gymnasium as gym
import torch
from torch.distributions import Normal

import safe_wrappers as sw

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--steps", type=int, default=100_000)
steps = parser.parse_args().steps
n_envs, rollout = 8, 64

torch.manual_seed(0)
envs = sw.protect(gym.make_vec("SafePointGoal1-v0", num_envs=n_envs, vectorization_mode="sync"))
size, actions = (gym.spaces.flatdim(s) for s in (envs.single_observation_space, envs.single_action_space))
mean = torch.nn.Sequential(torch.nn.Linear(size, 64), torch.nn.Tanh(), torch.nn.Linear(64, actions))
log_std = torch.nn.Parameter(torch.zeros(actions))
optimizer = torch.optim.Adam([*mean.parameters(), log_std], lr=1e-3)

observation = envs.reset(seed=0)[0]
changed = cost = 0.0
for _ in range(max(1, steps // (n_envs * rollout))):
    logs, rewards = [], []
    for _ in range(rollout):
        policy = Normal(mean(torch.as_tensor(observation, dtype=torch.float32)), log_std.exp())
        action = policy.sample()  # what the policy proposed is what its gradient needs
        observation, reward, terminated, truncated, info = envs.step(action.clamp(-1, 1).numpy())
        logs.append(policy.log_prob(action).sum(-1))
        rewards.append(torch.as_tensor(reward, dtype=torch.float32))
        changed += info["cbf/intervened"].sum()
        cost += info["cost"].sum()
    to_come = torch.stack(rewards).flip(0).cumsum(0).flip(0)
    loss = -(torch.stack(logs) * (to_come - to_come.mean(1, keepdim=True))).mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
print(f"{changed:.0f} actions changed, cost {cost:.0f}, last rewards {to_come[0].mean():.2f} per rollout")
